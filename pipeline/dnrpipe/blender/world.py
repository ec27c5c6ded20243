"""Blender worlds -> Mitsuba environment emitters."""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Euler

from . import xmltree
from .findings import Findings
from .sockets import find_input, resolve, surface_source, walk
from .textures import ImageReader, TextureStore, srgb_to_linear

ENVMAP_TO_BLENDER = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=np.float64)
"""B: Mitsuba's envmap frame (Y up) to Blender's equirectangular frame."""
RENDERED_SIZE = (1024, 512)
RENDERED_SAMPLES = 32
MAX_EXACT_ROWS = 1024
"""Environment images up to this height are resampled without loss."""


def export_world(
    scene: bpy.types.Scene, root: ET.Element, store: TextureStore, images: ImageReader, findings: Findings
) -> bool:
    """Append the world's emitter to ``root``; False when there is no world or it is black.

    Constant Background -> ``constant``; Environment Texture with constant strength -> ``envmap``, rotated by its
    Mapping node; any other node tree is rendered once with Cycles as an equirectangular image.
    """
    world = scene.world
    if world is None:
        return False
    tree = world.node_tree
    if tree is None:
        return _constant(root, np.array(world.color))
    if surface_source(tree, "Volume") is not None:
        findings.add("ignored", f"world '{world.name}' volume", "no fog or atmosphere")
    source = surface_source(tree)
    if source is None:
        return False
    if source.node.type == "BACKGROUND":
        strength = resolve(source.node.inputs["Strength"], source.scope)
        colour = resolve(source.node.inputs["Color"], source.scope)
        amount = _plain(strength)
        if amount is not None:
            plain = _plain(colour)
            if plain is not None:
                return _constant(root, plain * amount)
            if np.allclose(amount, 0):
                return False
            if colour.node.type == "TEX_ENVIRONMENT" and _hdri(
                root, colour.node, colour.scope, float(amount[0]), store, images, findings, world.name
            ):
                return True
    return _rendered(scene, world, root, store, findings)


def _plain(source: Any) -> np.ndarray | None:
    """Value of a constant socket as [3], or None."""
    if source.linked and source.node.type not in {"RGB", "VALUE"}:
        return None
    value = source.node.outputs[0].default_value if source.linked else source.default
    return np.full(3, float(value)) if isinstance(value, int | float) else np.array(value[:3], dtype=np.float64)


def _constant(root: ET.Element, radiance: np.ndarray) -> bool:
    """Background colour x strength -> ``constant``."""
    if not np.any(radiance > 0):
        return False
    element = xmltree.plugin("emitter", "constant", id="world")
    xmltree.rgb(element, "radiance", np.maximum(radiance, 0))
    root.append(element)
    return True


def _hdri(
    root: ET.Element,
    node: Any,
    scope: Any,
    strength: float,
    store: TextureStore,
    images: ImageReader,
    findings: Findings,
    world: str,
) -> bool:
    """Environment Texture -> ``envmap`` with to_world = R^-1 B; False when its coordinates are not a rotation."""
    rotation = _rotation(find_input(node, "Vector"), scope)
    if node.projection != "EQUIRECTANGULAR" or rotation is None:
        return False
    if node.image is None:
        findings.add("missing", f"world '{world}' image", "no image chosen; magenta light stands for it")
        return _constant(root, np.array([1.0, 0.0, 1.0]) * strength)
    texels, srgb = images.read(node.image, None)
    colour = texels[..., :3]
    if colour.dtype == np.uint8:
        codes = colour.astype(np.float32) / 255
        colour = srgb_to_linear(codes) if srgb else codes
    _envmap(root, colour, strength, rotation.T @ ENVMAP_TO_BLENDER, store, f"{world}-{node.image.name}")
    return True


def _rotation(socket: Any, scope: Any) -> np.ndarray | None:
    """Rotation from world direction to lookup direction, or None if the coordinates are anything else.

    Mapping node: Point and Vector types rotate the direction, Texture rotates it back.
    """
    source = resolve(socket, scope)
    if not source.linked:
        return np.eye(3)
    node = source.node
    if node.type == "TEX_COORD" and source.socket.name == "Generated":
        return np.eye(3)
    if node.type == "NEW_GEOMETRY" and source.socket.name == "Position":
        return np.eye(3)
    if node.type != "MAPPING" or node.vector_type == "NORMAL":
        return None
    below = _rotation(find_input(node, "Vector"), source.scope)
    parts = {}
    for name in ("Location", "Rotation", "Scale"):
        found = find_input(node, name)
        plain = np.zeros(3) if found is None else _plain(resolve(found, source.scope))
        if plain is None:
            return None
        parts[name] = plain
    moved = "Location" in parts and np.any(np.abs(parts["Location"]) > 1e-6)
    uniform = np.allclose(parts["Scale"], parts["Scale"][0]) and parts["Scale"][0] > 1e-6
    if below is None or not uniform or (moved and node.vector_type != "VECTOR"):
        return None
    turn = np.array(Euler(parts["Rotation"]).to_matrix())
    return (turn.T if node.vector_type == "TEXTURE" else turn) @ below


