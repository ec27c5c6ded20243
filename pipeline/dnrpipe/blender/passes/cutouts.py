"""Alpha in the G-buffers: materials that emit where the surface is opaque, and are transparent elsewhere.

G-buffers ask "is the surface there" at the pixel centre (opacity above one half), coverage asks "how much of it":
the same materials serve both, with the threshold on or off.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import bpy
import numpy as np

from ..bundle.shapes import uv_layer
from ..geometry.frozen import FrozenMesh
from ..shading.textures import Constant, Textured, Value, constant
from ..shading.view_dependent import average

CUT_LAYER = "dnrpipe.cut"
"""UV layer of the G-buffer meshes: coordinates in the opacity image, its affine placement included."""
MATERIAL_PREFIX = "dnrpipe.cut."
THRESHOLD_NODE = "threshold"
HALF = 0.5
TRANSPARENT_BOUNCES = 128
EXTENSIONS = {"repeat": "REPEAT", "clamp": "EXTEND", "mirror": "MIRROR"}


def is_opaque(opacity: Value) -> bool:
    """Whether a surface of this opacity is there everywhere."""
    return opacity.scalar >= 1 if isinstance(opacity, Constant) else bool(opacity.linear().min() >= 1)


def is_absent(opacity: Value) -> bool:
    """Whether a surface of this opacity is there nowhere (a container of a volume, say)."""
    return isinstance(opacity, Constant) and opacity.scalar <= 0


def placed(opacity: Value) -> Value:
    """``opacity`` as the G-buffers can have it: what is no plain image on a UV layer (Fresnel, say) is its mean."""
    opacity = average(opacity)
    return constant(opacity.mean) if isinstance(opacity, Textured) and not opacity.placement.plain else opacity


def emission_material(name: str) -> bpy.types.Material:
    """Emission: the cheapest shader, and the only kind whose Normal pass is the geometry's, not a BSDF's."""
    return _emission(name)[0]


def cutout_material(name: str, opacity: Value) -> bpy.types.Material:
    """Mix of transparent and emission by ``opacity``, above one half until `soften` is called."""
    material, emission, output = _emission(f"{MATERIAL_PREFIX}{name}")
    tree = material.node_tree
    mix, clear = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeBsdfTransparent")
    hard = tree.nodes.new("ShaderNodeMath")
    hard.name, hard.operation = THRESHOLD_NODE, "GREATER_THAN"
    hard.inputs[1].default_value = HALF
    if isinstance(opacity, Textured):
        source = _image_node(tree, name, opacity)
    else:
        value = tree.nodes.new("ShaderNodeValue")
        value.outputs[0].default_value = opacity.scalar
        source = value.outputs[0]
    tree.links.new(source, hard.inputs[0])
    tree.links.new(hard.outputs[0], mix.inputs["Fac"])
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(emission.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    return material


def soften(materials: Iterable[bpy.types.Material]) -> None:
    """Take the threshold out of the cut-out materials: alpha then is the surface's opacity (for coverage)."""
    for material in materials:
        if not material.name.startswith(MATERIAL_PREFIX):
            continue
        tree = material.node_tree
        hard = tree.nodes[THRESHOLD_NODE]
        tree.links.new(hard.inputs[0].links[0].from_socket, hard.outputs[0].links[0].to_socket)


def cut_coordinates(mesh: FrozenMesh, opacities: Mapping[str | None, Value]) -> np.ndarray:
    """Each corner's coordinates in the opacity image of its material, float32 [3T, 2]; 0 where it has none."""
    result = np.zeros((len(mesh.positions), 2), np.float32)
    for slot, name in enumerate(mesh.materials):
        opacity = opacities.get(name)
        if not isinstance(opacity, Textured):
            continue
        uv = uv_layer(mesh, opacity.placement.uv)
        if uv is None:
            continue  # coordinates are 0, as in Cycles
        corners = np.repeat(mesh.material_index == slot, 3)
        affine = np.asarray(opacity.placement.to_uv, np.float64)
        result[corners] = uv[corners] @ affine[:2, :2].T + affine[:2, 2]
    return result


def _emission(name: str) -> tuple[bpy.types.Material, bpy.types.Node, bpy.types.Node]:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    emission = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    material.cycles.emission_sampling = "NONE"  # else every triangle becomes a light, with a light tree to build
    return material, emission, output


def _image_node(tree: bpy.types.NodeTree, name: str, opacity: Textured) -> bpy.types.NodeSocket:
    """Image Texture node with the opacity as plain numbers; its colour output."""
    values = np.clip(opacity.linear(), 0, 1).mean(axis=2)
    height, width = values.shape
    # 8-bit opacities (nearly all) stay 8-bit: Cycles and source.blend hold a quarter of the memory.
    image = bpy.data.images.new(
        f"{MATERIAL_PREFIX}{name}", width, height, float_buffer=opacity.texels.dtype != np.uint8
    )
    image.colorspace_settings.name = "Non-Color"
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = values[..., None]
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    node.extension = EXTENSIONS[opacity.placement.wrap]
    node.interpolation = "Closest" if opacity.placement.filter == "nearest" else "Linear"
    place = tree.nodes.new("ShaderNodeUVMap")
    place.uv_map = CUT_LAYER
    tree.links.new(place.outputs["UV"], node.inputs["Vector"])
    return node.outputs["Color"]
