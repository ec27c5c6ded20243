"""Peak memory of what is large: a view of 16 megapixels through every stage that reads or writes it, 10,000 candidates.

python -m tools.faults.memory [--side 4096] [--passes 2000] [--candidates 10000] [--only view|passes|selection]

    view       one training and one test view of side² pixels: passes, selection, ray tracing at one sample per pixel
               with and without the denoiser, base image, an epoch of fine-tuning on squares, evaluation; one worker
    passes     so many candidates of 16² pixels through `dnrpipe prepare`
    selection  so many candidates whose pass files are written here, without Blender: read, chosen from by every rule
               that needs no training, and read as step 1 reads them

Each step runs in processes of its own. Measured is the sum of the resident memory of all of them at one moment, which
counts what they share more than once, ten times a second. A step that exceeds its bound is killed, and fails.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dnrtrain.contract import View

REPO = Path(__file__).resolve().parents[2]
SCENE = REPO / "blender_scenes" / "hard" / "emissive_only.blend"
SMALL = 16
BOUNDS = {
    "passes of two views": 8.0,
    "selection of one view": 4.0,
    "ray tracing and base image": 8.0,
    "ray tracing with the denoiser": 12.0,
    "an epoch of fine-tuning": 8.0,
    "evaluation of one view": 20.0,
    "passes of many candidates": 4.0,
    "selection": 2.0,
    "reading as step 1 does": 2.0,
}
"""GiB at most. docs/robustness.md promises them."""
GIB = float(1 << 30)


@dataclass
class Reading:
    """One step: its peak and seconds; problem: what went wrong, or empty."""

    name: str
    gib: float
    seconds: float
    problem: str = ""


def resident(root: int) -> int:
    """Bytes of resident memory of a process and of all its descendants, now."""
    children: dict[int, list[int]] = {}
    pages: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with contextlib.suppress(OSError, IndexError, ValueError):
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            children.setdefault(int(fields[1]), []).append(int(entry.name))
            pages[int(entry.name)] = int(fields[21])
    total, todo = 0, [root]
    while todo:
        number = todo.pop()
        total += pages.get(number, 0)
        todo += children.get(number, [])
    return total * os.sysconf("SC_PAGE_SIZE")


def measure(name: str, command: list[str], environment: dict[str, str], timeout: float) -> Reading:
    """Run a command to its end, or until it exceeds its bound or time."""
    bound, peak, problem = BOUNDS[name], 0, ""
    started = time.monotonic()
    process = subprocess.Popen(
        command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    said: list[str] = []
    assert process.stderr is not None
    reader = threading.Thread(target=said.extend, args=(process.stderr,), daemon=True)
    reader.start()
    while process.poll() is None:
        peak = max(peak, resident(process.pid))
        if peak > bound * GIB:
            problem = f"more than {bound:g} GiB"
        elif time.monotonic() - started > timeout:
            problem = f"more than {timeout:.0f} s"
        if problem:
            os.killpg(process.pid, signal.SIGKILL)
            break
        time.sleep(0.1)
    process.wait()
    reader.join(timeout=10)
    if not problem and process.returncode != 0:
        problem = f"exit code {process.returncode}: {''.join(said).strip()[-300:]}"
    return Reading(name, peak / GIB, time.monotonic() - started, problem)


def pipeline(stage: str, workspace: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "dnrpipe.cli", stage, *arguments, "-w", str(workspace), "--quiet"]


def own_step(name: str, folder: Path, count: int = 0) -> list[str]:
    """One of the steps that this module takes itself, as a command."""
    command = [sys.executable, "-m", "tools.faults.memory", "--step", name, "--folder", str(folder)]
    return [*command, "--candidates", str(count)]


def settings(**values: object) -> dict[str, str]:
    """Settings as the environment names them: ``CAMERAS__TRAIN=1``."""
    return {f"DNRPIPE_{name}": str(value) for name, value in values.items()}


def large_view(folder: Path, side: int, timeout: float) -> list[Reading]:
    """One view of ``side``² pixels through passes, ray tracing and fine-tuning."""
    workspace = folder / "large.dnr"
    given = settings(
        CAMERAS__TRAIN=1, CAMERAS__VAL=0, CAMERAS__TEST=1, CAMERAS__WIDTH=side, CAMERAS__HEIGHT=side,
        PASSES__WORKERS=1, PASSES__COVERAGE_SAMPLES=4, PASSES__RASTER="cycles-direct", PASSES__RASTER_SAMPLES=1,
        SELECT__BUDGET=1, RAYTRACE__SPP=1, RAYTRACE__EVALUATION_SPP=1, RAYTRACE__WORKERS=1,
        RAYTRACE__MAX_DEPTH=4, RAYTRACE__DENOISE="false",
        BASE__LIGHT_SIZE=256, BASE__LIGHT_SPP=16, FINETUNE__STEP2__EPOCHS=1, FINETUNE__STEP2__PATCH=256,
    )  # fmt: skip
    steps = [
        ("passes of two views", pipeline("prepare", workspace, str(SCENE))),
        ("selection of one view", pipeline("select", workspace)),
        ("ray tracing and base image", pipeline("raytrace-selected", workspace)),
        ("ray tracing with the denoiser", own_step("ray tracing with the denoiser", workspace)),
        ("an epoch of fine-tuning", pipeline("finetune", workspace)),
        ("evaluation of one view", pipeline("evaluate", workspace)),
    ]
    readings: list[Reading] = []
    for name, command in steps:
        readings.append(measure(name, command, given, timeout))
        tell(readings[-1])
        if readings[-1].problem:
            break
    return readings


def many_passes(folder: Path, count: int, timeout: float) -> list[Reading]:
    """``count`` candidates through Blender."""
    given = settings(
        CAMERAS__TRAIN=count, CAMERAS__VAL=0, CAMERAS__TEST=0, CAMERAS__WIDTH=SMALL, CAMERAS__HEIGHT=SMALL,
        PASSES__COVERAGE_SAMPLES=4, PASSES__RASTER="cycles-direct", PASSES__RASTER_SAMPLES=1,
    )  # fmt: skip
    command = pipeline("prepare", folder / "many.dnr", str(SCENE))
    reading = measure("passes of many candidates", command, given, timeout)
    tell(reading)
    return [reading]


def many_candidates(folder: Path, count: int, timeout: float) -> list[Reading]:
    """``count`` pass files of a sphere, chosen from and read."""
    write_passes(folder / "candidates", count)
    readings = []
    for name in ("selection", "reading as step 1 does"):
        readings.append(measure(name, own_step(name, folder, count), {}, timeout))
        tell(readings[-1])
    return readings


def cameras_of(count: int) -> list[View]:
    """Views of a dome around the unit sphere."""
    from dnrpipe.core.cameras import make_cameras
    from dnrpipe.core.scene_records import Bounds, SceneSummary
    from dnrpipe.core.settings import CameraSettings

    sphere = Bounds(min=(-1, -1, -1), max=(1, 1, 1), center=(0, 0, 0), radius=1)
    summary = SceneSummary.model_construct(bounds=sphere, cameras=[])  # no more is asked of it
    chosen = CameraSettings(source="dome", train=count, val=0, test=0, width=SMALL, height=SMALL)
    return make_cameras(summary, chosen)["train"]


def write_passes(folder: Path, count: int) -> None:
    """Pass files in the contract's format, of the unit sphere with its longitude and latitude as UVs."""
    from dnrtrain.exr import write_exr

    folder.mkdir(parents=True)
    for view in cameras_of(count):
        towards = view.ray_directions().astype(np.float64)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        middle = towards @ view.position
        inside = middle**2 - (view.position @ view.position - 1)
        mask = (inside > 0).astype(np.float32)
        distance = np.where(inside > 0, -middle - np.sqrt(np.maximum(inside, 0)), 0)
        point = (view.position + towards * distance[..., None]) * mask[..., None]
        channels = {f"{kind}.{axis}": point[..., i] for kind in ("normal", "position") for i, axis in enumerate("XYZ")}
        channels |= {
            "depth.Z": (view.position - point) @ view.matrix[:3, 2] * mask,
            "uv.U": (np.arctan2(point[..., 1], point[..., 0]) / (2 * np.pi) + 0.5) * mask,
            "uv.V": np.clip(point[..., 2] / 2 + 0.5, 0, 1) * mask,
            "mask": mask,
            "coverage": mask,
            "object.Id": mask,
            **{colour: (0.5 + 0.5 * point[..., i]) * mask for i, colour in enumerate("RGB")},
            "A": mask,
        }
        write_exr(folder / f"{view.name}.exr", {k: v.astype(np.float32) for k, v in channels.items()}, {})


