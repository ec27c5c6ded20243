"""Check docs/robustness.md: every row names a test that exists; write how many rows and tests there are.

python -m tools.robustness_table [--check] docs/robustness.md
python -m tools.robustness_table --tests docs/robustness.md     # the test functions, for pytest's command line

A row is a line of a table whose last cell is a test in backticks: ``tests/x.py::test_y`` or ``…::test_y[case]``. The
function must exist; a case must stand in the test's module, or in one of scenes that it takes its cases from.
"""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
ROW = re.compile(r"^\| (?P<case>.+?) \| (?P<happens>.+) \| (?P<test>.*?) \|$")
TEST = re.compile(r"^`(?P<file>tests/[\w/]+\.py)::(?P<function>\w+)(?:\[(?P<case>.+)\])?`$")
COUNTS = re.compile(r"(<!-- counts -->\n).*?(<!-- end -->)", re.DOTALL)
SCENES = tuple(
    f"tests/{name}.py"
    for name in ("robust_scenes", *(f"nasty_{kind}" for kind in ("scenes", "materials", "images", "objects")))
)


@dataclass(frozen=True)
class Row:
    """One case: the section it stands in, its words, its test's file, function and case (or None)."""

    section: str
    case: str
    file: str
    function: str
    parameter: str | None


def read_rows(text: str) -> tuple[list[Row], list[str]]:
    """(rows, complaints about lines that are none)."""
    rows, complaints, section = [], [], ""
    for number, line in enumerate(COUNTS.sub("", text).splitlines(), 1):
        if line.startswith("## "):
            section = line[3:]
        match = ROW.match(line)
        if match is None or match["case"] == "case" or set(line) <= set("|- "):
            continue
        test = TEST.match(match["test"])
        if test is None:
            complaints.append(f"line {number}: '{match['case']}' names no test")
        else:
            rows.append(Row(section, match["case"], test["file"], test["function"], test["case"]))
    return rows, complaints


@cache
def _module(file: str) -> tuple[frozenset[str], frozenset[str]]:
    """(test functions, constants as text) of a file; both empty when it is missing."""
    path = REPO / file
    if not path.is_file():
        return frozenset(), frozenset()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    constants = {str(node.value) for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    return frozenset(functions), frozenset(constants)


def complaints_about(rows: list[Row]) -> list[str]:
    """Rows whose test does not exist, and cases that stand twice."""
    found = []
    for row in rows:
        functions, constants = _module(row.file)
        known = constants.union(*(_module(file)[1] for file in SCENES))
        if row.function not in functions:
            found.append(f"'{row.case}': there is no {row.function} in {row.file}")
        elif row.parameter is not None and row.parameter not in known:
            found.append(f"'{row.case}': {row.function} has no case '{row.parameter}'")
    seen = [(row.file, row.function, row.parameter) for row in rows]
    found += [f"{row.function}[{row.parameter}] stands in two rows" for row in rows
              if seen.count((row.file, row.function, row.parameter)) > 1]  # fmt: skip
    return found


def counts(rows: list[Row]) -> str:
    """The table of counts."""
    sections = list(dict.fromkeys(row.section for row in rows))
    lines = ["| section | cases |", "|---|---|"]
    lines += [f"| {section} | {sum(row.section == section for row in rows)} |" for section in sections]
    functions = {(row.file, row.function) for row in rows}
    return "\n".join([*lines, f"| **all** | **{len(rows)}**, by {len(functions)} test functions |"])


def main(arguments: list[str]) -> int:
    (path,) = (Path(argument) for argument in arguments if not argument.startswith("--"))
    text = path.read_text(encoding="utf-8")
    rows, complaints = read_rows(text)
    if "--tests" in arguments:
        print("\n".join(dict.fromkeys(f"{row.file}::{row.function}" for row in rows)))
        return 0
    complaints += complaints_about(rows)
    for complaint in complaints:
        print(f"{path}: {complaint}", file=sys.stderr)
    new = COUNTS.sub(lambda match: f"{match[1]}{counts(rows)}\n{match[2]}", text)
    if new != text:
        if "--check" in arguments:
            complaints.append("stale")
            print(f"{path} is out of date: run python -m tools.robustness_table {path}", file=sys.stderr)
        else:
            path.write_text(new, encoding="utf-8")
    print(counts(rows).splitlines()[-1].replace("*", "").strip("| "))
    return 1 if complaints else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
