"""What every scene builder needs: an empty Cycles scene, packed images, materials, lights, a camera, saving.

A builder is ``main("name", build)`` around a function that fills the scene. Its images come from
`patterns` (numpy only), its meshes from `shapes`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

FOLDER = Path(__file__).resolve().parent
Rgb = tuple[float, float, float]


# ---------------------------------------------------------------- images


def make_image(
    name: str, pixels: np.ndarray, *, data: bool = False, is_float: bool = False, jpeg: int | None = None
) -> bpy.types.Image:
    """Packed image from rows bottom first, [H, W], [H, W, 3] or [H, W, 4] (straight alpha).

    Values are display-encoded for colour, raw with ``data`` (set Non-Color), linear with ``is_float`` (half-float
    EXR). ``jpeg`` is a quality: noisy pictures pack five times smaller than as PNG.
    """
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=-1)
    height, width, channels = pixels.shape
    image = bpy.data.images.new(name, width, height, alpha=channels == 4, float_buffer=is_float, is_data=data)
    if is_float:
        image.colorspace_settings.name = "Linear Rec.709"
    rgba = np.ones((height, width, 4), dtype=np.float32)
    rgba[..., :channels] = np.clip(pixels, 0, None if is_float else 1)
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    if is_float:
        return _repack(image, "exr")
    if jpeg is not None:
        return _repack(image, "jpg", quality=jpeg)
    image.pack()
    return image


def _repack(image: bpy.types.Image, suffix: str, quality: int = 90) -> bpy.types.Image:
    """Replace a generated image by itself as a packed JPEG or half-float EXR file (Blender packs float as 32 bits)."""
    name, space = image.name, image.colorspace_settings.name
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"image.{suffix}"
        if suffix == "exr":
            settings = bpy.context.scene.render.image_settings
            settings.file_format, settings.color_mode = "OPEN_EXR", "RGB"
            settings.color_depth, settings.exr_codec = "16", "PIZ"
            image.save_render(str(path), scene=bpy.context.scene)
            settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "8"
        else:
            image.file_format = "JPEG"
            image.save(filepath=str(path), quality=quality)
        bpy.data.images.remove(image)
        loaded = bpy.data.images.load(str(path))
        loaded.colorspace_settings.name = space
        loaded.pack()
    loaded.name = name
    loaded.filepath_raw = f"//{name}.{suffix}"
    return loaded


# ---------------------------------------------------------------- materials


def material(name: str, colour: Rgb, **inputs: float) -> bpy.types.Material:
    """Principled material; ``colour`` linear, ``inputs`` by socket name with _ for a space."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    shader = principled(made)
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    made.diffuse_color = (*colour, 1.0)
    return made


def principled(made: bpy.types.Material) -> Any:
    """The material's Principled BSDF node."""
    return made.node_tree.nodes["Principled BSDF"]


def node(
    owner: bpy.types.Material | bpy.types.World, kind: str, *, inputs: dict[Any, Any] | None = None, **properties: Any
) -> Any:
    """New node, e.g. ``node(made, "TexNoise", inputs={"Scale": 8.0})``; ``kind`` without "ShaderNode"."""
    made: Any = owner.node_tree.nodes.new(f"ShaderNode{kind}")
    for key, value in properties.items():
        setattr(made, key, value)
    for key, value in (inputs or {}).items():
        made.inputs[key].default_value = value
    return made


def wire(owner: bpy.types.Material | bpy.types.World, output: Any, target: Any) -> None:
    """Link an output socket to an input socket."""
    owner.node_tree.links.new(output, target)


def cut_out_leaf(made: bpy.types.Material, shown: Any, through: Any, share: float) -> None:
    """The Principled BSDF with ``share`` of the shader ``through``, cut out by the alpha of the image ``shown``."""
    both = node(made, "MixShader", inputs={"Fac": share})
    wire(made, principled(made).outputs["BSDF"], both.inputs[1])
    wire(made, through.outputs["BSDF"], both.inputs[2])
    cut = node(made, "MixShader")
    wire(made, shown.outputs["Alpha"], cut.inputs["Fac"])
    wire(made, node(made, "BsdfTransparent").outputs["BSDF"], cut.inputs[1])
    wire(made, both.outputs["Shader"], cut.inputs[2])
    wire(made, cut.outputs["Shader"], made.node_tree.nodes["Material Output"].inputs["Surface"])


def picture(
    made: bpy.types.Material,
    image: bpy.types.Image,
    socket: str | None = None,
    *,
    repeat: tuple[float, float] | None = None,
    output: str = "Color",
) -> Any:
    """Image Texture node, linked to the Principled ``socket`` if named; ``repeat`` puts a Mapping node before it."""
    shown = node(made, "TexImage", image=image)
    if repeat is not None:
        coordinates = node(made, "TexCoord")
        mapping = node(made, "Mapping", inputs={"Scale": (*repeat, 1.0)})
        wire(made, coordinates.outputs["UV"], mapping.inputs["Vector"])
        wire(made, mapping.outputs["Vector"], shown.inputs["Vector"])
    if socket is not None:
        wire(made, shown.outputs[output], principled(made).inputs[socket])
    return shown


