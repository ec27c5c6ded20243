"""What each point of the frontier cost before its first frame, what each frame costs, and when it pays.

    total(N) = upfront + N * frame
    N*       = upfront / (frame of path tracing at equal PSNR - frame)

Processor seconds, which other work on the machine does not stretch: tracing, light and base images over the cores (they
keep all of them busy), training over its cell's threads. Both sides need the scene converted, so that is left out;
ours also pays for the passes of all candidates.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

from ...core.ledger import break_even_frames, total, upfront_work
from ...stages.base_images import RENDERED
from ..ablation.ablate import Ablation
from ..ablation.rows import Row
from ..cells.measure import METRICS, mean_of, written_seconds
from ..cells.scenes import Scene, base_files, traced_split
from ..frames.pareto_front import Point as CostAndQuality
from ..frames.pareto_front import crossover, frontier
from .records import BaselinePoint, Metric, Point

HIGHER_IS_BETTER: dict[Metric, bool] = {"psnr": True, "ssim": True, "lpips_vgg": False, "flip": False}


def point_of(swept: Ablation, scene: Scene, row: Row, seed: int, base_ms: float | None, cores: int) -> Point | None:
    """A row's cell with its costs; None where the cell is not made yet.

    base_ms: of a base image by the baselines' clock; None: as the cell measured it. cores: that ray tracing keeps busy.
    """
    task = swept.cells.get((scene.name, row.name, seed))
    if task is None or not task.output.exists():
        return None
    cell = task.result()
    workspace, training = scene.workspace, cell.training
    work = upfront_work(workspace.ledger.read())
    split = traced_split(swept.base, row.spp)
    parts: dict[str, float] = {"passes": 0.0, "tracing": 0.0, "light": 0.0, "base images": 0.0, "training": 0.0}
    if training is not None:
        candidates = {f"train/{name}" for name in scene.train}
        parts["passes"] = total(r for r in work["passes"] if r.name in candidates).cpu_seconds / cores
        parts["tracing"] = sum(written_seconds(workspace.raytraced(split, name)) for name in cell.views) / cores
        on_gpu = cell.device.startswith("cuda")  # the processor's seconds do not say what a GPU took
        parts["training"] = training.seconds if on_gpu else training.cpu_seconds / cell.threads
        files = base_files(workspace, cell.base, "train", cell.views)
        parts["base images"] = sum(map(written_seconds, files)) / cores
    if cell.base == "baked":
        parts["light"] = total(work["light"]).cpu_seconds / cores
    return Point(
        name=f"{row.name}, seed {seed}" if swept.seeds > 1 and row.network else row.name,
        kind=_kind(row),
        seed=seed,
        views=len(cell.views),
        spp=(row.spp or swept.base.raytrace.spp) if training else None,
        steps=training and training.step2.steps,
        parts={name: round(value, 3) for name, value in parts.items()},
        upfront=sum(parts.values()),
        network_ms=cell.frame_ms or 0.0,
        base_ms=(base_ms or cell.base_ms or 0.0) if cell.base in RENDERED else 0.0,
        **{name: mean_of(cell.tests, name) for name in METRICS},  # type: ignore[arg-type]
    )


def _kind(row: Row) -> Literal["ours", "random", "all", "paper", "base"]:
    if not row.network:
        return "base"
    if row.family != "dnr":
        return "paper"
    if row.everything:
        return "all"
    return "random" if row.changes["select"]["policy"] == "random" else "ours"


def settle_frames(points: Sequence[Point]) -> list[Point]:
    """The points with ``frame_ms``: base image and network.

    Points of one model share the network's least milliseconds: they run the same operations, and other work on the
    machine only adds to them.
    """

    def network_ms(point: Point) -> float:
        model = point.kind == "paper"
        return min(p.network_ms for p in points if p.network_ms and (p.kind == "paper") == model)

    frames = [point.base_ms + (network_ms(point) if point.network_ms else 0.0) for point in points]
    return [point.model_copy(update={"frame_ms": ms}) for point, ms in zip(points, frames, strict=True)]


def break_evens(points: Sequence[Point], baselines: Sequence[BaselinePoint]) -> list[Point]:
    """The points with ``baseline_ms`` and ``break_even``, both None where no baseline reaches the point."""
    by_name: dict[str, CostAndQuality] = {one.name: (one.ms, one.psnr) for one in baselines}
    line = [by_name[name] for name in frontier(by_name)]
    found = []
    for point in points:
        ms = crossover(line, point.psnr)
        even = None if ms is None else break_even_frames(point.upfront, ms / 1000, point.frame_ms / 1000)
        found.append(point.model_copy(update={"baseline_ms": ms, "break_even": even}))
    return found


def total_seconds(one: Point | BaselinePoint, frames: int) -> float:
    """Seconds of ``frames`` frames, what comes before them included."""
    return one.upfront + frames * one.ms / 1000


def pareto(everything: Iterable[Point | BaselinePoint], frames: int, metric: Metric = "psnr") -> list[str]:
    """Names of what nothing else beats in both seconds and the metric, cheapest first."""
    sign = 1 if HIGHER_IS_BETTER[metric] else -1
    values = {one.name: (total_seconds(one, frames), getattr(one, metric)) for one in everything}
    return frontier({name: (seconds, sign * value) for name, (seconds, value) in values.items() if value is not None})
