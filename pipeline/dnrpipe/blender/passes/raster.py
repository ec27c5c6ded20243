"""The original scene as a fast rasterised (or direct-light) picture, and the EXR files that scenes are rendered to."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import bpy

from dnrpipe.core.errors import UserError

from ..geometry.render_graph import render_layer

WORKBENCH_AA = ((1, "OFF"), (5, "5"), (8, "8"), (11, "11"), (16, "16"), (32, "32"))
WORLD_COLUMNS = 1024


def configure_raster(scene: bpy.types.Scene, engine: str, samples: int) -> None:
    """Set the original scene up for ``engine`` ("eevee", "workbench", "cycles-direct"; "cycles": light paths as in the
    file, for frames that are compared with ours).

    Lights, world and materials stay as in the file. Compositor, sequencer, stamp, border, simplify,
    motion blur, freestyle, depth of field, multi-view, camera markers, dithering and film exposure are
    switched off: they would not match the G-buffers or the ray tracer.
    """
    render = scene.render
    render.film_transparent = True
    render.use_compositing = render.use_sequencer = render.use_stamp = render.use_simplify = False
    render.use_border = render.use_crop_to_border = render.use_motion_blur = False
    render.use_freestyle = render.use_multiview = False
    render.dither_intensity = 0.0
    render.use_persistent_data = True
    scene.timeline_markers.clear()  # markers switch the camera at render time
    wanted = render_layer(scene)
    for layer in scene.view_layers:
        layer.use = layer == wanted
    render.use_single_layer = False
    output_exr(scene, "image")
    if engine == "eevee":
        scene.render.engine = "BLENDER_EEVEE"
        scene.eevee.taa_render_samples = samples
        scene.eevee.use_overscan = False
        scene.render.filter_size = 1.0  # sharper than the default 1.5; the ray tracer's filter is a 1-pixel box
    elif engine == "workbench":
        _workbench(scene, samples)
    elif engine in ("cycles", "cycles-direct"):
        _cycles(scene, samples)
        if engine == "cycles-direct":
            scene.cycles.max_bounces = 0
            _sample_world_coarsely(scene)
    else:
        raise UserError(f"unknown raster engine '{engine}'; choose eevee, workbench or cycles-direct")


def _workbench(scene: bpy.types.Scene, samples: int) -> None:
    scene.render.engine = "BLENDER_WORKBENCH"
    shading = scene.display.shading
    shading.light = "STUDIO"
    shading.use_world_space_lighting = True  # the light stays with the scene, not with the camera
    shading.color_type = "TEXTURE"
    shading.show_shadows = shading.show_cavity = shading.show_object_outline = shading.show_xray = False
    shading.show_specular_highlight = False  # it follows the camera
    shading.use_dof = False
    for material in bpy.data.materials:
        _viewport_colour(material)
    scene.display.render_aa = next((name for count, name in WORKBENCH_AA if count >= samples), "32")


def _cycles(scene: bpy.types.Scene, samples: int) -> None:
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = samples
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.time_limit = 0
    cycles.film_exposure = 1.0
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0
    cycles.seed = 0
    cycles.use_animated_seed = False
    for layer in scene.view_layers:
        layer.samples = 0  # a layer may override the scene's samples


def _sample_world_coarsely(scene: bpy.types.Scene) -> None:
    """Cycles' own map of where the world is bright has 4096 columns for a sky: two seconds before the first frame."""
    if scene.world is not None and scene.world.cycles.sampling_method == "AUTOMATIC":
        scene.world.cycles.sampling_method = "MANUAL"
        scene.world.cycles.sample_map_resolution = WORLD_COLUMNS


def _viewport_colour(material: bpy.types.Material) -> None:
    """Workbench draws untextured materials in their viewport colour; give it the shader's base colour."""
    if material.node_tree is None:
        return
    for node in material.node_tree.nodes:
        socket = next((node.inputs[name] for name in ("Base Color", "Color") if name in node.inputs), None)
        if node.type.startswith("BSDF_") and socket is not None and not socket.is_linked:
            material.diffuse_color = socket.default_value
            return


def output_exr(scene: bpy.types.Scene, kind: Literal["layers", "image"]) -> None:
    """Let the scene write uncompressed float32 EXR: all passes, or the picture as linear Rec.709 RGBA."""
    settings = scene.render.image_settings
    if kind == "layers":
        settings.media_type = "MULTI_LAYER_IMAGE"
        settings.file_format = "OPEN_EXR_MULTILAYER"
        settings.use_exr_interleave = True  # one part: 5.0 writes a part per pass otherwise
    else:
        settings.media_type = "IMAGE"
        settings.file_format = "OPEN_EXR"
        settings.color_mode = "RGBA"
        # Files may work in another space (Rec.2020, ACEScg); the contract is Rec.709.
        settings.color_management = "OVERRIDE"
        settings.linear_colorspace_settings.name = "Linear Rec.709"
    settings.color_depth = "32"
    settings.exr_codec = "NONE"
    scene.render.use_file_extension = True
    scene.render.use_overwrite = True
    scene.render.use_placeholder = False


def render_to(scene: bpy.types.Scene, path: Path) -> None:
    """Render ``scene`` to ``path`` (.exr, see `output_exr`). Raises RuntimeError without a picture."""
    path.unlink(missing_ok=True)
    scene.render.filepath = str(path)
    layers = scene.view_layers
    single = {"layer": layers[0].name} if len(layers) == 1 else {}
    bpy.ops.render.render(write_still=True, scene=scene.name, **single)
    if not path.is_file():
        raise RuntimeError(f"Blender rendered scene '{scene.name}' without writing a picture")
