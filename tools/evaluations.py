"""Evaluations of workspaces side by side: renderers of different kinds on the same test views.

python -m tools.evaluations --out RESULTS.json NAME=WORKSPACE.dnr NAME=WORKSPACE.dnr [--device "NVIDIA ..."]

Each workspace was evaluated (`dnrpipe evaluate`). All but the first are compared with the first, view by view: the
intervals are over views, of one training each.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from dnrpipe.core.errors import UserError
from dnrpipe.core.workspace import Workspace
from dnrpipe.stages.records import METRICS, Metrics, equal_rung
from dnrpipe.studies.cells.intervals import difference, summarise
from dnrpipe.studies.cells.results import made_by, table
from dnrtrain.atomic import write_json
from dnrtrain.records import read

FIGURES = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 4), "lpips_vgg": ("LPIPS VGG", 4), "lpips_alex": ("LPIPS Alex", 4)}
"""Of a view: heading and digits."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", nargs="+", metavar="NAME=WORKSPACE.dnr")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", help="that they were trained on, by its name (default: as the first one says)")
    given = parser.parse_args()
    try:
        found = {name: evaluated(Path(root)) for name, root in (pair.split("=", 1) for pair in given.workspaces)}
    except UserError as error:
        print(f"evaluations: {error}", file=sys.stderr)
        return 2
    command = shlex.join(["python", "-m", "tools.evaluations", *sys.argv[1:]])
    write_json(given.out, {**made_by(), "command": command, "device": given.device, "evaluations": found})
    print(markdown(json.loads(given.out.read_text())))
    return 0


def evaluated(root: Path) -> dict[str, Any]:
    """What a workspace was made by, and its evaluation. Raises UserError: it has none."""
    workspace = Workspace.open(root)
    path = workspace.root / "evaluation" / METRICS
    if not path.exists():
        raise UserError(f"{root}: was not evaluated; run `dnrpipe evaluate -w {root}` first")
    manifest = workspace.manifest
    size = f"{manifest.settings['cameras']['width']}x{manifest.settings['cameras']['height']}"
    return {
        "scene": Path(manifest.source.path).stem,
        "preset": manifest.preset,
        "size": size,
        "metrics": read(path, Metrics).model_dump(mode="json"),
    }


def markdown(results: dict[str, Any]) -> str:
    """A row a renderer; below, the differences to the first with their 95 % intervals (Student's t over views)."""
    found = results["evaluations"]
    names = list(found)
    head = ["renderer", *(title for title, _ in FIGURES.values()), "network, ms/frame", "path tracing as good"]
    rows = []
    for name in names:
        metrics = Metrics.model_validate(found[name]["metrics"])
        rung = None if metrics.baseline_psnr is None else equal_rung(metrics.baseline, metrics.baseline_psnr)
        rival = "none measured" if rung is None else f"{rung.spp} samples, {1000 * rung.seconds:.0f} ms"
        values = [f"{metrics.mean[key]:.{digits}f}" for key, (_, digits) in FIGURES.items()]
        rows.append([name, *values, f"{metrics.neural_ms:.1f}", rival])
    first = found[names[0]]
    for name in names[1:]:
        rows.append([f"{name} − {names[0]}", *(differences(found, names[0], name, key) for key in FIGURES), "", ""])
    views = f"{len(first['metrics']['views'])} test views"
    about = f"{first['scene']}, {first['size']}, {views}, trained on {results['device'] or first['metrics']['device']}"
    return f"`{results['command']}`: {about}.\n\n{table(head, rows)}"


def differences(found: dict[str, Any], first: str, other: str, key: str) -> str:
    """Mean of other - first over the views, with its interval, bold where that leaves out 0."""
    views = [{view["name"]: view[key] for view in found[name]["metrics"]["views"]} for name in (other, first)]
    pairs = {(name, 0): views[0][name] - views[1][name] for name in views[1]}
    return difference(summarise(pairs, pairs=True), FIGURES[key][1])


if __name__ == "__main__":
    raise SystemExit(main())
