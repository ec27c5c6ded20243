"""Copies of materials whose surface *emits* chosen socket values, for baking them.

All frozen meshes are baked as one object in world space (Cycles bakes object by object, and each costs a pass over
the whole image), so whatever depends on the object becomes a mesh attribute: object and generated coordinates,
Object Info, the mesh's own UV layer and colour attribute.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy

from ..shading.sockets import find_input, walk
from ..tasks import Tap

GENERATED, OBJECT, OBJECT_NORMAL = "dnrpipe.generated", "dnrpipe.object", "dnrpipe.object_normal"
LOCATION, OBJECT_COLOUR, OBJECT_NUMBERS = "dnrpipe.location", "dnrpipe.object_color", "dnrpipe.object_numbers"
ACTIVE_UV, ACTIVE_COLOUR = "dnrpipe.uv", "dnrpipe.color"
IMPLICIT_GENERATED = {
    "TEX_NOISE",
    "TEX_VORONOI",
    "TEX_WAVE",
    "TEX_MAGIC",
    "TEX_GRADIENT",
    "TEX_CHECKER",
    "TEX_BRICK",
    "TEX_GABOR",
}
"""Textures that use Generated coordinates while their Vector input is not linked (Cycles: LINK_TEXTURE_GENERATED)."""
CONSTANTS: dict[tuple[str, str], float] = {
    ("FRESNEL", "Fac"): 0.09,
    ("LAYER_WEIGHT", "Fresnel"): 0.09,
    ("LAYER_WEIGHT", "Facing"): 0.5,
    ("LIGHT_PATH", "Is Camera Ray"): 1.0,
}
"""What stands for an output that a bake cannot know; 0 where nothing is named. See values.FRESNEL_AVERAGE."""
UNKNOWABLE = {"FRESNEL", "LAYER_WEIGHT", "LIGHT_PATH", "PARTICLE_INFO", "HAIR_INFO", "POINT_INFO"}
BLENDERS_OWN = {
    *("position", "material_index", "sharp_face", "sharp_edge", "custom_normal", "crease_vert", "crease_edge"),
    *("bevel_weight_vert", "bevel_weight_edge", "freestyle_face", "freestyle_edge", "id", "radius", "velocity"),
}
"""Attributes that mean something to Blender: a colour of that name ends the process."""
SOCKETS = {"RGBA": "NodeSocketColor", "VECTOR": "NodeSocketVector"}


class TreeCopier:
    """Makes the emitting copies; groups are copied once and shared by all of them."""

    def __init__(self, image: Any) -> None:
        self.image = image
        self._groups: dict[int, Any] = {}
        self._substituted: set[int] = set()

    def copy(self, material: Any, taps: Sequence[Tap]) -> Any:
        """A copy of ``material`` that emits the taps: one colour, one normal, or up to three scalars."""
        made = material.copy()
        made.cycles.emission_sampling = "NONE"
        tree = made.node_tree
        self._own_groups(tree)
        emission = _emitting(tree)
        if taps[0].kind == "scalar":
            combined = tree.nodes.new("ShaderNodeCombineColor")
            for index, tap in enumerate(taps):
                tree.links.new(self._reach(tree, tap), combined.inputs[index])
            value = combined.outputs[0]
        else:
            value = self._reach(tree, taps[0])
            if taps[0].kind == "normal":
                encode = tree.nodes.new("ShaderNodeVectorMath")
                encode.operation = "MULTIPLY_ADD"
                tree.links.new(value, encode.inputs[0])
                encode.inputs[1].default_value = encode.inputs[2].default_value = (0.5, 0.5, 0.5)
                value = encode.outputs[0]
        tree.links.new(value, emission.inputs["Color"])
        for group in self._groups.values():
            for node in [node for node in group.nodes if node.type == "OUTPUT_MATERIAL"]:
                group.nodes.remove(node)
        for owned in [tree, *self._groups.values()]:
            self._substitute(owned)
        _target(tree, self.image)
        return made

    def dark(self) -> Any:
        """A material that emits nothing, for faces that are not baked."""
        made = bpy.data.materials.new("dnrpipe.dark")
        made.cycles.emission_sampling = "NONE"
        _emitting(made.node_tree).inputs["Color"].default_value = (0, 0, 0, 1)
        _target(made.node_tree, self.image)
        return made

    def _own_groups(self, tree: Any) -> None:
        for node in tree.nodes:
            if node.type == "GROUP" and node.node_tree is not None:
                pointer = node.node_tree.as_pointer()
                if pointer not in self._groups:
                    own = node.node_tree.copy()
                    self._groups[pointer] = own
                    self._groups[own.as_pointer()] = own
                    self._own_groups(own)
                node.node_tree = self._groups[pointer]

    def _reach(self, tree: Any, tap: Tap) -> Any:
        """The tapped value as an output socket in the material's own tree, led out of its groups."""
        entered = []
        for name in tap.groups:
            entered.append((tree, tree.nodes[name]))
            tree = tree.nodes[name].node_tree
        socket = next(s for s in tree.nodes[tap.node].outputs if s.identifier == tap.socket)
        for outer, group in reversed(entered):
            kind = SOCKETS.get(socket.type, "NodeSocketFloat")
            item = tree.interface.new_socket(name="dnrpipe", in_out="OUTPUT", socket_type=kind)
            end = _group_output(tree)
            tree.links.new(socket, next(s for s in end.inputs if s.identifier == item.identifier))
            socket = next(s for s in group.outputs if s.identifier == item.identifier)
            tree = outer
        return socket

    def _substitute(self, tree: Any) -> None:
        """Replace what depends on the object or on the ray; once per tree."""
        if tree.as_pointer() in self._substituted:
            return
        self._substituted.add(tree.as_pointer())
        for node in list(tree.nodes):
            place = find_input(node, "Vector") if node.type in IMPLICIT_GENERATED else None  # None: one-dimensional
            if place is not None and not place.is_linked:
                tree.links.new(_attribute(tree, GENERATED, "Vector"), place)
            elif node.type == "TEX_COORD":
                if node.object is None:
                    _replace(tree, node, "Object", _attribute, OBJECT, "Vector")
                _replace(tree, node, "Generated", _attribute, GENERATED, "Vector")
                _replace(tree, node, "Normal", _attribute, OBJECT_NORMAL, "Vector")
            elif node.type == "OBJECT_INFO":
                _replace(tree, node, "Location", _attribute, LOCATION, "Vector")
                _replace(tree, node, "Color", _attribute, OBJECT_COLOUR, "Color")
                _replace(tree, node, "Alpha", _attribute, OBJECT_COLOUR, "Alpha")
                _replace(tree, node, "Object Index", _channel, OBJECT_NUMBERS, 0)
                _replace(tree, node, "Random", _channel, OBJECT_NUMBERS, 1)
            elif node.type == "VERTEX_COLOR":
                node.layer_name = colour_name(node.layer_name) or ACTIVE_COLOUR
            elif node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY":
                node.attribute_name = baked_name(node.attribute_name) or ACTIVE_COLOUR
            elif node.type in {"UVMAP", "NORMAL_MAP", "TANGENT"}:
                node.uv_map = baked_name(node.uv_map)
            elif node.type in UNKNOWABLE:
                for output in node.outputs:
                    _replace(tree, node, output.name, _value, CONSTANTS.get((node.type, output.name), 0.0))


