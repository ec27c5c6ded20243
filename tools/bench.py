"""Print the timings that the documentation names, measured here and now: `make bench`.

Each line is one ratio in one run: G-buffer and ray tracing per view from the demo's ledger, the network's frame,
and float32 against bfloat16 training steps.
"""

from __future__ import annotations

import statistics
import sys
import time
from pathlib import Path

from dnrpipe.costs import Ledger


def ledger_lines(workspace: Path) -> list[str]:
    """Seconds per view of passes, ray tracing and network, from the demo's ledger."""
    records = Ledger(workspace / "costs.jsonl").read()
    lines = []
    passes = [r.detail["gbuffer_seconds"] for r in records if "gbuffer_seconds" in r.detail]
    traced = [r.seconds for r in records if r.stage == "raytrace"]
    neural = [r.seconds for r in records if r.name.startswith("neural/")]
    for name, values in (("G-buffer", passes), ("ray-traced view", traced), ("network", neural)):
        if values:
            lines.append(f"{name:18} median {1000 * statistics.median(values):8.1f} ms over {len(values)} views")
    if traced and neural:
        ratio = statistics.median(traced) / statistics.median(neural)
        lines.append(f"{'ratio':18} one ray-traced view = {ratio:.0f} frames of the network")
    return lines


def precision_line() -> str:
    """Training step of the draft network, float32 over bfloat16, alternating in one run."""
    import torch

    from dnrtrain.renderer import UNet

    torch.manual_seed(0)
    net = UNet(17, 24, 3).to(memory_format=torch.channels_last)
    image = torch.randn(1, 17, 128, 128)
    seconds: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(12):
        for bfloat16 in (False, True):
            started = time.perf_counter()
            net(image, bfloat16=bfloat16).square().mean().backward()
            seconds[bfloat16].append(time.perf_counter() - started)
    ratio = statistics.median(seconds[False][2:]) / statistics.median(seconds[True][2:])
    return f"{'bfloat16':18} U-Net training step {ratio:.2f}x as fast as float32 on this processor"


def main() -> int:
    workspace = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-output/demo.dnr")
    if not (workspace / "costs.jsonl").exists():
        print(f"{workspace}: run `make demo` first", file=sys.stderr)
        return 2
    print("\n".join([*ledger_lines(workspace), precision_line()]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
