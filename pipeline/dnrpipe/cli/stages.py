"""One command per stage of the pipeline, `run` for all of them, and what the renderer is for: `render`, `report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..core.errors import UserError
from .options import (
    SCENE_OPTIONS,
    SELECT_OPTIONS,
    common,
    open_session,
    options,
    scene_overrides,
    select_overrides,
    tracing_overrides,
)

if TYPE_CHECKING:
    from ..stages.session import Session


@click.command()
@options(SCENE_OPTIONS)
@common
def prepare(scene: Path | None, **options: Any) -> None:
    """Convert a scene and render the cheap passes of all candidate views.

    SCENE is a .blend, .obj, .gltf, .glb, .fbx, .ply or .stl file. Makes ./SCENE.dnr (or -w DIR) with the
    census, a Mitsuba bundle, cameras, and per view a G-buffer (UV, depth, normal) and rasterised colour.
    Embedded scripts are never executed. Without SCENE, goes on with the workspace's own scene.

    \b
    Examples:
      dnrpipe prepare scene.blend
      dnrpipe prepare scene.blend --preset standard --resolution 512
      dnrpipe prepare scene.blend --cameras transforms_train.json
      dnrpipe prepare scene.blend --strict
    """
    with open_session("prepare", options, scene=scene, overrides=scene_overrides(options)) as session:
        session.stages("prepare")


@click.command()
@options(SELECT_OPTIONS)
@common
def select(**options: Any) -> None:
    """Choose the views to ray-trace.

    Trains the coarse neural renderer (step 1) only where the policy learns from it or step 2 starts from it
    (finetune.step2.start = coarse). selection.json says what each view adds, and why it was chosen.

    \b
    Examples:
      dnrpipe select --budget 25
      dnrpipe select --budget 10 --policy auto
      dnrpipe select --budget 10 --policy kmedoids
    """
    with open_session("select", options, overrides=select_overrides(options)) as session:
        session.stages("select")


@click.command("raytrace-selected")
@click.option("--noise", metavar="SHARE", help="Trace each view until its noise is this, e.g. 1% (or 0.01).")
@click.option("--time", metavar="TIME", help="Trace for this long (90s, 10m, 1h30m), shared over the views.")
@click.option("--spp", type=int, metavar="N", help="Samples per pixel; with --noise or --time: at most so many.")
@click.option(
    "--denoise", type=click.Choice(["oidn", "none"]), help="Open Image Denoise on the views to be trained on, or not."
)
@common
def raytrace_selected(
    noise: str | None, time: str | None, spp: int | None, denoise: str | None, **options: Any
) -> None:
    """Path-trace the selected views with Mitsuba, and no others.

    Noise is the relative RMSE of a view in display space (sRGB over white), before the denoiser, estimated while
    tracing. With both --noise and --time, views that are good enough leave the time to the others. The time is that
    of tracing; baked light and base images come on top. --noise, --time and --spp are remembered; naming one of them
    forgets the others. What is traced is kept: a lower noise or a longer time goes on from it.

    \b
    Examples:
      dnrpipe raytrace-selected
      dnrpipe raytrace-selected --spp 512
      dnrpipe raytrace-selected --noise 1%
      dnrpipe raytrace-selected --noise 0.5% --spp 4096 --denoise none
      dnrpipe raytrace-selected --time 10m
    """
    overrides = tracing_overrides(noise, time, spp, denoise)
    with open_session("raytrace-selected", options, overrides=overrides) as session:
        session.stages("raytrace")


@click.command()
@click.option("--epochs", type=int, metavar="N", help="Passes over the selected views.")
@common
def finetune(epochs: int | None, **options: Any) -> None:
    """Step 2: fine-tune the neural renderer on the ray-traced views with six losses.

    \b
    Examples:
      dnrpipe finetune
      dnrpipe finetune --epochs 100 --set finetune.step2.augment=false
    """
    overrides: dict[str, Any] = {"finetune": {"step2": {"epochs": epochs}}} if epochs is not None else {}
    with open_session("finetune", options, overrides=overrides) as session:
        session.stages("finetune")


@click.command()
@common
def evaluate(**options: Any) -> None:
    """Measure on held-out test views, ray-traced on demand and booked as evaluation cost.

    \b
    Examples:
      dnrpipe evaluate
      dnrpipe evaluate --json | jq .evaluate.mean.psnr
    """
    with open_session("evaluate", options) as session:
        session.renderer()
        session.stages("evaluate")


@click.command()
@options([*SCENE_OPTIONS, *SELECT_OPTIONS])
@common
def run(scene: Path | None, **options: Any) -> None:
    """All stages: prepare, select, raytrace-selected, finetune, evaluate, report.

    Does only what is missing or out of date.

    \b
    Examples:
      dnrpipe run scene.blend --budget 25
      dnrpipe run scene.blend --preset paper
    """
    overrides = scene_overrides(options) | select_overrides(options)
    with open_session("run", options, scene=scene, overrides=overrides) as session:
        session.stages("prepare", "select", "raytrace", "finetune", "evaluate")
        write_report(session)


@click.command()
@click.option("--orbit", type=click.IntRange(1, 100_000), metavar="N", help="N frames of a turntable (default 60).")
@click.option("--elevation", type=click.FloatRange(-89, 89), default=25.0, show_default=True, metavar="DEGREES")
@click.option("--cameras", "camera_file", type=click.Path(path_type=Path), help="A NeRF transforms.json instead.")
@click.option("--frames", type=click.Choice(["png", "exr", "both"]), default="png", show_default=True)
@click.option("--movie", type=click.Choice(["mp4", "webp", "none"]), default="mp4", show_default=True)
@click.option(
    "--resolution", type=click.IntRange(8, 16384), metavar="PIXELS", help="Square size of the orbit's frames."
)
@click.option("--untrained", is_flag=True, help="By the shipped corrector, also where a renderer was trained.")
@click.option(
    "--alone",
    is_flag=True,
    help="No frame remembers those before it: for cameras that are no sequence. So it is after a training.",
)
@common
def render(
    orbit: int | None,
    elevation: float,
    camera_file: Path | None,
    frames: str,
    movie: str,
    resolution: int | None,
    untrained: bool,
    alone: bool,
    **options: Any,
) -> None:
    """Render novel views with the neural renderer: frames and a movie in renders/.

    Where no view was ever selected, the shipped corrector renders: nothing is trained. With --untrained it does so in
    any case, into a folder of its own.

    \b
    Examples:
      dnrpipe render --orbit 60
      dnrpipe render --orbit 60 --untrained
      dnrpipe render --orbit 120 --movie webp --frames both
      dnrpipe render --cameras transforms_path.json
    """
    if orbit is not None and camera_file is not None:
        raise UserError("render: give --orbit or --cameras, not both")
    from dnrtrain.contract import parse_transforms

    from ..core.cameras import orbit_views
    from ..core.scene_files import read_summary
    from ..stages.render import render_novel

    with open_session("render", options) as session:
        if not untrained:
            session.renderer()
        cameras = session.settings.cameras
        if camera_file is not None:
            views = parse_transforms(camera_file, (cameras.width, cameras.height))
            name = camera_file.stem
        else:
            if resolution is not None:
                cameras = cameras.model_copy(update={"width": resolution, "height": resolution})
            views = orbit_views(read_summary(session.workspace.scene), cameras, orbit or 60, elevation)
            name = f"orbit-{orbit or 60}"
        run = session.run.for_stage("render")
        answer = render_novel(run, views, name=name, frames=frames, movie=movie, untrained=untrained, alone=alone)
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