def normal_picture(
    made: bpy.types.Material,
    image: bpy.types.Image,
    *,
    strength: float = 1.0,
    repeat: tuple[float, float] | None = None,
) -> Any:
    """Tangent-space normal map (a ``data`` image) on the Principled shader."""
    shown = picture(made, image, repeat=repeat)
    bend = node(made, "NormalMap", inputs={"Strength": strength})
    wire(made, shown.outputs["Color"], bend.inputs["Color"])
    wire(made, bend.outputs["Normal"], principled(made).inputs["Normal"])
    return bend


def ramp(made: bpy.types.Material, factor: Any, stops: Sequence[tuple[float, Rgb]]) -> Any:
    """ColorRamp node fed by the output socket ``factor``; ``stops`` are (position, linear colour)."""
    shown = node(made, "ValToRGB")
    elements = shown.color_ramp.elements
    while len(elements) < len(stops):
        elements.new(0.5)
    for element, (position, colour) in zip(elements, stops, strict=True):
        element.position = position
        element.color = (*colour, 1.0)
    wire(made, factor, shown.inputs["Fac"])
    return shown


# ---------------------------------------------------------------- light and camera


def _aimed(name: str, data: bpy.types.ID, location: Rgb, target: Rgb | None) -> bpy.types.Object:
    made = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(made)
    made.location = location
    if target is not None:
        made.rotation_euler = (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()
    return made


def area_light(
    name: str, location: Rgb, target: Rgb, power: float, size: tuple[float, float] = (1.0, 1.0), colour: Rgb = (1, 1, 1)
) -> bpy.types.Object:
    """Rectangular area light of ``power`` watts that looks at ``target``."""
    data: Any = bpy.data.lights.new(name, "AREA")
    data.shape, data.size, data.size_y = "RECTANGLE", *size
    data.energy, data.color = power, colour
    return _aimed(name, data, location, target)


def point_light(
    name: str, location: Rgb, power: float, radius: float = 0.05, colour: Rgb = (1, 1, 1)
) -> bpy.types.Object:
    """Spherical light of ``power`` watts."""
    data: Any = bpy.data.lights.new(name, "POINT")
    data.energy, data.color, data.shadow_soft_size = power, colour, radius
    return _aimed(name, data, location, None)


def sun_light(
    name: str, direction: Rgb, strength: float, angle: float = 0.5, colour: Rgb = (1, 1, 1)
) -> bpy.types.Object:
    """Sun that shines along ``direction``; ``strength`` in W/m², ``angle`` its diameter in degrees."""
    data: Any = bpy.data.lights.new(name, "SUN")
    data.energy, data.color, data.angle = strength, colour, np.radians(angle)
    return _aimed(name, data, (0.0, 0.0, 3.0), (direction[0], direction[1], 3.0 + direction[2]))


def flat_world(colour: Rgb, strength: float = 1.0) -> bpy.types.World:
    """World of one linear colour."""
    world = _world("World")
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*colour, 1.0)
    background.inputs["Strength"].default_value = strength
    return world


def image_world(name: str, sky: np.ndarray, strength: float = 1.0) -> bpy.types.World:
    """World from a linear equirectangular picture [H, 2H, 3] (see ``patterns.studio_sky``), packed as half float."""
    world = _world(name)
    environment = node(world, "TexEnvironment", image=make_image(name.lower(), sky, is_float=True))
    background = world.node_tree.nodes["Background"]
    background.inputs["Strength"].default_value = strength
    wire(world, environment.outputs["Color"], background.inputs["Color"])
    return world


def _world(name: str) -> bpy.types.World:
    world = bpy.data.worlds.new(name)
    world.use_nodes = True
    bpy.context.scene.world = world
    return world


def camera(location: Rgb, target: Rgb, lens: float = 50.0, name: str = "Camera") -> bpy.types.Object:
    """Perspective camera, made the scene's active one."""
    data = bpy.data.cameras.new(name)
    data.lens = lens
    made = _aimed(name, data, location, target)
    bpy.context.scene.camera = made
    return made


# ---------------------------------------------------------------- the file


def new_scene() -> bpy.types.Scene:
    """Empty scene: Cycles, square frame, plain sRGB display, transparent background."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 256
    scene.cycles.use_denoising = True
    scene.render.resolution_x = scene.render.resolution_y = 800
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    return scene


def save(path: Path) -> None:
    """Write the scene, compressed, without a backup file."""
    bpy.context.preferences.filepaths.save_version = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path.resolve()), compress=True)


def preview(path: Path, size: int, samples: int) -> None:
    """Render the active camera over white with Cycles, denoised, on one thread, to a PNG."""
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.cycles.samples = samples
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.filepath = str(path.resolve())
    bpy.ops.render.render(write_still=True)


def main(name: str, build: Callable[[], None], arguments: Sequence[str] | None = None) -> None:
    """Command line of a builder: ``build_NAME.py [OUT.blend] [--preview OUT.png --size 256 --samples 64]``."""
    given = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=f"Build the {name} scene")
    parser.add_argument("output", type=Path, nargs="?", default=FOLDER / f"{name}.blend")
    parser.add_argument("--preview", type=Path)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=64)
    options = parser.parse_args(given)
    new_scene()
    build()
    save(options.output)
    if options.preview:
        preview(options.preview, options.size, options.samples)