def baked_name(name: str) -> str:
    """What an attribute of the mesh is called on the mesh that is baked."""
    return f"dnrpipe.own.{name}" if name in BLENDERS_OWN or name.startswith(".") else name


def colour_name(name: str) -> str:
    """What a colour is called there that a Color Attribute node reads: one that finds a UV layer ends the process."""
    return f"dnrpipe.colour.{name}" if name else ""


def attribute_names(material: Any) -> set[str]:
    """Names of the mesh attributes (UV layers, colours and others) that the material's nodes ask for."""
    names = set()
    for node in walk(material.node_tree):
        if node.type in {"UVMAP", "NORMAL_MAP", "TANGENT"}:
            names.add(node.uv_map)
        elif node.type == "VERTEX_COLOR":
            names.add(node.layer_name)
        elif node.type == "ATTRIBUTE" and node.attribute_type == "GEOMETRY":
            names.add(node.attribute_name)
    return names - {""}


def _emitting(tree: Any) -> Any:
    """Replace the tree's outputs by one that emits; returns the Emission node."""
    for node in [node for node in tree.nodes if node.type == "OUTPUT_MATERIAL"]:
        tree.nodes.remove(node)
    emission = tree.nodes.new("ShaderNodeEmission")
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    output.is_active_output = True
    return emission


def _target(tree: Any, image: Any) -> None:
    """The image that Blender's bake operator writes to: that of the active node."""
    for node in tree.nodes:
        node.select = False
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    node.select = True
    tree.nodes.active = node


def _group_output(tree: Any) -> Any:
    ends = [node for node in tree.nodes if node.type == "GROUP_OUTPUT"] or [tree.nodes.new("NodeGroupOutput")]
    return next((node for node in ends if node.is_active_output), ends[0])


def _replace(tree: Any, node: Any, output: str, make: Any, *arguments: Any) -> None:
    """Let what is linked to an output of ``node`` read ``make(tree, *arguments)`` instead."""
    found = next((socket for socket in node.outputs if socket.name == output), None)
    if found is None or not found.is_linked:
        return
    made = make(tree, *arguments)
    for link in list(found.links):
        tree.links.new(made, link.to_socket)


def _attribute(tree: Any, name: str, output: str) -> Any:
    node = tree.nodes.new("ShaderNodeAttribute")
    node.attribute_name = name
    return node.outputs[output]


def _channel(tree: Any, name: str, channel: int) -> Any:
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(_attribute(tree, name, "Vector"), split.inputs[0])
    return split.outputs[channel]


def _value(tree: Any, number: float) -> Any:
    node = tree.nodes.new("ShaderNodeValue")
    node.outputs[0].default_value = number
    return node.outputs[0]
