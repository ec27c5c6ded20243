"""The paper's tables at the paper's schedule, 50 + 100 epochs and 25 of 100 candidates, on pictures of 128².

    python -m tools.paper_tables a      # Table I at equal steps, and DNR beside it
    python -m tools.paper_tables b      # quality against the number of traced views
    python -m tools.paper_tables c      # figures 7a, 7b and 7c: further rows of table a

Each is one run of `dnrpipe ablate` or `dnrpipe bench-select` that goes on where it stopped. Its results are added to
those in docs/results/, also after Ctrl-C, so that a table may be made in pieces, also on several machines. What stands
after `--` goes to that command and wins:

    python -m tools.paper_tables a -- --rows paper-table --seeds 1 --first-seed 2
    python -m tools.paper_tables a --size 256 --results paper-steps-256.json      # on a GPU

Cells of another device than the results' own belong in a file of their own, or are told apart in one: ``--mixed``.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

from dnrpipe.core.settings import resolve
from dnrpipe.stages.trainer import torch_device
from dnrpipe.studies.ablation.rows import GROUPS, PAPER_TABLE
from dnrtrain.atomic import write_json

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"
COMMON = ("--preset", "paper-128", "--scenes", "furniture,bricks,microphone", "--seeds", "3")
"""The scenes whose views take least to trace; all take as long to train on."""

FIGURES = ",".join(
    dict.fromkeys(row for name in ("fig7a", "fig7b", "fig7c") for row in GROUPS[name] if row not in PAPER_TABLE)
)
"""The rows of figures 7 that table a lacks."""


@dataclass(frozen=True)
class Table:
    """command: with its arguments. results: the file in docs/results/. folder: of the run, under ``--out``."""

    command: tuple[str, ...]
    results: str
    folder: str


TABLES = {
    "a": Table(("ablate", *COMMON, "--rows", "paper-table,paper-more"), "paper-steps.json", "rows"),
    "b": Table(
        (
            *("bench-select", *COMMON, "--pools", "dome", "--budgets", "5,10,15,25,50,100"),
            *("--policies", "random,farthest,coverage,rl-paper", "--steps", "2500"),
        ),
        "paper-views.json",
        "views",
    ),
    # One with table a, which has the figures' other rows.
    "c": Table(("ablate", *COMMON, "--rows", FIGURES), "paper-steps.json", "rows"),
}

PLACE = ("scene", "row", "pool", "budget", "policy", "seed")
"""What tells the cells of a table apart."""
DEVICE = ("device", "threads")
SAME = ("schema", "preset", "resolution", "seconds", "spp", "budget", "candidates", "precision", "step2_steps")
"""What cells of one table have in common."""


def added(old: dict[str, Any], new: dict[str, Any], *, mixed: bool = False) -> dict[str, Any]:
    """Results with the cells of both, each with its device. Raises ValueError: not of one table.

    Where both have a cell, it is that of ``new``, unless only that of ``old`` is of the results' own device.

    mixed: the cells may be of two devices; device, machine, commit and date of the results are ``old``'s.
    """
    for name in SAME if mixed else (*SAME, *DEVICE):
        if old.get(name) != new.get(name):
            raise ValueError(f"{name} is {old.get(name)} there and {new.get(name)} here")
    places: dict[tuple[Any, ...], dict[str, Any]] = {}
    for of in (old, new):
        for cell in ({"device": of["device"], **cell} for cell in of["cells"]):
            known = places.get(_place(cell), cell)
            if cell["device"] in (old["device"], known["device"]):
                places[_place(cell)] = cell
    whole = {**(old if mixed else new), "cells": list(places.values())}
    whole["seeds"] = len({cell["seed"] for cell in places.values()})
    whole["command"] = "; ".join(dict.fromkeys(part for of in (old, new) for part in of["command"].split("; ")))
    for name in ("scenes", "pools", "budgets", "raster_engines"):
        if name in new:
            whole[name] = list(dict.fromkeys((*old[name], *new[name])))
    for name in ("rows", "policies"):
        if name in new:
            whole[name] = {**old[name], **new[name]}
    return whole


def _place(cell: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(cell.get(name) for name in PLACE)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--out", type=Path, default=Path("paper-tables"), help="where the runs keep their cells")
    parser.add_argument("--size", type=int, help="side of the pictures, and of the neural texture (128)")
    parser.add_argument("--results", help="file name in docs/results/, instead of the table's own")
    parser.add_argument("--mixed", action="store_true", help="add cells of this device to those of another")
    own, more = sys.argv[1:], []
    if "--" in own:
        own, more = own[: own.index("--")], own[own.index("--") + 1 :]
    given = parser.parse_args(own)
    table = TABLES[given.table]
    out, size = given.out / table.folder, []
    if given.size is not None:
        out = out.with_name(f"{table.folder}-{given.size}")
        for key in ("cameras.width", "cameras.height", "model.texture_size"):
            size += ["--set", f"{key}={given.size}"]
    target, made = RESULTS / (given.results or table.results), out / "results.json"
    made.unlink(missing_ok=True)  # another table's, or of a run that this one goes on with
    device = torch_device(resolve("paper-128", {}, environment={}))
    if not given.mixed and target.exists() and (there := json.loads(target.read_text())["device"]) != device:
        print(
            f"{target}: of trainings on {there}, these would be on {device}: name another by --results, or say --mixed",
            file=sys.stderr,
        )
        return 2
    command = [sys.executable, "-m", "dnrpipe.cli", *table.command, *size, *more, "--out", str(out)]
    process = subprocess.Popen(command, start_new_session=True)  # it hears of Ctrl-C and `timeout` once, by us
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: process.terminate())
    code = process.wait()
    if made.exists():
        results = json.loads(made.read_text())
        RESULTS.mkdir(parents=True, exist_ok=True)
        with FileLock(target.with_suffix(".lock")):  # several runs may add to it
            try:
                if target.exists():
                    results = added(json.loads(target.read_text()), results, mixed=given.mixed)
            except ValueError as error:
                print(f"{target}: not of this table ({error}); name another with --results", file=sys.stderr)
                return 2
            write_json(target, results)
        print(f"{len(results['cells'])} cells: {target}")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
