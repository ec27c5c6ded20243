"""Does the scene have light at all?"""

from __future__ import annotations

from collections.abc import Sequence

import bpy

from .frozen import FrozenMesh


def has_light(scene: bpy.types.Scene, meshes: Sequence[FrozenMesh]) -> bool:
    """Whether a lamp, the world or an emissive material of a visible surface gives light.

    Linked (textured) inputs count as light; only plain zeros and blacks count as dark.
    """
    return _lamps(scene) or _world(scene.world) or _surfaces(meshes)


def light_warnings(scene: bpy.types.Scene, meshes: Sequence[FrozenMesh]) -> list[str]:
    """A warning when every picture of the scene would be black."""
    if has_light(scene, meshes):
        return []
    return [f"scene '{scene.name}' has no light: no lamp, a black world, no emissive surface; pictures are black"]


def _lamps(scene: bpy.types.Scene) -> bool:
    return any(
        obj.type == "LIGHT" and not obj.hide_render and obj.data.energy > 0 and max(obj.data.color) > 0
        for obj in scene.objects
    )


def _world(world: bpy.types.World | None) -> bool:
    if world is None:
        return False
    if world.node_tree is None:
        return max(world.color) > 0
    return any(_emits(node, "Color", "Strength") for node in world.node_tree.nodes if node.type == "BACKGROUND")


def _surfaces(meshes: Sequence[FrozenMesh]) -> bool:
    names = {mesh.materials[i] for mesh in meshes for i in set(mesh.material_index.tolist())}
    trees = [bpy.data.materials[name].node_tree for name in names if name is not None]
    return any(_tree_emits(tree, 0) for tree in trees if tree is not None)


def _tree_emits(tree: bpy.types.NodeTree, depth: int) -> bool:
    for node in tree.nodes:
        if node.type == "EMISSION" and _emits(node, "Color", "Strength"):
            return True
        if node.type == "BSDF_PRINCIPLED" and _emits(node, "Emission Color", "Emission Strength"):
            return True
        # Groups may nest; Blender forbids cycles, the bound guards against damaged files.
        if node.type == "GROUP" and node.node_tree and depth < 32 and _tree_emits(node.node_tree, depth + 1):
            return True
    return False


def _emits(node: bpy.types.Node, colour: str, strength: str) -> bool:
    bright = node.inputs[colour].is_linked or max(list(node.inputs[colour].default_value)[:3]) > 0
    strong = node.inputs[strength].is_linked or node.inputs[strength].default_value > 0
    return bright and strong
