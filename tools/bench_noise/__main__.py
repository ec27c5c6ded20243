"""``python -m tools.bench_noise WORKSPACE... --out FILE``: are noise targets hit? Tables: `make docs`."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from dnrpipe.core.errors import UserError
from dnrpipe.core.units import parse_share
from dnrtrain.atomic import write_json


def main() -> int:
    """Exit code 2 where a workspace cannot be measured. Each workspace runs in a process of its own."""
    options = _options()
    if options.only_result is not None:
        return _one(options)
    names = {root.resolve().stem for root in options.workspaces}
    scenes: list[dict[str, Any]] = []
    if options.keep and options.out.exists():
        scenes = [scene for scene in json.loads(options.out.read_text())["scenes"] if scene["scene"] not in names]
    shared = {key: getattr(options, key) for key in ("targets", "resolution", "spp", "most", "views", "seeds")}
    for root in options.workspaces:
        with tempfile.TemporaryDirectory() as folder:
            result = Path(folder) / "result.json"
            passed = [
                text
                for key, value in shared.items()
                for text in (f"--{key}", *map(str, value if isinstance(value, list) else [value]))
            ]
            command = [sys.executable, "-m", "tools.bench_noise", str(root.resolve())]
            # Kernels and bundles of one scene would stay in the memory of the next.
            done = subprocess.run([*command, *passed, "--only-result", str(result)], check=False)
            if done.returncode:
                return done.returncode
            scenes.append(json.loads(result.read_text()))
        scenes.sort(key=lambda scene: scene["scene"])
        write_json(options.out, {**shared, "scenes": scenes})  # stays if a later one fails
    print(options.out)
    return 0


def _one(options: argparse.Namespace) -> int:
    from .measure import Options, bench, environment

    (root,) = options.workspaces
    chosen = Options(
        tuple(options.targets), options.resolution, options.spp, options.most, options.views, options.seeds
    )
    try:
        os.environ.update(environment(root))
        write_json(options.only_result, bench(root, chosen, lambda line: print(line, file=sys.stderr, flush=True)))
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.bench_noise", description=__doc__)
    parser.add_argument("workspaces", nargs="+", type=Path, metavar="WORKSPACE", help="with a path depth in its plan")
    parser.add_argument("--out", type=Path, default=Path(".cache/noise.json"), help="JSON")
    parser.add_argument("--keep", action="store_true", help="scenes that --out has from before stay in it")
    parser.add_argument("--targets", type=parse_share, nargs="+", default=[0.05, 0.02], help="e.g. 5%% 2%%")
    parser.add_argument("--resolution", type=int, default=64, help="longer side of a view, pixels")
    parser.add_argument("--spp", type=int, default=4096, help="samples of a reference")
    parser.add_argument("--most", type=int, default=2048, help="samples of a run, at most")
    parser.add_argument("--views", type=int, default=2, help="test views a scene")
    parser.add_argument("--seeds", type=int, default=3, help="runs a view and target")
    parser.add_argument("--only-result", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
