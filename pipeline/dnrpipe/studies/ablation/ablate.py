"""`dnrpipe ablate` behind its options: settings, the run, and what it writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json, write_text

from ...core.console import Console
from ...core.settings import resolve
from ...core.workspace import locked
from ..cells.measure import METRICS, mean_of, pictured
from ..cells.request import merged
from ..cells.scenes import find_scenes
from ..cells.tasks import read_cell
from .ablation_plots import contact_sheet, plot
from .ablation_tables import SCHEMA, markdown
from .cell_loop import Ablation, Request
from .rows import choose_rows

SMOKE: dict[str, Any] = {
    "cameras": {"train": 6, "val": 1, "test": 2, "width": 32, "height": 32},
    "passes": {"raster": "cycles-direct", "coverage_samples": 16},
    "raytrace": {"spp": 16, "evaluation_spp": 32, "max_depth": 3},
    "select": {"budget": 3, "step1": {"epochs": 2}},
    "finetune": {"step2": {"epochs": 4}},
}
SMOKE_SCENE, SMOKE_ROWS = "emissive_only", "vanilla,paper"


def run_ablation(
    *,
    scenes: str | None,
    rows: str | None,
    seeds: int,
    preset: str,
    budget: int | None,
    seconds: float | None,
    jobs: int,
    assignments: Sequence[str],
    out: Path,
    smoke: bool,
    console: Console,
) -> dict[str, Any]:
    """Run what is due and write results.json, tables.md, plot.png and pictures/ into ``out`` -> the results.

    Settings come from the preset and these arguments alone, neither from the environment nor from
    dnrpipe.toml: the command that is kept in the results says all.

    Raises:
        UserError: unknown names, settings that do not fit. TasksFailed: some cells failed; the others are written.
    """
    budgeted = {} if budget is None else {"select": {"budget": budget}}
    overrides = merged([SMOKE if smoke else {}, budgeted], assignments)
    request = Request(
        scenes=find_scenes(scenes or (SMOKE_SCENE if smoke else None)),
        rows=choose_rows(rows or (SMOKE_ROWS if smoke else "core")),
        seeds=seeds,
        base=resolve(preset, overrides, environment={}),
        overrides=overrides,
        seconds=seconds,
        out=out,
        jobs=jobs,
    )
    ablation = Ablation(request, console)
    with locked(out, "ablate"):
        try:
            ablation.run()
        finally:
            results = _write(ablation)
    return results


def _gather(ablation: Ablation) -> dict[str, Any]:
    """Everything that tables and plots need; cells whose file is missing are left out."""
    request = ablation.request
    found = []
    for (scene, row, seed), path in ablation.cells.items():
        if not path.exists():
            continue
        cell = read_cell(path)
        training = cell.training
        step1 = training and training.step1
        found.append(
            {
                "scene": scene,
                "row": row,
                "seed": seed,
                "key": cell.key,
                **{name: mean_of(cell.tests, name) for name in METRICS},
                "views": len(cell.views),
                "epochs": training and training.epochs,
                "steps": training and training.step2.steps,
                "train_seconds": training and round(training.seconds, 2),
                "train_cpu_seconds": training and round(training.cpu_seconds, 2),
                "step1_cpu_seconds": step1 and round(step1.cpu_seconds, 2),
                "frame_ms": cell.frame_ms and round(cell.frame_ms, 2),
                "base_ms": cell.base_ms and round(cell.base_ms, 2),
                "commit": cell.code["commit"],
            }
        )
    return {
        **request.facts(SCHEMA),
        "budget": request.base.select.budget,
        "device": ablation.device,
        "threads": ablation.threads,
        "rows": {row.name: row.what for row in request.rows},
        "cells": found,
    }


def _write(ablation: Ablation) -> dict[str, Any]:
    """Results, tables, plot and pictures of the cells that are there."""
    out, results = ablation.request.out, _gather(ablation)
    if not results["cells"]:
        return results
    write_json(out / "results.json", results)
    write_text(out / "tables.md", markdown(results))
    plot(results, out / "plot.png")
    for scene in results["scenes"]:
        folder = out / "cells" / scene
        pictures = [("reference", folder / "truth.png")]
        for cell in results["cells"]:
            if cell["scene"] == scene and cell["seed"] == 0:
                psnr = pictured(read_cell(folder / f"{cell['key']}.json").tests)["psnr"]
                pictures.append((f"{cell['row']} {psnr:.1f} dB", folder / f"{cell['key']}.png"))
        if len(pictures) > 1 and all(path.exists() for _, path in pictures):
            contact_sheet(pictures, out / "pictures" / f"{scene}.png")
    return results
