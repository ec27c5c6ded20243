"""`dnrpipe ablate` behind its options: settings, the run, and what it writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json, write_text

from ...core.console import Console
from ...core.errors import UserError
from ...core.settings import merge, parse_assignment, resolve
from ...core.workspace import locked
from ..cells.measure import pictured
from ..cells.scenes import find_scenes
from ..cells.tasks import read_cell
from ..cells.worker_pool import check_amounts
from .ablation_plots import contact_sheet, plot
from .ablation_results import gather
from .ablation_tables import markdown
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
    overrides: dict[str, Any] = merge({}, SMOKE) if smoke else {}
    if budget is not None:
        overrides = merge(overrides, {"select": {"budget": budget}})
    for text in assignments:
        overrides = merge(overrides, parse_assignment(text))
    base = resolve(preset, overrides, environment={})
    check_amounts(seconds, seeds, jobs)
    request = Request(
        scenes=find_scenes(scenes or (SMOKE_SCENE if smoke else None)),
        rows=choose_rows(rows or (SMOKE_ROWS if smoke else "core")),
        seeds=seeds,
        base=base,
        overrides=overrides,
        seconds=seconds,
        out=out,
        jobs=jobs,
    )
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: is a file; name a folder")
    facts = {
        "preset": base.preset,
        "resolution": f"{base.cameras.width}x{base.cameras.height}",
        "budget": base.select.budget,
        "seconds": seconds,
        "seeds": seeds,
        "scenes": [path.stem for path in request.scenes],
        "spp": {"training": base.raytrace.spp, "test": base.raytrace.evaluation_spp},
    }
    ablation = Ablation(request, console)
    ablation.check()
    with locked(out, "ablate"):
        try:
            ablation.run()
        finally:
            results = _write(ablation, facts)
    return results


def _write(ablation: Ablation, facts: dict[str, Any]) -> dict[str, Any]:
    """Results, tables, plot and pictures of the cells that are there."""
    request = ablation.request
    results = gather(ablation.cells, request.rows, {**facts, "device": ablation.device, "threads": ablation.threads})
    if not results["cells"]:
        return results
    write_json(request.out / "results.json", results)
    write_text(request.out / "tables.md", markdown(results))
    plot(results, request.out / "plot.png")
    for scene in facts["scenes"]:
        folder = request.out / "cells" / scene
        pictures = [("reference", folder / "truth.png")]
        for cell in results["cells"]:
            if cell["scene"] == scene and cell["seed"] == 0:
                psnr = pictured(read_cell(folder / f"{cell['key']}.json").tests)["psnr"]
                pictures.append((f"{cell['row']} {psnr:.1f} dB", folder / f"{cell['key']}.png"))
        if len(pictures) > 1 and all(path.exists() for _, path in pictures):
            contact_sheet(pictures, request.out / "pictures" / f"{scene}.png")
    return results
