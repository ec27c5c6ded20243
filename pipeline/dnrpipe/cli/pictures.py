"""What the finished renderer is for: novel views, and the report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..core.errors import UserError
from .options import common, open_session

if TYPE_CHECKING:
    from ..stages.session import Session


@click.command()
@click.option("--orbit", type=click.IntRange(1, 100_000), metavar="N", help="N frames of a turntable (default 60).")
@click.option("--elevation", type=click.FloatRange(-89, 89), default=25.0, show_default=True, metavar="DEGREES")
@click.option("--cameras", "camera_file", type=click.Path(path_type=Path), help="A NeRF transforms.json instead.")
@click.option("--frames", type=click.Choice(["png", "exr", "both"]), default="png", show_default=True)
@click.option("--movie", type=click.Choice(["mp4", "webp", "none"]), default="mp4", show_default=True)
@click.option(
    "--resolution", type=click.IntRange(8, 16384), metavar="PIXELS", help="Square size of the orbit's frames."
)
@common
def render(
    orbit: int | None,
    elevation: float,
    camera_file: Path | None,
    frames: str,
    movie: str,
    resolution: int | None,
    **options: Any,
) -> None:
    """Render novel views with the neural renderer: frames and a movie in renders/.

    \b
    Examples:
      dnrpipe render --orbit 60
      dnrpipe render --orbit 120 --movie webp --frames both
      dnrpipe render --cameras transforms_path.json
    """
    if orbit is not None and camera_file is not None:
        raise UserError("render: give --orbit or --cameras, not both")
    from dnrtrain.contract import parse_transforms

    from ..core.cameras import orbit_views
    from ..core.scene_files import read_summary
    from ..stages.pipeline import STAGES, require_inputs
    from ..stages.render import render_novel

    with open_session("render", options) as session:
        require_inputs(STAGES["evaluate"], session.workspace, session.settings)
        cameras = session.settings.cameras
        if camera_file is not None:
            views = parse_transforms(camera_file, (cameras.width, cameras.height))
            name = camera_file.stem
        else:
            if resolution is not None:
                cameras = cameras.model_copy(update={"width": resolution, "height": resolution})
            views = orbit_views(read_summary(session.workspace.scene), cameras, orbit or 60, elevation)
            name = f"orbit-{orbit or 60}"
        answer = render_novel(session.run.for_stage("render"), views, name=name, frames=frames, movie=movie)
        session.console.say(f"{answer['frames']} frames, {answer['neural_ms']:.1f} ms each for the network")
        session.console.say(answer["movie"] or answer["folder"])
        session.console.result(answer)


@click.command()
@common
def report(**options: Any) -> None:
    """Write one self-contained HTML report: pictures, quality, and what it cost in time.

    \b
    Examples:
      dnrpipe report
      dnrpipe report -w scene.dnr --json
    """
    with open_session("report", options) as session:
        write_report(session)


def write_report(session: Session) -> None:
    """Write the report of the session's workspace; the answers of its stages go into ``--json``."""
    from ..report import build_report

    root = session.workspace.root
    path = build_report(root)
    session.console.say(f"report: {path}")
    session.console.result({"workspace": str(root), **session.answers, "report": str(path)})
