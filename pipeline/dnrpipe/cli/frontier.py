"""`dnrpipe frontier`: what accuracy costs in time, measured, with its rivals in the same run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .options import CAMERA_OPTIONS, STRICT, common, open_prepared, options


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), required=False)
@click.option("--budgets", metavar="A,B", help="Views to ray-trace (default 6,12 and the workspace's budget).")
@click.option("--spp", metavar="A,B", help="Samples per pixel of training views (default 16 and the workspace's).")
@click.option("--iterations", metavar="A,B", help="Optimiser steps (default 150,600).")
@click.option("--frames", metavar="A,B", help="Numbers of frames to compare for (default 200,2000).")
@click.option(
    "--also",
    default="random,all,paper,cycles",
    show_default=True,
    metavar="A,B",
    help="Other ways to train, and Cycles as a rival; none.",
)
@click.option("--ladder", metavar="A,B", help="Samples of path tracing, the rival (default 1,2,4,8,16,64).")
@click.option("--seeds", type=int, default=1, show_default=True, metavar="N", help="Every point is trained N times.")
@click.option("--jobs", type=int, default=0, metavar="N", help="Cells side by side (default: one per core).")
@STRICT
@options(CAMERA_OPTIONS)
@common
def frontier(scene: Path | None, strict: bool, **options: Any) -> None:
    """Sweep views, samples and steps, and draw quality against total seconds, rivals included.

    SCENE is a scene file or a workspace. Rivals on the same test views: path tracing at 1 to 64 samples, with and
    without Open Image Denoise; Cycles likewise; random views; all candidates; the paper's model; the base image alone.
    Writes results.json, results.csv, report.md and a plot per number of frames into the workspace's folder frontier/.
    Traced views, references and light are shared; what is done is not done again.

    \b
    Examples:
      dnrpipe frontier scene.blend
      dnrpipe frontier -w scene.dnr --budgets 5,10,25 --spp 8,64 --iterations 200,800 --frames 100,1000
      dnrpipe frontier scene.blend --also none --ladder 1,4,16 --json
    """
    from ..core.errors import UserError
    from ..studies.frontier.measure_frontier import run_frontier

    if options["force"]:
        raise UserError("--force: remove the workspace's folder frontier/ to measure everything anew")
    names = ("budgets", "spp", "iterations", "frames", "also", "ladder", "seeds", "jobs")
    wanted = {name: options.pop(name) for name in names}
    with open_prepared("frontier", scene, options, strict) as session:
        results = run_frontier(session.run, **wanted)
        folder = session.workspace.root / "frontier"
        session.console.say(f"{len(results.points)} points: {folder / 'report.md'}, {folder / 'frontier-*.png'}")
        session.console.result(results.data())
