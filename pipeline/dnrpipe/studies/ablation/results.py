"""``results.json``: all cells of an ablation with the command, commit, machine and date that made them."""

from __future__ import annotations

import functools
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import UserError
from .rows import ROWS, Row

SCHEMA = 1
METRICS = ("psnr", "psnr_mask", "ssim", "ssim_mask", "lpips_vgg", "lpips_alex", "flip", "ceiling")
PACKAGES = ("dnrpipe", "torch", "numpy", "mitsuba", "bpy", "flip-evaluator")
SOURCE = Path(__file__).resolve().parents[4]


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
        cell = json.loads(path.read_text(encoding="utf-8"))
        training = cell["training"]
        found.append(
            {
                "scene": scene,
                "row": row,
                "seed": seed,
                "key": cell["key"],
                **{name: mean_of(cell["tests"], name) for name in METRICS},
                "views": len(cell["views"]),
                "epochs": training and training["epochs"],
                "steps": training and training["step2"]["steps"],
                "train_seconds": training and round(training["seconds"], 2),
                "train_cpu_seconds": training and round(training["cpu_seconds"], 2),
                "step1_cpu_seconds": training and training["step1"] and round(training["step1"]["cpu_seconds"], 2),
                "frame_ms": cell["frame_ms"] and round(cell["frame_ms"], 2),
                "base_ms": cell["base_ms"] and round(cell["base_ms"], 2),
                "commit": cell["code"]["commit"],
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
    """Results that :func:`gather` made. Raises UserError: missing, damaged or of another schema."""
    return read_made(path, "ablate", SCHEMA, "cells")


def read_made(path: Path, command: str, schema: int, part: str) -> dict[str, Any]:
    """A results file of ``dnrpipe command``, known by its schema and by having ``part``. Raises UserError: is it not,
    or missing or damaged."""
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; make it with `dnrpipe {command}`") from None
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise UserError(f"{path}: damaged; run `dnrpipe {command}` again") from None
    if not isinstance(results, dict) or results.get("schema") != schema or part not in results:
        raise UserError(f"{path}: not results of this version's `dnrpipe {command}`; run it again")
    return results


def made_by() -> dict[str, Any]:
    """What results say of their making: command, commit, date, machine, versions."""
    return {
        "command": shlex.join(["dnrpipe", *sys.argv[1:]]),
        **code_state(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "versions": versions(),
    }


@functools.cache
def code_state() -> dict[str, Any]:
    """{"commit": hash or None outside of a repository, "dirty": whether tracked files differ from it}."""
    commit = _git("rev-parse", "HEAD")
    return {"commit": commit, "dirty": bool(_git("status", "--porcelain", "--untracked-files=no")) if commit else None}


def machine() -> dict[str, Any]:
    """Processor, cores that this process may use, memory in GiB, operating system."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    return {
        "processor": _processor(),
        "cores": cores,
        "memory_gib": round(memory / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
    }


def versions() -> dict[str, str | None]:
    """Versions of Python and of what decides the figures; None where not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


def known_rows(results: Mapping[str, Any]) -> list[str]:
    """Names of the rows that have cells, in table order."""
    present = {cell["row"] for cell in results["cells"]}
    return [name for name in ROWS if name in present]


def mean_of(tests: list[dict[str, Any]], name: str) -> float | None:
    """Mean of a metric over the test views that have it."""
    values = [test[name] for test in tests if test[name] is not None]
    return round(float(np.mean(values)), 5) if values else None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(SOURCE), *arguments], capture_output=True, text=True, timeout=30, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
