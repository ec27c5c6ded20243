"""What each point of the frontier cost before its first frame, what each frame costs, and when it pays.

    total(N) = upfront + N * frame
    N*       = upfront / (frame of path tracing at equal PSNR - frame)

Processor seconds, which other work on the machine does not stretch: tracing, light and base images over the cores (they
keep all of them busy), training over its cell's threads. Both sides need the scene converted, so that is left out;
ours also pays for the passes of all candidates.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.ledger import break_even_frames, total, upfront_work
from ..ablation.rows import Row
from ..cells.measure import METRICS, mean_of, written_seconds
from ..cells.scenes import base_file, traced_split
from ..frames.pareto_front import Point, crossover, frontier
from .sweep import Frontier

HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips_vgg": False, "flip": False}


def point_of(run: Frontier, row: Row, seed: int, rivals: Mapping[str, Any], cores: int) -> dict[str, Any] | None:
    """A row's cell with its costs; None where the cell is not made yet."""
    key = run.cells.get((run.scene.name, row.name, seed))
    path = run.request.out / "cells" / run.scene.name / f"{key}.json"
    if key is None or not path.exists():
        return None
    cell = json.loads(path.read_text(encoding="utf-8"))
    workspace, training, kind = run.scene.workspace, cell["training"], cell["settings"]["model"]["base"]
    based, work = kind not in ("none", "raster"), upfront_work(workspace.ledger.read())
    split = traced_split(run.request.base, row.spp)
    parts: dict[str, float] = {"passes": 0.0, "tracing": 0.0, "light": 0.0, "base images": 0.0, "training": 0.0}
    if training is not None:
        candidates = {f"train/{name}" for name in run.scene.train}
        parts["passes"] = total(r for r in work["passes"] if r.name in candidates).cpu_seconds / cores
        parts["tracing"] = sum(written_seconds(workspace.raytraced(split, name)) for name in cell["views"]) / cores
        parts["training"] = training["cpu_seconds"] / cell["threads"]
        if based:
            files = [base_file(workspace, kind, "train", name) for name in cell["views"]]
            parts["base images"] = sum(written_seconds(file) for file in files) / cores
    if kind == "baked":
        parts["light"] = total(work["light"]).cpu_seconds / cores
    base_ms = (rivals["base_ms"] or cell["base_ms"] or 0.0) if based else 0.0
    return {
        "name": row.name,
        "kind": _kind(row),
        "seed": seed,
        "views": len(cell["views"]),
        "spp": (row.spp or run.request.base.raytrace.spp) if training else None,
        "steps": training and training["step2"]["steps"],
        "parts": {name: round(value, 3) for name, value in parts.items()},
        "upfront": sum(parts.values()),
        "network_ms": cell["frame_ms"] or 0.0,
        "base_ms": base_ms,
        **{name: mean_of(cell["tests"], name) for name in METRICS},
    }


def settle_frames(points: Sequence[dict[str, Any]]) -> None:
    """Write ``frame_ms`` into every point: base image and network. Points of one model share the network's least
    milliseconds: they run the same operations, and other work on the machine only ever adds to them.
    """
    least: dict[bool, float] = {}
    for point in points:
        if point["network_ms"]:
            paper = point["kind"] == "paper"
            least[paper] = min(point["network_ms"], least.get(paper, point["network_ms"]))
    for point in points:
        network = least[point["kind"] == "paper"] if point["network_ms"] else 0.0
        point["frame_ms"] = point["base_ms"] + network


def _kind(row: Row) -> str:
    if not row.network:
        return "base"
    return "paper" if row.family == "classic" else {"random": "random", "all": "all"}.get(row.views, "ours")


def total_seconds(point: Mapping[str, Any], frames: int) -> float:
    """Seconds of ``frames`` frames, what comes before them included. Rungs have no ``upfront``."""
    return point.get("upfront", 0.0) + frames * point.get("frame_ms", point.get("ms", 0.0)) / 1000


def pareto(results: Mapping[str, Any], frames: int, metric: str = "psnr") -> list[str]:
    """Names of what nothing else beats in both seconds and the metric, cheapest first."""
    sign = 1 if HIGHER_IS_BETTER[metric] else -1
    points: dict[str, Point] = {
        one["name"]: (total_seconds(one, frames), sign * one[metric])
        for one in [*results["points"], *results["rungs"]]
        if one[metric] is not None
    }
    return frontier(points)


def break_evens(points: Sequence[dict[str, Any]], rungs: Sequence[Mapping[str, Any]]) -> None:
    """Write ``rival_ms`` (of path tracing at the point's PSNR) and ``break_even`` (frames) into every point; None where
    the ladder ends below the point, or where a frame is no cheaper."""
    ladder: dict[str, Point] = {rung["name"]: (rung["ms"], rung["psnr"]) for rung in rungs}
    line = [ladder[name] for name in frontier(ladder)]
    for point in points:
        ms = crossover(line, point["psnr"])
        point["rival_ms"] = ms
        point["break_even"] = (
            None if ms is None else break_even_frames(point["upfront"], ms / 1000, point["frame_ms"] / 1000)
        )
