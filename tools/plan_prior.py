"""What `dnrpipe plan` knows before its pilot: measure a few cells on the benchmark scenes, fit the shared parameters.

    python -m tools.plan_prior sweep --out .cache/prior [--scenes a,b]   # minutes a scene; goes on where it stopped
    python -m tools.plan_prior fit docs/results/plan-prior.json          # -> pipeline/dnrpipe/planning/prior.json

``sweep`` trains the default model on each scene with few and many views, steps and samples, and keeps the results of
all scenes in ``OUT/cells.json``. ``fit`` reads such a file, fits :mod:`dnrpipe.planning.quality`, leaves every scene
out in turn, and prints how far off it is then.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from dnrpipe.ablation.results import gather
from dnrpipe.ablation.rows import Row
from dnrpipe.ablation.run import Ablation, Request
from dnrpipe.ablation.scenes import BENCHMARK, find_scenes
from dnrpipe.console import Console
from dnrpipe.settings import resolve
from dnrtrain.atomic import write_json

GRID = ((6, 16, 25), (6, 16, 67), (25, 16, 6), (25, 16, 16), (25, 4, 16))
"""(views, samples per pixel, epochs): the pilot's own corner first."""
SETTINGS: dict[str, Any] = {
    "cameras": {"test": 6, "val": 0},
    "raytrace": {"evaluation_spp": 256},
    "select": {"policy": "farthest"},
}


def rows() -> list[Row]:
    """The grid as rows of an ablation, and the base image alone."""
    found = [
        Row(
            f"{views}v-{spp}spp-{epochs}e",
            f"{views} views, {spp} spp, {epochs} epochs",
            "dnr",
            {"finetune": {"step2": {"epochs": epochs}}},
            budget=views,
            spp=spp,
        )
        for views, spp, epochs in GRID
    ]
    return [*found, Row("base", "the base image alone, no network", "dnr", network=False)]


def sweep(scenes: str | None, out: Path, jobs: int) -> None:
    """Scene after scene; ``out/cells.json`` holds those that are done."""
    base = resolve("draft", SETTINGS, environment={})
    known = {cell["key"]: cell for cell in _read(out / "cells.json")["cells"]} if (out / "cells.json").exists() else {}
    facts = {"settings": SETTINGS, "preset": "draft", "spp": {row.name: row.spp for row in rows() if row.spp}}
    for source in find_scenes(scenes or ",".join(BENCHMARK)):
        request = Request([source], rows(), 1, base, {}, None, out, jobs)
        run = Ablation(request, Console())
        run.run()
        files = {place: out / "cells" / place[0] / f"{key}.json" for place, key in run.cells.items()}
        results = gather(files, request.rows, facts)
        known |= {cell["key"]: cell for cell in results["cells"]}
        results |= {"command": "python -m tools.plan_prior " + " ".join(sys.argv[1:])}
        write_json(out / "cells.json", results | {"cells": list(known.values())})


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def main() -> int:
    """The two verbs of the module's docstring."""
    parser = argparse.ArgumentParser(prog="python -m tools.plan_prior", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    first = verbs.add_parser("sweep")
    first.add_argument("--scenes", help="names, comma-separated (default: the ten benchmark scenes)")
    first.add_argument("--out", type=Path, default=Path(".cache/prior"))
    first.add_argument("--jobs", type=int, default=0)
    options = parser.parse_args()
    sweep(options.scenes, options.out, options.jobs)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
