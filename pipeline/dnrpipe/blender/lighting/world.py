"""Blender worlds -> Mitsuba environment emitters."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

import bpy
import numpy as np

from ..bundle import xmltree
from ..shading.materials import MaterialConverter
from ..shading.sockets import Source, find_input, resolve, surface_source, walk
from ..shading.textures import TextureStore, finite_texels, srgb_to_linear
from .lights import far_disc
from .sky_sun import find_sun, measure, plain_colour, plain_number, rotation, without_disc
from .world_images import SIZE, render_equirect

ENVMAP_TO_BLENDER = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=np.float64)
"""B: Mitsuba's envmap frame (Y up) to Blender's equirectangular frame."""
MAX_EXACT_ROWS = 1024
"""Environment images up to this height are resampled without loss."""


def export_world(world: Any, root: ET.Element, converter: MaterialConverter, center: np.ndarray, radius: float) -> None:
    """Append the world's emitter to ``root``, if there is a world and it is not black.

    Constant Background -> ``constant``; Environment Texture with constant strength -> ``envmap``, rotated by its
    Mapping node; any other node tree is rendered once with Cycles as an equirectangular image, the sun disc of a Sky
    Texture apart. center, radius: bounds of the geometry.
    """
    if world is None:
        return
    findings = converter.findings
    rays = ("diffuse", "glossy", "transmission")
    hidden = [ray for ray in rays if not getattr(world.cycles_visibility, ray)]
    if hidden:
        findings.add("ignored", f"world '{world.name}' ray visibility", f"{', '.join(hidden)} rays see it")
    tree = world.node_tree
    if tree is None:
        _constant(root, np.array(world.color))
        return
    if surface_source(tree, "Volume") is not None:
        findings.add("ignored", f"world '{world.name}' volume", "no fog or atmosphere")
    source = surface_source(tree)
    if source is None:
        return
    if source.node.type == "BACKGROUND":
        strength = resolve(source.node.inputs["Strength"], source.scope)
        colour = resolve(source.node.inputs["Color"], source.scope)
        amount = plain_number(strength)
        if amount is not None:
            plain = plain_colour(colour)
            if plain is not None:
                _constant(root, plain * amount)
                return
            if abs(amount) < 1e-8:
                return
            if colour.node.type == "TEX_ENVIRONMENT" and _hdri(root, colour, amount, converter, world.name):
                return
    _rendered(world, root, converter, center, radius)


def _constant(root: ET.Element, radiance: np.ndarray) -> None:
    if np.any(radiance > 0):
        element = xmltree.plugin("emitter", "constant", id="world")
        xmltree.rgb(element, "radiance", np.maximum(radiance, 0))
        root.append(element)


def _hdri(root: ET.Element, source: Source, strength: float, converter: MaterialConverter, world: str) -> bool:
    """Environment Texture -> ``envmap`` with to_world = R^-1 B; False when its coordinates are not a rotation."""
    node = source.node
    turn = rotation(find_input(node, "Vector"), source.scope)
    if node.projection != "EQUIRECTANGULAR" or turn is None:
        return False
    if node.image is None:
        converter.findings.add("missing", f"world '{world}' image", "no image chosen; magenta light stands for it")
        _constant(root, np.array([1.0, 0.0, 1.0]) * strength)
        return strength > 0
    texels, srgb = converter.images.read(node.image, None)
    colour = texels[..., :3]
    if colour.dtype == np.uint8:
        codes = colour.astype(np.float32) / 255
        colour = srgb_to_linear(codes) if srgb else codes
    _envmap(root, colour, strength, turn.T @ ENVMAP_TO_BLENDER, converter.store, f"{world}-{node.image.name}")
    return True


def _envmap(
    root: ET.Element, bottom_up: np.ndarray, strength: float, turn: np.ndarray, store: TextureStore, label: str
) -> None:
    """``envmap`` from an equirectangular image in Blender's row order (Mitsuba's wants the zenith first).

    Both centre column i at (i + 0.5) / width; row j lies at (j + 0.5) / height in Blender and at j / (height - 1)
    in Mitsuba 3.9.1 (measured): see `rows_to_nodes`.
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


def _rendered(world: Any, root: ET.Element, converter: MaterialConverter, center: np.ndarray, radius: float) -> None:
    """Any other world -> rendered once by Cycles as an equirectangular image (sky textures, gradients, mixes)."""
    findings = converter.findings
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
        sun = find_sun(copy)
        if sun is None:
            pixels = render_equirect(copy)
        else:
            irradiance = measure(copy, sun)
            with without_disc(sun):
                pixels = render_equirect(copy)
            if np.any(irradiance > 0):
                root.append(far_disc(-sun.direction, sun.angle, irradiance, "light-sky-sun", center, radius))
                findings.add("exact", f"world '{world.name}' sun disc", "a far disc of the same light")
    finally:
        bpy.data.worlds.remove(copy)
    pixels = finite_texels(pixels, f"world '{world.name}'", findings)
    if np.any(pixels > 0):
        note = f"its nodes are rendered into a {SIZE[0]} x {SIZE[1]} environment image"
        findings.add("baked", f"world '{world.name}'", note)
        _envmap(root, pixels, 1.0, ENVMAP_TO_BLENDER, converter.store, f"{world.name}-world")


def _unlink_camera_rays(tree: bpy.types.NodeTree) -> None:
    for node in tree.nodes:
        if node.type != "LIGHT_PATH":
            continue
        for link in list(node.outputs["Is Camera Ray"].links):
            target = link.to_socket
            tree.links.remove(link)
            target.default_value = 0.0 if target.type == "VALUE" else (0.0, 0.0, 0.0, 1.0)