def choose(folder: Path, count: int) -> None:
    """All rules that need no training choose 25 views."""
    from dnrtrain.selector.policies import untrained
    from dnrtrain.selector.protocol import Candidates
    from dnrtrain.selector.visibility import read_visibility

    views = cameras_of(count)
    files = [folder / "candidates" / f"{view.name}.exr" for view in views]
    candidates = Candidates.of_views(views, read_visibility(files, views))
    for policy in ("coverage", "kmedoids", "farthest", "random"):
        rule = untrained(policy)
        assert rule is not None
        started = time.monotonic()
        choice = rule.choose(candidates, 25, 0, lambda weighed: None)
        assert len(set(choice.views)) == 25
        print(f"{policy}: {time.monotonic() - started:.1f} s", file=sys.stderr, flush=True)


def read_all(folder: Path, count: int) -> None:
    """All candidates in memory, as step 1 has them."""
    from dnrtrain.contract import SceneFrame
    from dnrtrain.dataset import load_views

    views = cameras_of(count)
    files = [folder / "candidates" / f"{view.name}.exr" for view in views]
    frame = SceneFrame(near=0.1, far=10.0, center=(0.0, 0.0, 0.0), radius=1.0)
    assert len(load_views(files, None, frame, cameras=views, folder=folder)) == count


