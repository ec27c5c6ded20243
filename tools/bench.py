"""Print the timings that the documentation names, measured here and now: `make bench`.

Each line is one ratio in one run: G-buffer and ray tracing per view from the workspace's ledger, float32 against
bfloat16 training steps, and the network's frame at 256² and 800². Beside the network's frame stands what
`make bench-frames` last measured of Mitsuba at equal quality and of path tracing + denoiser at equal time.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dnrpipe.core.ledger import Ledger

SIZES = (256, 800)
REPEATS = 7
FRAMES = Path(".cache/frames/frames.json")
"""What `make bench-frames` leaves."""


def ledger_lines(workspace: Path) -> list[str]:
    """Seconds per view of passes, ray tracing and network, from the workspace's ledger."""
    records = Ledger(workspace / "costs.jsonl").read()
    lines = []
    passes = [r.detail["gbuffer_seconds"] for r in records if "gbuffer_seconds" in r.detail]
    traced = [r.seconds for r in records if r.stage == "raytrace" and r.unit == "view" and r.spp is not None]
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
    net = UNet(17, 24, 3).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    image = torch.randn(1, 17, 128, 128)
    seconds: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(12):
        for bfloat16 in (False, True):
            started = time.perf_counter()
            net([image], bfloat16=bfloat16).square().mean().backward()
            seconds[bfloat16].append(time.perf_counter() - started)
    ratio = statistics.median(seconds[False][2:]) / statistics.median(seconds[True][2:])
    return f"{'bfloat16':18} U-Net training step {ratio:.2f}x as fast as float32 on this processor"


def network_lines(workspace: Path) -> list[str]:
    """One frame of the workspace's network at other sizes: its own first test view, enlarged.

    Wall clock and CPU time; the two apart say how busy the machine is with other things. Then the shares of texture
    sampling, the network proper and the rest (guides, correction, display, composition) in the wall clock.
    """
    import torch

    lines = []
    for device in ("cpu", "cuda"):
        for size in SIZES:
            name = f"network {size}² {device}"
            if device == "cuda" and not torch.cuda.is_available():
                lines.append(f"{name:18} not measured (no CUDA device here)")
                continue
            wall, cpu, parts = _network(workspace, size, device)
            lines.append(f"{name:18} median {wall:8.1f} ms, {cpu:.1f} ms of CPU time")
            shares = ", ".join(f"{part} {100 * milliseconds / wall:.0f}%" for part, milliseconds in parts.items())
            rest = wall - sum(parts.values())
            lines.append(f"{'':18} {shares}, guides, correction and composition {100 * rest / wall:.0f}%")
    return lines


def _network(workspace: Path, size: int, device: str) -> tuple[float, float, dict[str, float]]:
    """Medians of (wall, CPU) milliseconds of one frame of size² pixels, and the wall clock of its parts."""
    import torch

    from dnrtrain.checkpoint import load_model

    model = load_model(workspace / "checkpoints" / "step2", device)
    batch = _enlarged(_first_view(workspace, model.settings.base), size).to(device)
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    parts: dict[str, list[float]] = {}
    seconds = []
    with torch.no_grad():
        for _ in range(REPEATS + 2):
            wall, cpu = time.perf_counter(), time.process_time()
            model(batch)
            wait()
            seconds.append((time.perf_counter() - wall, time.process_time() - cpu))
        # In frames of their own: waiting for a GPU between the parts slows it down.
        for part, module in (("textures", model.aggregator), ("network", model.renderer)):
            _time_calls(module, parts.setdefault(part, []), wait)
        for _ in range(REPEATS + 2):
            model(batch)
    wall, cpu = (1000 * statistics.median(values) for values in zip(*seconds[2:], strict=True))
    return wall, cpu, {part: 1000 * statistics.median(values[2:]) for part, values in parts.items()}


def _time_calls(module: Any, seconds: list[float], wait: Callable[[], None]) -> None:
    """Append the wall clock of every call of ``module`` to ``seconds``."""
    started = 0.0

    def before(*_: object) -> None:
        nonlocal started
        wait()
        started = time.perf_counter()

    def after(*_: object) -> None:
        wait()
        seconds.append(time.perf_counter() - started)

    module.register_forward_pre_hook(before)
    module.register_forward_hook(after)


def _first_view(workspace: Path, base: Any) -> Any:
    """The first test view that has all files the model needs, as a batch."""
    from dnrpipe.core.scene_files import read_frame, split_views
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.stages.base_images import RENDERED, base_path
    from dnrtrain.dataset import load_views

    opened = Workspace.open(workspace)
    view = split_views(opened)["test"][0]
    file = base_path(opened, "test", view.name)
    return load_views(
        [opened.passes("test", view.name)],
        None,
        read_frame(opened),
        cameras=[view],
        folder=opened.scene,
        target=False,
        base=base,
        base_files=[file] if base in RENDERED else None,
    ).tensors


def _enlarged(batch: Any, size: int) -> Any:
    """The batch at size², nearest neighbour: what the network computes on does not change what it costs."""
    import torch.nn.functional as F

    return batch._map(lambda tensor: F.interpolate(tensor, size=(size, size), mode="nearest"))


def frame_lines(path: Path) -> list[str]:
    """Whole frames against Mitsuba, from the last frame benchmark."""
    if not path.exists():
        return [f"{'whole frames':18} not measured (run `make bench-frames`)"]
    record = json.loads(path.read_text(encoding="utf-8"))
    lines = []
    for scene in record["scenes"]:
        for name, standing in scene["standing"].items():
            row, level = scene["rows"][name], standing["crossover_ms"]
            what = f"{scene['scene']} {scene['size'][0]}²"
            equal = f"after {level:.0f} ms" if level is not None else f"not by {standing['ladder_end_ms']:.0f} ms"
            lines.append(
                f"{what:18} {'network + base' if name == 'ours' else 'base image':14} {row['ms']:7.1f} ms"
                f" {row['psnr']:5.2f} dB; path tracing + denoiser {standing['rival_db']:5.2f} dB at equal time,"
                f" equal quality {equal}"
            )
    return [*lines, f"{'':18} measured {record['made']['date']} on {record['made']['machine']}"]


def main() -> int:
    workspace = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-output/demo.dnr")
    if not (workspace / "costs.jsonl").exists():
        print(f"{workspace}: run `make demo` first", file=sys.stderr)
        return 2
    lines = [*ledger_lines(workspace), precision_line()]
    if (workspace / "checkpoints" / "step2" / "model.json").exists():
        lines += network_lines(workspace)
    else:
        lines.append(f"{'network':18} not measured ({workspace} has no fine-tuned model)")
    print("\n".join([*lines, *frame_lines(FRAMES)]))
    print(f"{'load':18} {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
