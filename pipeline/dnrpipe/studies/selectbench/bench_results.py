"""``results.json``: all cells with the command, commit, machine and date that made them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..cells.measure import METRICS, mean_of
from ..cells.provenance import made_by, read_made
from ..cells.tasks import read_cell
from .bench import Bench, Place, PlannedCell, read_choice
from .pools import Pool

SCHEMA = 1


def gather(bench: Bench, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that tables and plots need; cells whose file is missing are left out."""
    pools = {(pool.scene, pool.name): pool for pool in bench.pools}
    cells = [
        _line(bench, pools[place.scene, place.pool], place, cell)
        for place, cell in bench.cells.items()
        if cell.task.output.exists()
    ]
    return {
        "schema": SCHEMA,
        **made_by(),
        **facts,
        "policies": {contender.name: contender.what for contender in bench.request.policies},
        "cells": cells,
    }


def _line(bench: Bench, pool: Pool, place: Place, planned: PlannedCell) -> dict[str, Any]:
    """One cell: metrics as means over the test views, and the seconds of each part.

    select_seconds: choosing, step 1 included where it chooses; view_seconds: tracing the views and their base images;
    train_seconds: step 2, and step 1 where it only gives the start; total_seconds: all of them.
    """
    cell, choice = read_cell(planned.task.output), read_choice(planned.choice)
    training, clock = cell.training, bench.clock
    assert training is not None  # every cell has a network
    step1 = training.step1
    chooses = step1 is not None and step1.key == choice.key
    train = getattr(training.step2, clock) + (getattr(step1, clock) if step1 and not chooses else 0.0)
    seconds = {
        "select_seconds": getattr(choice, clock),
        "view_seconds": bench.view_seconds(pool, cell.views),
        "train_seconds": train,
    }
    return {
        **asdict(place),
        "key": cell.key,
        **{name: mean_of(cell.tests, name) for name in METRICS},
        "views": choice.views,
        **{name: round(value, 3) for name, value in seconds.items()},
        "total_seconds": round(sum(seconds.values()), 3),
        "select_peak_mb": choice.peak_mb and round(choice.peak_mb),
        "epochs": training.epochs,
        "steps": training.step2.steps,
        "commit": cell.code["commit"],
    }


def read_results(path: Path) -> dict[str, Any]:
    """Results that `gather` made. Raises UserError: missing, damaged or of another schema."""
    return read_made(path, "bench-select", SCHEMA, "pools")
