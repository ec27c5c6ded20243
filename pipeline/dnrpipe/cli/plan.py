"""`dnrpipe plan`: what a budget of time buys, or what an error costs, before it is spent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..core.errors import UserError
from .options import CAMERA_OPTIONS, STRICT, amount, common, open_prepared, options


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), required=False)
@click.option("--time", "duration", metavar="T", help="Time to spend from here on, e.g. 90s, 15m, 2h.")
@click.option("--target-psnr", type=float, metavar="DB", help="PSNR wanted on new views.")
@click.option("--frames", type=int, metavar="N", help="Frames to be rendered: says whether to train at all.")
@click.option("--apply", "carry_out", is_flag=True, help="Carry the plan out, then compare it with what happened.")
@STRICT
@options(CAMERA_OPTIONS)
@common
def plan(
    scene: Path | None,
    duration: str | None,
    target_psnr: float | None,
    frames: int | None,
    carry_out: bool,
    strict: bool,
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
    with open_prepared("plan", scene, options, strict) as session:
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
