"""What time buys, and what an error costs: `dnrpipe plan` before it is spent, `dnrpipe frontier` measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..core.errors import UserError
from .options import SCENE_OPTIONS, amount, common, open_prepared, options


@click.command()
@click.option("--time", "duration", metavar="T", help="Time to spend from here on, e.g. 90s, 15m, 2h.")
@click.option("--target-psnr", type=float, metavar="DB", help="PSNR wanted on new views.")
@click.option("--frames", type=int, metavar="N", help="Frames to be rendered: says whether to train at all.")
@click.option("--apply", "carry_out", is_flag=True, help="Carry the plan out, then compare it with what happened.")
@options(SCENE_OPTIONS)
@common
def plan(
    scene: Path | None,
    duration: str | None,
    target_psnr: float | None,
    frames: int | None,
    carry_out: bool,
    **options: Any,
) -> None:
    """Predict what time buys and choose views, samples and steps.

    SCENE is a scene file or a workspace (scene.dnr); without it, the workspace is found as usual. The scene is
    prepared where it is not. A pilot of one to two minutes measures each kind of work once and is kept in the
    workspace, and so is the light that it bakes.
    Without --time and --target-psnr, a table of budgets is printed.

    \b
    Examples:
      dnrpipe plan scene.blend                       # what each budget buys
      dnrpipe plan --time 15m                        # the best that fifteen minutes buy, and why
      dnrpipe plan --target-psnr 30 --frames 200     # is training worth it for 200 frames?
      dnrpipe plan --time 15m --apply                # do it; predicted against actual goes to the report
    """
    if frames is not None and frames < 1:
        raise UserError(f"--frames {frames}: at least 1")
    if carry_out and duration is None and target_psnr is None:
        raise UserError("--apply: what shall be carried out? give --time or --target-psnr")
    from ..core.units import parse_seconds
    from ..studies.planning.carry_out import apply
    from ..studies.planning.make_plan import make_plan
    from ..studies.planning.pilot import pilot_path
    from ..studies.planning.plan_text import actual_lines, lines
    from ..studies.planning.records import Wanted
    from ..workers.view_tasks import worker_count

    wanted = Wanted(seconds=amount("--time", duration, parse_seconds), psnr=target_psnr, frames=frames)
    force, options["force"] = options["force"], False
    with open_prepared("plan", scene, options) as session:
        if force:
            pilot_path(session.workspace).unlink(missing_ok=True)
        made = make_plan(session.run, wanted)
        for line in lines(made, worker_count(0)):
            session.console.say(line)
        if carry_out:
            if made.chosen is None:
                raise UserError(f"--apply: nothing is expected to reach {target_psnr:g} dB; see the routes above")
            made = apply(session, made)
            for line in actual_lines(made):
                session.console.say(line)
        session.console.result({"workspace": str(session.workspace.root), **made.data()})


@click.command()
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
@options(SCENE_OPTIONS)
@common
def frontier(scene: Path | None, **options: Any) -> None:
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
    from ..studies.frontier.measure_frontier import run_frontier

    if options["force"]:
        raise UserError("--force: remove the workspace's folder frontier/ to measure everything anew")
    names = ("budgets", "spp", "iterations", "frames", "also", "ladder", "seeds", "jobs")
    wanted = {name: options.pop(name) for name in names}
    with open_prepared("frontier", scene, options) as session:
        results = run_frontier(session.run, **wanted)
        folder = session.workspace.root / "frontier"
        session.console.say(f"{len(results.points)} points: {folder / 'report.md'}, {folder / 'frontier-*.png'}")
        session.console.result(results.data())
