"""`dnrpipe shot`: finished frames of an animated camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from ..core.errors import UserError
from .options import amount, common, open_session


@click.command()
@click.argument("scene", type=click.Path(path_type=Path), required=False)
@click.option("--frames", metavar="RANGE", help="Such as 1-240, 1-240/2 or 7,12 (default: the file's own).")
@click.option("--size", metavar="WxH", help="Pixels, such as 1280x720 (default: the file's own).")
@click.option("--camera", metavar="NAME", help="A camera of the file (default: the active one, with its markers).")
@click.option("--cameras", "camera_file", type=click.Path(path_type=Path), help="A NeRF transforms.json instead.")
@click.option("--time", "duration", metavar="T", help="For all frames, e.g. 20m: the best that fits in.")
@click.option("--target-psnr", type=float, metavar="DB", help="The cheapest way that has this PSNR.")
@click.option("--target-lpips", type=float, metavar="X", help="The cheapest way that has this LPIPS (AlexNet).")
@click.option(
    "--way", type=click.Choice(["path", "base", "neural"]), help="Path tracing, base images, the neural renderer."
)
@click.option(
    "--plan-for",
    type=click.IntRange(min=1),
    metavar="N",
    help="Frames that baked light has to pay for, where more will follow (default: those of the shot).",
)
@click.option("--name", metavar="NAME", help="Of the shot's folder (default: the camera's name).")
@click.option("--transparent", is_flag=True, help="The world behind everything is left out, and alpha says so.")
@click.option(
    "--dry-run", is_flag=True, help="Say which way is chosen and what it is expected to take; render nothing."
)
@common
def shot(
    scene: Path | None,
    frames: str | None,
    size: str | None,
    camera: str | None,
    camera_file: Path | None,
    duration: str | None,
    target_psnr: float | None,
    target_lpips: float | None,
    way: str | None,
    plan_for: int | None,
    name: str | None,
    transparent: bool,
    dry_run: bool,
    **options: Any,
) -> None:
    """Render a shot: frames as EXR, a movie, and how good they are.

    SCENE is a scene file or a workspace. Measures on windows of two frames what path tracing with a denoiser, base
    images and the neural renderer give and cost, says so, and takes the cheapest that is good enough: without --time
    and --target-..., the best quality that baked light has; where four samples are as good as that usually is, and
    baking would take longer than it saves, they are taken. Frames in which things move are path-traced. Makes
    ./SCENE.shot.dnr (or -w DIR) with shots/NAME: frames/ (scene-linear EXR: colour, depth, normal, albedo, object
    number), pictures/, NAME.mp4, check/. Goes on after an interruption.

    \b
    Examples:
      dnrpipe shot scene.blend
      dnrpipe shot scene.blend --frames 1-240 --size 1280x720
      dnrpipe shot scene.blend --camera Close --time 20m
      dnrpipe shot scene.blend --target-psnr 34 --dry-run
      dnrpipe shot scene.blend --cameras transforms_path.json --size 640x360
    """
    if camera is not None and camera_file is not None:
        raise UserError("shot: give --camera or --cameras, not both")
    if camera_file is not None and frames is not None:
        raise UserError("shot: --frames are of the file's animation; with --cameras, all views are rendered")
    if duration is not None and (target_psnr is not None or target_lpips is not None):
        raise UserError("shot: give --time or a target, not both")
    for flag, target in (("--target-psnr", target_psnr), ("--target-lpips", target_lpips)):
        if target is not None and not (math.isfinite(target) and target > 0):
            raise UserError(f"{flag} {target:g}: expected a number above 0")
    from ..core.shot_records import parse_frames
    from ..core.units import parse_seconds
    from ..stages.shots.open_shot import parse_size
    from ..stages.shots.options import Wanted
    from ..stages.shots.request import ShotRequest, carry_out

    request = ShotRequest(
        numbers=None if frames is None else parse_frames(frames),
        size=None if size is None else parse_size(size),
        camera=camera,
        camera_file=camera_file,
        wanted=Wanted(
            seconds=amount("--time", duration, parse_seconds),
            psnr=target_psnr,
            lpips=target_lpips,
            way=way,
            frames=plan_for,
        ),
        name=name,
        transparent=transparent,
        only_plan=dry_run,
    )
    if scene is not None and (scene / "manifest.json").exists():
        options["workspace"], scene = str(scene), None
    with open_session("shot", options, scene=scene) as session:
        session.console.result(carry_out(session, request))