def _envmap(
    root: ET.Element, bottom_up: np.ndarray, strength: float, turn: np.ndarray, store: TextureStore, label: str
) -> None:
    """``envmap`` from an equirectangular image in Blender's row order (Mitsuba's wants the zenith first).

    Both centre column i at (i + 0.5) / width; row j lies at (j + 0.5) / height in Blender and at j / (height - 1)
    in Mitsuba 3.9.1 (measured): see :func:`rows_to_nodes`.
    """
    radiance = rows_to_nodes(np.maximum(bottom_up[::-1].astype(np.float32), 0))
    element = xmltree.plugin("emitter", "envmap", id="world")
    xmltree.text(element, "filename", store.save(radiance, False, label))
    xmltree.number(element, "scale", strength)
    placed = np.eye(4)
    placed[:3, :3] = turn
    xmltree.matrix(element, "to_world", placed)
    root.append(element)


def rows_to_nodes(image: np.ndarray) -> np.ndarray:
    """Resample rows centred at (j + 0.5) / h to rows at j / (h' - 1), both linearly interpolated.

    With h' = 2 h + 1 every old row is a new one and the others lie half way between two: the interpolated image
    is exactly the same. Images above MAX_EXACT_ROWS keep their height (a blur of at most half a texel).
    """
    height = image.shape[0]
    rows = 2 * height + 1 if height <= MAX_EXACT_ROWS else height
    position = np.clip(np.arange(rows) / (rows - 1) * height - 0.5, 0, height - 1)
    low = np.floor(position).astype(int)
    high = np.minimum(low + 1, height - 1)
    share = (position - low).astype(np.float32)[:, None, None]
    return image[low] * (1 - share) + image[high] * share


def _rendered(scene: bpy.types.Scene, world: Any, root: ET.Element, store: TextureStore, findings: Findings) -> bool:
    """Any other world -> rendered once by Cycles as an equirectangular image (sky textures, gradients, mixes)."""
    paths = [node for node in walk(world.node_tree) if node.type == "LIGHT_PATH"]
    copy = world.copy()
    if paths:
        _unlink_camera_rays(copy.node_tree)
        findings.add(
            "approximated",
            f"world '{world.name}' Light Path node",
            "taken as seen by indirect rays (Is Camera Ray = 0); other outputs as by camera rays",
        )
    try:
        pixels = render_equirect(copy)
    finally:
        bpy.data.worlds.remove(copy)
    if not np.any(pixels > 0):
        return False
    findings.add(
        "baked",
        f"world '{world.name}'",
        f"its nodes are rendered into a {RENDERED_SIZE[0]} x {RENDERED_SIZE[1]} environment image",
    )
    _envmap(root, pixels, 1.0, ENVMAP_TO_BLENDER, store, f"{world.name}-world")
    return True


def _unlink_camera_rays(tree: bpy.types.NodeTree) -> None:
    for node in tree.nodes:
        if node.type != "LIGHT_PATH":
            continue
        for link in list(node.outputs["Is Camera Ray"].links):
            target = link.to_socket
            tree.links.remove(link)
            target.default_value = 0.0 if target.type == "VALUE" else (0.0, 0.0, 0.0, 1.0)


def render_equirect(world: Any) -> np.ndarray:
    """Radiance of ``world`` from the origin as float32 [H, W, 3], bottom row first, Blender's equirect layout."""
    scene = bpy.data.scenes.new("dnrpipe.world")
    camera = bpy.data.cameras.new("dnrpipe.world")
    body = bpy.data.objects.new("dnrpipe.world", camera)
    try:
        scene.collection.objects.link(body)
        camera.type = "PANO"
        holder: Any = camera if hasattr(camera, "panorama_type") else camera.cycles
        holder.panorama_type = "EQUIRECTANGULAR"
        # The image's centre is +X, its left half +Y.
        body.rotation_euler = (math.pi / 2, 0.0, -math.pi / 2)
        scene.camera, scene.world = body, world
        render = scene.render
        render.engine = "CYCLES"
        render.film_transparent = False
        render.resolution_x, render.resolution_y = RENDERED_SIZE
        render.resolution_percentage = 100
        render.use_compositing = render.use_sequencer = False
        settings: Any = scene.cycles
        settings.device = "CPU"
        settings.samples = RENDERED_SAMPLES
        settings.use_adaptive_sampling = settings.use_denoising = False
        settings.sample_clamp_direct = settings.sample_clamp_indirect = 0.0
        settings.pixel_filter_type = "BOX"
        image = render.image_settings
        image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGB", "32"
        with tempfile.TemporaryDirectory() as folder:
            render.filepath = str(Path(folder) / "world.exr")
            bpy.ops.render.render(scene=scene.name, write_still=True)
            return _read_pixels(Path(render.filepath))
    finally:
        bpy.data.objects.remove(body)
        bpy.data.cameras.remove(camera)
        bpy.data.scenes.remove(scene)


def _read_pixels(path: Path) -> np.ndarray:
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Linear Rec.709"
        width, height = image.size
        flat = np.empty(width * height * image.channels, dtype=np.float32)
        image.pixels.foreach_get(flat)
        return np.nan_to_num(flat.reshape(height, width, -1)[..., :3], nan=0.0, posinf=65000.0, neginf=0.0)
    finally:
        bpy.data.images.remove(image)
