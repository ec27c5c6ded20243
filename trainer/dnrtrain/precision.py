"""bfloat16 for convolutions where the processor has it; everything else stays float32.

bfloat16, not float16: it has float32's range, so no loss scaling and no overflow.
"""

from __future__ import annotations

import torch
from torch import Tensor


def decide_bfloat16(setting: str, device: str) -> bool:
    """Whether convolutions run in bfloat16.

    ``auto`` asks for native instructions (AMX, AVX512-BF16, CUDA) instead of timing a convolution: a timing
    depends on what else the machine does, and a run that is started again must compute the same.
    """
    if setting != "auto":
        return setting == "bfloat16"
    if device.startswith("cuda"):
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))


def at_least_float32(x: Tensor) -> Tensor:
    """bfloat16 and float16 -> float32. float32 stays as it is, and so does float64: gradients are checked in it."""
    return x if x.dtype == torch.float64 else x.float()
