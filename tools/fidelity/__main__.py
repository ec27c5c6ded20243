"""``python -m tools.fidelity``: measure the conversion against Cycles and write docs/fidelity.md."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dnrpipe.core.console import Console

from .catalogue import all_cases
from .run import Plan, load_records, run_cases


def main() -> int:
    """Exit code 1 when a scene fails or a claim does not hold, 2 for an unknown name."""
    options = _options()
    cases = all_cases()
    if options.list:
        print("\n".join(f"{case.name:24} {case.group}: {case.title}" for case in cases.values()))
        return 0
    unknown = [name for name in options.only if name not in cases]
    if unknown:
        print(f"no fidelity scene called {', '.join(unknown)}; --list names them", file=sys.stderr)
        return 2
    chosen = [cases[name] for name in options.only] or list(cases.values())
    plan = Plan(options.cache.resolve(), options.cycles_spp, options.spp, options.jobs)
    records = run_cases(chosen, plan, Console())
    from .document import verdict, write_document

    if options.docs:
        write_document(list(load_records(list(cases.values()), plan.cache)), options.docs, plan)
    bad = [record["name"] for record in records if verdict(record) in ("fails", "error")]
    if bad:
        print(f"{len(bad)} of {len(records)} do not hold: {', '.join(bad)}", file=sys.stderr)
    return 1 if bad else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.fidelity", description=__doc__)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="measure these scenes only")
    parser.add_argument("--list", action="store_true", help="name the scenes and stop")
    parser.add_argument("--cache", type=Path, default=Path(".cache/fidelity"), help="where renders are kept")
    parser.add_argument("--cycles-spp", type=int, default=192, help="samples of each of two Cycles pictures")
    parser.add_argument("--spp", type=int, default=192, help="samples of each of our two pictures")
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time (one thread each)")
    parser.add_argument("--docs", type=Path, help="folder that gets fidelity.md and images/fidelity-*.jpg")
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
