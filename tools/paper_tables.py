"""The paper's tables at the paper's schedule, 50 + 100 epochs and 25 of 100 candidates, on pictures of 128².

    python -m tools.paper_tables a      # Table I at equal steps, and DNR beside it
    python -m tools.paper_tables b      # quality against the number of traced views
    python -m tools.paper_tables c      # figures 7a, 7b and 7c

Each is one run of `dnrpipe ablate` or `dnrpipe bench-select` that goes on where it stopped; its results are copied to
docs/results/, also after Ctrl-C. What stands after `--` goes to that command, before what stands here:

    python -m tools.paper_tables a -- --seeds 1 --scenes furniture
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"
COMMON = ("--preset", "paper-128", "--scenes", "furniture,bricks,microphone", "--seeds", "3")
"""The scenes whose views take least to trace; all take the same to train on."""


@dataclass(frozen=True)
class Table:
    """command: with its arguments. results: the file in docs/results/. folder: of the run, under ``--out``."""

    command: tuple[str, ...]
    results: str
    folder: str


TABLES = {
    "a": Table(("ablate", *COMMON, "--rows", "paper-table,paper-more"), "paper-steps.json", "rows"),
    "b": Table(
        (
            *("bench-select", *COMMON, "--pools", "dome", "--budgets", "5,10,15,25,50,100"),
            *("--policies", "random,farthest,coverage,rl-paper", "--steps", "2500"),
        ),
        "paper-views.json",
        "views",
    ),
    # In the folder of table a, whose rows `paper`, `paper-uv` and `paper-random` it shares.
    "c": Table(("ablate", *COMMON, "--rows", "fig7a,fig7b,fig7c"), "paper-figure7.json", "rows"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--out", type=Path, default=Path("paper-tables"), help="where the runs keep their cells")
    parser.add_argument("more", nargs="*", help="further options of the command")
    given = parser.parse_args()
    table = TABLES[given.table]
    out = given.out / table.folder
    try:
        command = [sys.executable, "-m", "dnrpipe.cli", *table.command, *given.more, "--out", str(out)]
        return subprocess.run(command, check=False).returncode
    finally:
        made = out / "results.json"
        if made.exists():
            RESULTS.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(made, RESULTS / table.results)
            print(f"copied to {RESULTS / table.results}")


if __name__ == "__main__":
    raise SystemExit(main())
