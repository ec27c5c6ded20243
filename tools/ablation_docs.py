"""Write the generated parts of docs/ablation.md: the rows from the code, the tables from committed results.

A part stands between ``<!-- rows -->`` or ``<!-- results FILE -->`` (FILE beside docs/) and ``<!-- end -->``.

python tools/ablation_docs.py [--check] docs/ablation.md
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from dnrpipe.ablation.results import read_results
from dnrpipe.ablation.rows import GROUPS, ROWS
from dnrpipe.ablation.tables import markdown

PART = re.compile(r"(<!-- (rows|results (\S+)) -->\n).*?(<!-- end -->)", re.DOTALL)


def rows_table() -> str:
    """All rows: name, what they are, how their views are chosen, groups they belong to."""
    lines = ["| row | what | views | groups |", "| --- | --- | --- | --- |"]
    for name, row in ROWS.items():
        groups = ", ".join(group for group, names in GROUPS.items() if name in names and group != "all")
        lines.append(f"| `{name}` | {row.what} | {row.views} | {groups} |")
    return "\n".join(lines)


def generate(text: str, folder: Path) -> str:
    """``text`` with every marked part made anew. Raises UserError for results that cannot be read."""

    def part(match: re.Match[str]) -> str:
        body = rows_table() if match[2] == "rows" else markdown(read_results(folder / match[3])).rstrip()
        return f"{match[1]}{body}\n{match[4]}"

    return PART.sub(part, text)


def main(arguments: list[str]) -> int:
    path = Path(arguments[-1])
    old = path.read_text(encoding="utf-8")
    new = generate(old, path.parent)
    if "--check" in arguments:
        if old != new:
            print(f"{path} is out of date: run `make docs`", file=sys.stderr)
            return 1
        return 0
    path.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
