"""``results.json``: all cells of an ablation with the command, commit, machine and date that made them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..cells.measure import METRICS, mean_of
from ..cells.provenance import made_by, read_made
from ..cells.tasks import read_cell
from .rows import ROWS, Row

SCHEMA = 1


def gather(cells: Mapping[tuple[str, str, int], Path], rows: Sequence[Row], facts: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that tables and plots need; cells whose file is missing are left out.

    Args:
        cells: (scene, row, seed) -> the cell's file. Rows of equal settings share one file.
        facts: what the caller knows of the run (preset, budget, seconds, seeds, scenes).
    """
    found = []
    for (scene, row, seed), path in cells.items():
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
        "schema": SCHEMA,
        **made_by(),
        **facts,
        "rows": {row.name: row.what for row in rows},
        "cells": found,
    }


def read_results(path: Path) -> dict[str, Any]:
    """Results that `gather` made. Raises UserError: missing, damaged or of another schema."""
    return read_made(path, "ablate", SCHEMA, "cells")


def known_rows(results: Mapping[str, Any]) -> list[str]:
    """Names of the rows that have cells, in table order."""
    present = {cell["row"] for cell in results["cells"]}
    return [name for name in ROWS if name in present]