def trace_smoothly(workspace: Path) -> None:
    """The only candidate at one sample, denoised, by the worker that does it.

    With two samples of the denoiser's guides instead of 64: the launches come one after the other, one sample each, so
    that their number costs time and no memory.
    """
    from dnrpipe.raytrace import pictures, tracer
    from dnrpipe.raytrace.variants import choose_variant
    from dnrtrain.contract import read_cameras

    pictures.AUXILIARY_SPP = 2
    choice = choose_variant("auto")
    os.environ.update(choice.environment)
    (view,) = read_cameras(workspace / "cameras" / "train.json")
    common = {"bundle": str(workspace / "scene" / "scene.xml"), "variant": choice.variant, "threads": 0}
    output = str(workspace.parent / "denoised.exr")
    task = {"view": view.model_dump(mode="json"), "output": output, "spp": 1, "max_depth": 4, "seed": 1}
    numbers = tracer.Worker(common)({**task, "fingerprint": "f", "denoise": True})
    assert numbers["denoised"] and Path(output).exists()


def tell(reading: Reading) -> None:
    said = f"{reading.name}: {reading.gib:.2f} GiB, {reading.seconds:.0f} s {reading.problem}".rstrip()
    print(said, file=sys.stderr, flush=True)


def table(readings: list[Reading]) -> str:
    lines = ["| step | peak, GiB | bound | seconds |", "|---|---|---|---|"]
    lines += [f"| {r.name} | {r.gib:.2f} | {BOUNDS[r.name]:g} | {r.seconds:.0f} |" for r in readings]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=4096)
    parser.add_argument("--passes", type=int, default=2000)
    parser.add_argument("--candidates", type=int, default=10_000)
    parser.add_argument("--timeout", type=float, default=3600, help="seconds for one step")
    parser.add_argument("--only", choices=("view", "passes", "selection"))
    parser.add_argument("--step", choices=tuple(BOUNDS), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.step:
        if options.step == "ray tracing with the denoiser":
            trace_smoothly(options.folder)
        else:
            (choose if options.step == "selection" else read_all)(options.folder, options.candidates)
        return 0
    readings: list[Reading] = []
    with tempfile.TemporaryDirectory(prefix="dnrpipe-memory-") as scratch:
        folder = Path(scratch)
        if options.only in (None, "view"):
            readings += large_view(folder, options.side, options.timeout)
        if options.only in (None, "passes"):
            readings += many_passes(folder, options.passes, options.timeout)
        if options.only in (None, "selection"):
            readings += many_candidates(folder, options.candidates, options.timeout)
    print(table(readings))
    return 1 if any(reading.problem for reading in readings) else 0


if __name__ == "__main__":
    raise SystemExit(main())
