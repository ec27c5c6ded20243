"""``results.json``: all cells with the command, commit, machine and date that made them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..cells.measure import METRICS, mean_of
from ..cells.provenance import made_by, read_made
from .bench import Bench, Place, read_choice

SCHEMA = 1


def gather(bench: Bench, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that tables and plots need; cells whose file is missing are left out."""
    pools = {(pool.scene, pool.name): pool for pool in bench.pools}
    cells = []
    for place, task in bench.cells.items():
        path = Path(task["output"])
        if path.exists():
            cell = json.loads(path.read_text(encoding="utf-8"))
            cells.append(
                _line(bench, place, task, cell, bench.view_seconds(pools[place.scene, place.pool], cell["views"]))
            )
    return {
        "schema": SCHEMA,
        **made_by(),
        **facts,
        "policies": {contender.name: contender.what for contender in bench.request.policies},
        "cells": cells,
    }


def _line(
    bench: Bench, place: Place, task: dict[str, Any], cell: dict[str, Any], view_seconds: float
) -> dict[str, Any]:
    """One cell: metrics as means over the test views, and the seconds of each part.

    select_seconds: choosing, step 1 included where it chooses; view_seconds: tracing the views and their base images;
    train_seconds: step 2, and step 1 where it only gives the start; total_seconds: all of them.
    """
    clock = "cpu_seconds" if bench.worker_pool.device == "cpu" else "seconds"
    choice = json.loads(Path(task["choice"]).read_text(encoding="utf-8"))
    training = cell["training"]
    chooses = training["step1"] is not None and training["step1"]["key"] == choice["key"]
    train = training["step2"][clock] + (training["step1"][clock] if training["step1"] and not chooses else 0.0)
    seconds = {"select_seconds": choice[clock], "view_seconds": view_seconds, "train_seconds": train}
    return {
        **asdict(place),
        "key": cell["key"],
        **{name: mean_of(cell["tests"], name) for name in METRICS},
        "views": read_choice({"output": task["choice"]})["views"],
        **{name: round(value, 3) for name, value in seconds.items()},
        "total_seconds": round(sum(seconds.values()), 3),
        "select_peak_mb": choice.get("peak_mb") and round(choice["peak_mb"]),
        "epochs": training["epochs"],
        "steps": training["step2"]["steps"],
        "commit": cell["code"]["commit"],
    }


def read_results(path: Path) -> dict[str, Any]:
    """Results that `gather` made. Raises UserError: missing, damaged or of another schema."""
    return read_made(path, "bench-select", SCHEMA, "pools")
