"""``python -m tools.bench_frames WORKSPACE...``: our frames against path tracing + denoiser at equal time."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from dnrpipe.cli import set_thread_waiting
from dnrpipe.core.errors import UserError
from dnrpipe.raytrace.variants import choose_variant
from dnrtrain.atomic import write_json


def main() -> int:
    """Exit code 2 where a workspace cannot be measured. Each workspace runs in a process of its own."""
    options = _options()
    from .document import write

    if options.only_result is not None:
        return _one(options)
    results: list[dict[str, Any]] = _kept(options)
    for root in options.workspaces:
        with tempfile.TemporaryDirectory() as folder:
            result = Path(folder) / "result.json"
            # Kernels and bundles of one scene would stay in the memory of the next.
            command = [sys.executable, "-m", "tools.bench_frames", str(root.resolve()), *_passed(options)]
            done = subprocess.run([*command, "--only-result", str(result)], check=False)
            if done.returncode:
                return done.returncode
            results.append(json.loads(result.read_text()))
        write(results, options.out)  # what is measured stays if a later scene fails
    print(options.out.with_suffix(".md"))
    return 0


def _one(options: argparse.Namespace) -> int:
    import os

    try:
        os.environ.update(choose_variant().environment)  # before anything imports Mitsuba
        set_thread_waiting(os.environ)  # as the command line does
        from .bench_workspace import Options, bench

        (root,) = options.workspaces
        chosen = Options(
            cache=options.cache,
            views=options.views,
            reference_spp=options.reference_spp,
            reference=options.reference,
            clock=options.clock,
            threads=options.threads,
            samples=tuple(options.samples),
            moving=options.moving,
            moving_spp=options.moving_spp,
            rays=tuple(options.rays),
        )
        result = bench(root, chosen, lambda line: print(line, file=sys.stderr))
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    write_json(options.only_result, result)
    return 0


def _kept(options: argparse.Namespace) -> list[dict[str, Any]]:
    if not (options.keep and options.out.exists()):
        return []
    names = {root.resolve().stem for root in options.workspaces}
    return [scene for scene in json.loads(options.out.read_text())["scenes"] if scene["scene"] not in names]


def _passed(options: argparse.Namespace) -> list[str]:
    """The options that decide a scene's figures, as arguments."""
    names = ("cache", "views", "reference_spp", "reference", "clock", "threads", "moving", "moving_spp")
    given = [text for name in names for text in (f"--{name.replace('_', '-')}", str(getattr(options, name)))]
    rays = ["--rays", *map(str, options.rays)] if options.rays else []
    return [*given, "--samples", *map(str, options.samples), *rays]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.bench_frames", description=__doc__)
    parser.add_argument("workspaces", nargs="+", type=Path, metavar="WORKSPACE", help="prepared, with a trained model")
    parser.add_argument("--out", type=Path, default=Path(".cache/frames/frames.json"), help="JSON; Markdown beside it")
    parser.add_argument("--cache", type=Path, default=Path(".cache/frames"), help="where references are kept")
    parser.add_argument("--views", type=int, default=6, help="test views measured")
    parser.add_argument("--samples", type=int, nargs="+", default=[1, 2, 4, 8, 16, 64], help="of path tracing")
    parser.add_argument("--rays", type=int, nargs="+", default=[], help="rays per pixel of our base images")
    parser.add_argument("--keep", action="store_true", help="scenes that --out has from before stay in it")
    parser.add_argument("--reference-spp", type=int, default=1024, help="samples of a reference, in two halves")
    parser.add_argument("--reference", choices=("auto", "raw", "denoised"), default="auto")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: CPU time over the threads")
    parser.add_argument("--threads", type=int, default=2, help="of Mitsuba, denoiser and network alike")
    parser.add_argument("--moving", type=int, default=24, help="frames of an orbit and of a walk; 0: none")
    parser.add_argument("--moving-spp", type=int, default=512, help="samples of their references")
    # One workspace in this very process, result as JSON there: what the command calls for each.
    parser.add_argument("--only-result", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
