"""Markdown helpers of the studies' tables."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

NONE = "–"


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


def made_line(results: Mapping[str, Any]) -> str:
    """How the results were made: command, date, commit and those of its cells where they differ, machine, preset."""
    box, state = results["machine"], f"commit {(results['commit'] or 'unknown')[:12]}"
    if results["dirty"]:
        state += " with changes"
    commits = sorted({cell["commit"] for cell in results["cells"] if cell["commit"]})
    if len(commits) > 1:
        state += f" (cells of {len(commits)} commits: {', '.join(commit[:12] for commit in commits)})"
    return (
        f"`{results['command']}`, {results['date'][:10]}, {state}; {box['processor']},"
        f" {box['cores']} cores, torch {results['versions']['torch']}. Preset"
        f" {results['preset']}, {results['resolution']}"
    )
