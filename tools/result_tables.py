"""Write the generated parts of docs: rows from the code, tables from committed results.

A part stands between ``<!-- rows -->`` or ``<!-- KIND FILE -->``, FILE in docs/, and ``<!-- end -->``.
Kinds: results (of `dnrpipe ablate`), frames (of tools.bench_frames), noise (of tools.bench_noise),
frontier (of `dnrpipe frontier`), plan-check (of tools.plan_check), selection (of `dnrpipe bench-select`),
selections (of several of its runs together: FILE,FILE), plan-equal (of tools.plan_equal),
untrained (of tools.bench_untrained), device (of tools.bench_device), scaling (of tools.bench_ray),
evaluations (of tools.evaluations).

python -m tools.result_tables [--check] docs/ablation.md docs/*.md
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.bench_device import markdown as device_markdown
from tools.bench_frames.document import overview as frames_overview
from tools.bench_noise.document import markdown as noise_markdown
from tools.bench_ray import markdown as scaling_markdown
from tools.bench_shots import markdown as shots_markdown
from tools.bench_untrained import markdown as untrained_markdown
from tools.evaluations import markdown as evaluations_markdown
from tools.plan_check import markdown as check_markdown
from tools.plan_equal import markdown as equal_markdown

from dnrpipe.core.settings import resolve
from dnrpipe.studies.ablation.ablation_tables import markdown, read_results
from dnrpipe.studies.ablation.rows import GROUPS, ROWS, settings_of
from dnrpipe.studies.frontier.frontier_report import markdown as frontier_markdown
from dnrpipe.studies.frontier.records import read_frontier
from dnrpipe.studies.selectbench.bench_tables import markdown as selection_markdown
from dnrpipe.studies.selectbench.bench_tables import read_results as selection_results
from dnrpipe.studies.selectbench.bench_tables import together as selections_markdown

KINDS = (
    "rows|device|results|frames|noise|frontier|plan-check|plan-equal|selections?|untrained|scaling|shots|evaluations"
)
PART = re.compile(rf"(<!-- ({KINDS})(?: (\S+))? -->\n).*?(<!-- end -->)", re.DOTALL)


def rows_table() -> str:
    """All rows: name, what they are, how their views are chosen, groups they belong to."""
    lines = ["| row | what | views | groups |", "| --- | --- | --- | --- |"]
    base = resolve("draft", {}, environment={})
    for name, row in ROWS.items():
        groups = ", ".join(group for group, names in GROUPS.items() if name in names and group != "all")
        views = "all" if row.everything else settings_of(row, base, {}).select.policy
        lines.append(f"| `{name}` | {row.what} | {views} | {groups} |")
    return "\n".join(lines)


def generate(text: str, folder: Path) -> str:
    """``text`` with every marked part made anew. Raises UserError for results that cannot be read."""

    def part(match: re.Match[str]) -> str:
        kind, file = match[2], match[3]
        if kind == "rows":
            body = rows_table()
        elif kind == "results":
            body = markdown(read_results(folder / file)).rstrip()
        elif kind == "frontier":
            body = lowered(frontier_markdown(read_frontier(folder / file)))
        elif kind == "selection":
            body = lowered(selection_markdown(selection_results(folder / file), pictures=False))
        elif kind == "selections":
            body = lowered(selections_markdown([selection_results(folder / name) for name in file.split(",")]))
        else:
            body = OF_JSON[kind](json.loads((folder / file).read_text(encoding="utf-8")))
        return f"{match[1]}{body}\n{match[4]}"

    return PART.sub(part, text)


OF_JSON: dict[str, Callable[[Any], str]] = {
    "frames": lambda found: "\n".join(frames_overview(found)),
    "noise": noise_markdown,
    "device": device_markdown,
    "shots": shots_markdown,
    "untrained": untrained_markdown,
    "scaling": scaling_markdown,
    "evaluations": evaluations_markdown,
    "plan-equal": equal_markdown,
    "plan-check": check_markdown,
}
"""Kinds that are made of a JSON file alone."""


def lowered(text: str) -> str:
    """A page's own tables, one heading lower and without its title."""
    _, _, body = text.partition("\n")
    return body.strip().replace("\n### ", "\n#### ").replace("\n## ", "\n### ")


def main(arguments: list[str]) -> int:
    stale = []
    for path in (Path(argument) for argument in arguments if argument != "--check"):
        old = path.read_text(encoding="utf-8")
        new = generate(old, path.parent)
        if old == new:
            continue
        stale.append(path)
        if "--check" in arguments:
            print(f"{path} is out of date: run `make docs`", file=sys.stderr)
        else:
            path.write_text(new, encoding="utf-8")
    return 1 if stale and "--check" in arguments else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
