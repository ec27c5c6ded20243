"""How far off `dnrpipe plan` is: its predictions against what `dnrpipe frontier` measured in the same workspace.

    dnrpipe plan -w scene.dnr && dnrpipe frontier -w scene.dnr
    python -m tools.plan_check scene.dnr ... --out docs/results/plan-check.json

Seconds are processor seconds of a stage, which other work on the machine does not stretch. The PSNR is predicted with
the prior refitted without the scene (``tools.plan_prior``), so that it has not seen what it predicts.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path
from typing import Any

from tools.plan_prior import read_cells, without

from dnrpipe.ablation.results import made_by
from dnrpipe.errors import UserError
from dnrpipe.frontier.command import read_frontier
from dnrpipe.planning.command import make_predictor
from dnrpipe.planning.pilot import read_pilot
from dnrpipe.session import resolve_settings
from dnrpipe.workspace import Workspace
from dnrtrain.atomic import write_json


def check(root: Path, scene: str, cells: Path) -> list[dict[str, Any]]:
    """A row per point of the frontier: predicted and actual. Raises UserError: no pilot, or no frontier."""
    workspace = Workspace.open(root)
    pilot = read_pilot(workspace)
    if pilot is None:
        raise UserError(f"{root}: has no pilot; run `dnrpipe plan -w {root}`")
    results = read_frontier(root / "frontier" / "results.json")
    prior = without(read_cells(cells), scene, str(cells))
    predictor = make_predictor(workspace, resolve_settings(workspace, {}, None), pilot, prior)
    cores, threads = results["cores"], results["threads"]
    rows = []
    for point in results["points"]:
        if point["kind"] != "ours":
            continue
        choice = predictor.choice(point["views"], point["spp"], point["steps"])
        traced = predictor.processor.raytrace(choice.views, choice.spp) - predictor.processor.light()
        trained = predictor.processor.finetune(choice.steps)
        parts = point["parts"]
        actual = (cores * (parts["tracing"] + parts["base images"]), threads * parts["training"])
        psnr = predictor.predict(choice).psnr
        rows.append(
            {
                "scene": scene,
                "name": point["name"],
                "tracing": [round(traced, 2), round(actual[0], 2)],
                "training": [round(trained, 2), round(actual[1], 2)],
                "total": [round(traced + trained, 2), round(sum(actual), 2)],
                "psnr": [round(psnr.expected, 2), round(point["psnr"], 2)],
                "inside": psnr.low <= point["psnr"] <= psnr.high,
            }
        )
    return rows


def markdown(record: dict[str, Any]) -> str:
    """Predicted and actual side by side, medians below."""
    lines = [
        "| scene | point | tracing, CPU s | actual | training, CPU s | actual | PSNR, dB | actual |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in record["rows"]:
        cells = [f"{value:.1f}" for name in ("tracing", "training", "psnr") for value in row[name]]
        lines.append(f"| {row['scene']} | {row['name']} | {' | '.join(cells)} |")
    rows = record["rows"]
    off = {
        name: statistics.median(abs(r[name][0] / r[name][1] - 1) for r in rows)
        for name in ("tracing", "training", "total")
    }
    lost = statistics.median(abs(r["psnr"][0] - r["psnr"][1]) for r in rows)
    inside = sum(r["inside"] for r in rows)
    lines += [
        "",
        f"Median error: tracing {100 * off['tracing']:.0f} %, training {100 * off['training']:.0f} %, both together"
        f" {100 * off['total']:.0f} %; PSNR {lost:.2f} dB, {inside} of {len(rows)} inside their interval.",
    ]
    return "\n".join(lines)


def main() -> int:
    """Exit code 2 where a workspace cannot be checked."""
    parser = argparse.ArgumentParser(prog="python -m tools.plan_check", description=__doc__)
    parser.add_argument("workspaces", nargs="+", metavar="[SCENE=]WORKSPACE", help="with plan/ and frontier/")
    parser.add_argument("--cells", type=Path, default=Path("docs/results/plan-prior.json"))
    parser.add_argument("--out", type=Path, help="JSON of all rows")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    try:
        for text in options.workspaces:
            scene, _, root = text.rpartition("=")
            path = Path(root)
            rows += check(path, scene or path.name.removesuffix(".dnr"), options.cells)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    record = {**made_by(), "command": "python -m tools.plan_check " + " ".join(sys.argv[1:]), "rows": rows}
    if options.out:
        write_json(options.out, record)
    print(markdown(record))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
