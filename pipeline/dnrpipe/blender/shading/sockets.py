"""Following links of Blender's node trees: through groups, reroutes and muted nodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import bpy

Scope = tuple[Any, ...]
"""The group nodes entered on the way to a node, outermost first."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
MAX_HOPS = 1000  # a tree that links in circles is invalid; Blender may still load one
UNDEFINED = "NodeUndefined"
"""``bl_idname`` of every node whose type this Blender does not know: it is of an add-on, or of a newer Blender."""


NOT_IN_CYCLES = {"SHADERTORGB": "is of EEVEE", "SCRIPT": "Open Shading Language is not run"}
"""Nodes that compute values elsewhere: why not here. Cycles drops them with their links."""
OUTPUTS = {"ShaderNodeOutputMaterial", "ShaderNodeOutputWorld", "ShaderNodeOutputLight"}
MAX_NESTED = 60  # groups in groups


@dataclass(frozen=True)
class Source:
    """Where a socket's value comes from.

    socket: an output socket of ``node`` when ``linked``, else the input socket whose default value counts.
    """

    socket: Any
    node: Any
    scope: Scope
    linked: bool

    @property
    def default(self) -> Any:
        """The unlinked input's own value; of a group's input, of another type than asked for."""
        return getattr(self.socket, "default_value", None)

    @property
    def number(self) -> float:
        """`default` as Cycles converts it for a number: a colour's luminance, a vector's mean; 0 of what has none."""
        value = self.default
        if isinstance(value, bool | int | float):
            return float(value)
        parts = self.colour
        weights = LUMINANCE if self.socket.type == "RGBA" else (1 / 3, 1 / 3, 1 / 3)
        return sum(part * weight for part, weight in zip(parts, weights, strict=True))

    @property
    def colour(self) -> tuple[float, float, float]:
        """`default` as Cycles converts it for a colour: a number three times; black of what is none."""
        value = self.default
        if isinstance(value, bool | int | float):
            return float(value), float(value), float(value)
        if self.socket.type not in {"RGBA", "VECTOR", "ROTATION"} or value is None:
            return 0.0, 0.0, 0.0  # texts, menus, objects, shaders, sockets of unknown type
        x, y, z = (*(float(part) for part in value), 0.0, 0.0)[:3]
        return x, y, z


def find_input(node: Any, *names: str) -> Any | None:
    """The input socket with one of these identifiers or names (sockets were renamed between versions)."""
    for name in names:
        for socket in node.inputs:
            if socket.identifier == name:
                return socket
    for name in names:
        for socket in node.inputs:
            if socket.name == name and socket.enabled:
                return socket
    return None


def computes(node: Any) -> bool:
    """Whether a node has values at all. Cycles drops those that it does not know, and groups without tree."""
    known = node.bl_idname != UNDEFINED and node.type not in NOT_IN_CYCLES
    return known and not (node.type == "GROUP" and node.node_tree is None)


def resolve(socket: Any, scope: Scope = ()) -> Source:
    """Follow an input socket to the node that computes its value, or to the default that stands for it.

    As in Cycles, measured: a node that it drops leaves ``socket`` its own default, however many groups lie between. A
    way that ends in a reroute, or in a muted node that passes nothing on, leaves the input before those its default.
    """
    asked = own = Source(socket, socket.node, scope, False)
    for _ in range(MAX_HOPS):
        if socket.node.type != "REROUTE":
            own = Source(socket, socket.node, scope, False)
        link = next((link for link in socket.links if link.is_valid and not link.is_muted), None)
        if link is None:
            return own
        node, output = link.from_node, link.from_socket
        if node.bl_idname == UNDEFINED:
            return asked
        if node.mute:
            passed = next((inner for inner in node.internal_links if inner.to_socket == output), None)
            if passed is None:
                return own
            socket = passed.from_socket
        elif not computes(node):
            return asked
        elif node.type == "REROUTE":
            socket = node.inputs[0]
        elif node.type == "GROUP":
            inside = _group_output(node.node_tree, output.identifier)
            if inside is None:
                return own
            socket, scope = inside, (*scope, node)
        elif node.type == "GROUP_INPUT" and scope:
            group = scope[-1]
            outside = next((s for s in group.inputs if s.identifier == output.identifier), None)
            if outside is None:
                return own
            socket, scope = outside, scope[:-1]
        else:
            return Source(output, node, scope, True)
    return own


def _group_output(tree: bpy.types.NodeTree, identifier: str) -> Any | None:
    outputs = [node for node in tree.nodes if node.type == "GROUP_OUTPUT"]
    active = next((node for node in outputs if getattr(node, "is_active_output", False)), None)
    node = active or (outputs[0] if outputs else None)
    if node is None:
        return None
    return next((socket for socket in node.inputs if socket.identifier == identifier), None)


def surface_source(tree: bpy.types.NodeTree | None, socket_name: str = "Surface") -> Source | None:
    """What is linked to the output node of Cycles' choice, or None."""
    output, scope = output_node(tree)
    if output is None:
        return None
    source = resolve(output.inputs[socket_name], scope)
    return source if source.linked else None


def output_node(tree: bpy.types.NodeTree | None, scope: Scope = ()) -> tuple[Any | None, Scope]:
    """The output node that Cycles takes and the groups around it: the tree's own, or the first in one of its groups."""
    if tree is None or len(scope) > MAX_NESTED:
        return None, scope
    found = tree.get_output_node("CYCLES")
    if found is None and scope:  # Blender knows the active output of whole trees alone
        outputs = [node for node in tree.nodes if node.bl_idname in OUTPUTS and not node.mute]
        found = next((node for node in outputs if getattr(node, "target", "ALL") in {"ALL", "CYCLES"}), None)
    if found is not None:
        return found, scope
    for node in tree.nodes:
        if node.type == "GROUP" and not node.mute:
            found, inside = output_node(node.node_tree, (*scope, node))
            if found is not None:
                return found, inside
    return None, ()


def walk(tree: bpy.types.NodeTree | None, seen: set[str] | None = None) -> Iterator[Any]:
    """All nodes of a tree and of the groups in it, each tree once."""
    if tree is None:
        return
    seen = set() if seen is None else seen
    key = tree.name_full + str(tree.as_pointer())
    if key in seen:
        return
    seen.add(key)
    for node in tree.nodes:
        yield node
        if node.type == "GROUP":
            yield from walk(node.node_tree, seen)
