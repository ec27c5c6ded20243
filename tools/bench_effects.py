"""What the effect plan saves: it against "everything on", on the benchmark scenes, in one run (`make bench-effects`).

Everything on is Mitsuba's ``volpath`` at depth 32 with all passes (its ``aov`` integrator: albedo, depth, position,
normals, UV). Both pictures are rendered from the same bundle with the same seeds, view by view in turn. ``lean`` is
the ratio without the passes. CPU seconds of rendering, kernels compiled before.

    error     RMSE of the expected pictures (display space over white): what the plan leaves out. Free of noise.
    noise     RMSE of each picture's own noise at these samples: equal where the plan's picture is as good
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from dnrpipe.core.console import Console
from dnrpipe.core.workspace import Source, Workspace, file_sha256
from dnrpipe.effects.store import pilot_views, trace_config, variant_for
from dnrpipe.stages.effect_plan import resolve_plan, run_pilots
from dnrpipe.stages.prepare import scene_and_views
from dnrpipe.stages.session import resolve_settings
from dnrpipe.stages.stage import Run
from dnrtrain.atomic import write_json

EVERYTHING = {"integrator": "volpath", "max_depth": 32, "passes": True}


def bench(scene: Path, folder: Path, spp: int) -> dict[str, Any]:
    """One scene: converts it, runs the pilot, compares."""
    workspace = Workspace.create(folder / f"{scene.stem}.dnr", Source(path=str(scene), sha256=file_sha256(scene)))
    settings = resolve_settings(workspace, {"cameras": {"train": 8, "val": 0, "test": 0}}, None)
    run = Run(workspace, settings, Console(quiet=True), id="bench")
    scene_and_views(run)
    started = time.monotonic()
    plan = resolve_plan(run)
    pilot = time.monotonic() - started
    choice = variant_for(plan, settings)
    config = trace_config(workspace, plan, choice.variant)
    everything = {**config, **EVERYTHING}
    views = pilot_views(workspace, settings, plan)
    pairs = [everything, {**everything, "passes": False}]
    tasks = [
        {"kind": "compare", "with_effect": pair, "without_effect": config, "views": views, "spp": spp} for pair in pairs
    ]
    answer, lean = run_pilots(tasks, choice, run, scene.stem, run.log)
    return {
        "scene": scene.stem,
        "integrator": plan.integrator,
        "depth": plan.max_depth,
        "ratio": answer["seconds_with"] / answer["seconds_without"],
        "ratio_lean": lean["seconds_with"] / lean["seconds_without"],
        "seconds_everything": answer["seconds_with"],
        "seconds_plan": answer["seconds_without"],
        "error": answer["error"]["mean"],
        "error_half_width": answer["error"]["half_width"],
        "noise_everything": answer["noise_with"],
        "noise_plan": answer["noise_without"],
        "pilot_seconds": pilot,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="*", type=Path, help="default: blender_scenes/*.blend")
    parser.add_argument("--spp", type=int, default=16, help="samples of each half (default 16)")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    options = parser.parse_args(arguments)
    here = Path(__file__).resolve().parents[1] / "blender_scenes"
    scenes = [scene.resolve() for scene in options.scenes] or sorted(here.glob("*.blend"))
    rows = []
    print(f"{'scene':12} {'plan':22} {'ratio':>6} {'lean':>6} {'error':>14} {'noise all/plan':>16} {'pilot':>7}")
    with tempfile.TemporaryDirectory(prefix="dnrpipe-bench-") as folder:
        for scene in scenes:
            row = bench(scene, Path(folder), options.spp)
            rows.append(row)
            print(
                f"{row['scene']:12} {row['integrator'] + ' ' + str(row['depth']):22} {row['ratio']:5.2f}x"
                f" {row['ratio_lean']:5.2f}x"
                f" {row['error']:6.2%} ±{row['error_half_width']:6.2%}"
                f" {row['noise_everything']:7.2%} {row['noise_plan']:7.2%} {row['pilot_seconds']:6.1f}s",
                flush=True,
            )
    mean = statistics.geometric_mean(row["ratio"] for row in rows)
    print(f"geometric mean {mean:.2f}x, arithmetic mean {statistics.fmean(row['ratio'] for row in rows):.2f}x")
    if options.json:
        write_json(options.json, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
