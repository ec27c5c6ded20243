"""What a results file says of its making, and Markdown helpers of the studies' tables."""

from __future__ import annotations

import functools
import json
import platform
import shlex
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from ...core.errors import UserError
from ...core.machine import memory_bytes, processor
from ...workers.view_tasks import worker_count

PACKAGES = ("dnrpipe", "torch", "numpy", "mitsuba", "bpy", "flip-evaluator")
NONE = "–"
SOURCE = Path(__file__).resolve().parents[4]


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
    memory = memory_bytes()
    return {
        "command": shlex.join(["dnrpipe", *sys.argv[1:]]),
        **code_state(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {
            "processor": processor(),
            "cores": worker_count(0),  # that this process may use
            "memory_gib": None if memory is None else round(memory / 2**30, 1),
            "system": f"{platform.system()} {platform.machine()}",
        },
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
    }


@functools.cache
def code_state() -> dict[str, Any]:
    """{"commit": hash or None outside of a repository, "dirty": whether tracked files differ from it}."""
    commit = _git("rev-parse", "HEAD")
    return {"commit": commit, "dirty": bool(_git("status", "--porcelain", "--untracked-files=no")) if commit else None}


def _version(package: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(package)
    return None


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(SOURCE), *arguments], capture_output=True, text=True, timeout=30, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


# -- Markdown ----------------------------------------------------------------------------------------------


def spread(values: Sequence[float], digits: int, *, signed: bool = False) -> str:
    """``mean ± standard deviation`` (of the sample) over seeds; the mean alone where there is one seed."""
    if not values:
        return NONE
    text = f"{statistics.fmean(values):{'+' if signed else ''}.{digits}f}"
    return f"{text} ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else text


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first are right-aligned."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float | None, digits: int) -> str:
    """A table's cell."""
    return "-" if value is None else f"{value:.{digits}f}"


def made_line(results: Mapping[str, Any]) -> str:
    """How the results were made: command, date, commit and those of its cells where they differ, machine, preset."""
    box, state = results["machine"], f"commit {(results['commit'] or 'unknown')[:12]}"
    if results["dirty"]:
        state += " with changes"
    commits = sorted({cell["commit"] for cell in results["cells"] if cell["commit"]})
    if len(commits) > 1:
        state += f" (cells of {len(commits)} commits: {', '.join(commit[:12] for commit in commits)})"
    engines = [engine for engine in results.get("raster_engines", []) if engine]
    drawn = f", rasterised by {' and '.join(engines)}" if engines else ""
    gpu = f", {box['gpu']}" if "gpu" in box else ""
    return (
        f"`{results['command']}`, {results['date'][:10]}, {state}; {box['processor']},"
        f" {box['cores']} cores{gpu}, torch {results['versions']['torch']}. Preset"
        f" {results['preset']}, {results['resolution']}{drawn}"
    )
