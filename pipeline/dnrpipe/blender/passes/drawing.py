"""What a render process draws: a function (view, path) that renders one scene of source.blend to an EXR file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy

from dnrpipe.core.errors import UserError
from dnrtrain.contract import View

from ..reading.opening import open_blend
from ..tasks import PassesCommon
from .camera import apply_view, clip_range
from .gbuffer_scene import GBUFFER_SCENE, gbuffer_bounds, set_up_coverage
from .raster import configure_raster, output_exr, render_to


def make_renderer(kind: str, common: PassesCommon) -> Callable[[View, Path], None]:
    """Open source.blend and set its scene up for ``kind`` ("gbuffer", "coverage", "raster").

    Raises UserError when source.blend is missing, damaged or not one of ours.
    """
    source = common.scene_dir / "source.blend"
    if not source.is_file():
        raise UserError(f"{source}: no such file; run `dnrpipe prepare` first")
    if kind == "raster":
        open_blend(source)
        scene = bpy.context.scene
        bounds = gbuffer_bounds(_gbuffer_scene(source))
        configure_raster(scene, common.raster_engine, common.raster_samples)
    else:
        scene = _append_gbuffer(source)
        bounds = gbuffer_bounds(scene)
        if kind == "coverage":
            set_up_coverage(scene, common.coverage_samples)
        output_exr(scene, "layers" if kind == "gbuffer" else "image")
    camera = bpy.data.objects.new("dnrpipe.camera", bpy.data.cameras.new("dnrpipe.camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    if common.threads:
        scene.render.threads_mode = "FIXED"
        scene.render.threads = common.threads

    def draw(view: View, path: Path) -> None:
        apply_view(view, camera, scene.render, clip_range(view, *bounds))
        render_to(scene, path)

    return draw


def _append_gbuffer(source: Path) -> bpy.types.Scene:
    """Only the G-buffer scene, without the original's textures: opens faster and holds less memory."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    try:
        with bpy.data.libraries.load(str(source), link=False) as (found, wanted):
            wanted.scenes = [name for name in found.scenes if name == GBUFFER_SCENE]
    except OSError as error:
        raise UserError(f"{source}: damaged ({error}); run `dnrpipe prepare` again") from None
    return _gbuffer_scene(source)


def _gbuffer_scene(source: Path) -> bpy.types.Scene:
    if GBUFFER_SCENE not in bpy.data.scenes:
        raise UserError(f"{source}: has no scene '{GBUFFER_SCENE}'; run `dnrpipe prepare` again")
    return bpy.data.scenes[GBUFFER_SCENE]
