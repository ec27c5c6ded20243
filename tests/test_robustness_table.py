"""docs/robustness.md promises what tests hold."""

from __future__ import annotations

from pathlib import Path

from tools.robustness_table import complaints_about, main, read_rows

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "robustness.md"


def test_every_row_has_its_test() -> None:
    rows, complaints = read_rows(DOCUMENT.read_text(encoding="utf-8"))
    assert complaints == [] and complaints_about(rows) == []
    assert sum(row.section.startswith("Numerics") for row in rows) >= 60
    assert main(["--check", str(DOCUMENT)]) == 0


def test_rows_without_a_test_are_noticed() -> None:
    lines = [
        "| a | b | `tests/test_robustness_table.py::test_no_such` |",
        "| a | b | `tests/no_such.py::test_every_row_has_its_test` |",
        "| a | b | to be written |",
    ]
    rows, complaints = read_rows("\n".join(lines))
    assert len(complaints) == 1 and len(complaints_about(rows)) == 2
