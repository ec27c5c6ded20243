"""bfloat16 for convolutions where it is fast; everything else stays float32.

bfloat16, not float16: it has float32's range, so no loss scaling and no overflow.
"""

from __future__ import annotations

import time

import torch
import torch.nn.functional as F

NEEDED_SPEEDUP = 1.15


def decide_bfloat16(setting: str, device: str) -> bool:
    """Whether convolutions run in bfloat16. ``auto`` measures once; callers store the answer in the
    checkpoint, so that a resumed run computes what the interrupted one would have."""
    if setting != "auto":
        return setting == "bfloat16"
    if device.startswith("cuda"):
        return torch.cuda.is_bf16_supported()
    return _cpu_speedup() >= NEEDED_SPEEDUP


def _cpu_speedup() -> float:
    """Time of one float32 convolution block, forward and backward, over that of bfloat16 (best of 5)."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(1, 32, 128, 128, generator=generator).contiguous(memory_format=torch.channels_last)
    kernel = torch.randn(32, 32, 3, 3, generator=generator).contiguous(memory_format=torch.channels_last)
    kernel.requires_grad_()

    def once(bfloat16: bool) -> float:
        start = time.perf_counter()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bfloat16):
            result = F.conv2d(F.conv2d(image, kernel, padding=1), kernel, padding=1)
        result.float().mean().backward()
        return time.perf_counter() - start

    # Alternating, so that a neighbour's load on the machine falls on both alike.
    timings = [(once(False), once(True)) for _ in range(7)][2:]
    return min(t[0] for t in timings) / min(t[1] for t in timings)
