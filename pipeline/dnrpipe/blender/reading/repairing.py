"""Shader trees and lamps that no renderer could take: links in circles, numbers that are not finite."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

from ..findings import first_of
from .names import node_trees

SHOWN = 4
LARGEST = 1e15  # Blender stores an infinite number as the largest float, 3.4e38; products of two must not overflow
LAMP_NUMBERS = ("energy", "shadow_soft_size", "size", "size_y", "angle", "spot_size", "spot_blend", "exposure")


def repair_shaders() -> list[str]:
    """Cut links that close a circle, make numbers finite, in the open file; one warning line for each kind.

    As Cycles does: a circle is cut at the link that closes it, seen from the output. NaN and infinite numbers become
    the default of a new node, or 0.
    """
    cut: list[str] = []
    numbers: list[str] = []
    profiles: list[str] = []
    for holder, tree in node_trees():
        if tree.bl_idname != "ShaderNodeTree":
            continue
        owner = holder.name_full
        links = list(_closing_links(tree))
        cut += [f"{owner}: {link.from_node.name} to {link.to_node.name}" for link in links]
        for node in [node for node in tree.nodes if node.type == "TEX_IES" and not _has_profile(node, holder)]:
            profiles.append(f"{owner}: {node.name}")
            links += [link for link in tree.links if link.from_node == node and link not in links]
        for link in links:
            tree.links.remove(link)
        for node, socket in list(_bad_sockets(tree)):
            _replace(node, socket)
            numbers.append(f"{owner}: {node.name}, {socket.name}")
    for light in bpy.data.lights:
        for name in LAMP_NUMBERS:
            if not _usable(getattr(light, name, 0.0)):
                setattr(light, name, 0.0)
                numbers.append(f"{light.name_full}: {name}")
        if not all(_usable(value) for value in light.color):
            light.color = (0, 0, 0)
            numbers.append(f"{light.name_full}: color")
    found = {
        "shader link(s) run in a circle and are cut": cut,
        "IES texture(s) have no light profile and are cut off": profiles,
        f"number(s) are not finite (NaN, infinite, beyond {LARGEST:g}) and are replaced": numbers,
    }
    return [f"{len(where)} {what}: {first_of(where, SHOWN, '; ')}" for what, where in found.items() if where]


def _has_profile(node: Any, holder: Any) -> bool:
    """Whether an IES texture has a text or a file: in a world, Cycles ends the process without one."""
    if node.mode == "INTERNAL":
        return node.ies is not None
    return Path(bpy.path.abspath(node.filepath, library=holder.library)).is_file()


def _usable(number: float) -> bool:
    return abs(number) < LARGEST  # False for NaN


def _closing_links(tree: bpy.types.NodeTree) -> Iterator[Any]:
    """The links that lead back to a node on the way from an output to it (depth first, without recursion)."""
    incoming: dict[Any, list[Any]] = {}
    for link in tree.links:
        incoming.setdefault(link.to_node, []).append(link)
    done: set[Any] = set()
    ends = [node for node in tree.nodes if not any(socket.is_linked for socket in node.outputs)]
    for start in [*ends, *tree.nodes]:  # circles without an end are found from any of their nodes
        if start in done:
            continue
        open_nodes = {start}
        stack = [(start, iter(incoming.get(start, [])))]
        while stack:
            node, links = stack[-1]
            link = next(links, None)
            if link is None:
                stack.pop()
                open_nodes.discard(node)
                done.add(node)
            elif link.from_node in open_nodes:
                yield link
            elif link.from_node not in done:
                open_nodes.add(link.from_node)
                stack.append((link.from_node, iter(incoming.get(link.from_node, []))))


def _bad_sockets(tree: bpy.types.NodeTree) -> Iterator[tuple[Any, Any]]:
    """(node, socket) whose value is not finite."""
    for node in tree.nodes:
        for socket in (*node.inputs, *node.outputs):
            if socket.type not in {"VALUE", "RGBA", "VECTOR"} or not hasattr(socket, "default_value"):
                continue  # sockets of unknown type have no value
            value = socket.default_value
            if not all(_usable(number) for number in ([value] if isinstance(value, float) else value)):
                yield node, socket


def _replace(node: Any, socket: Any) -> None:
    """Give a socket what a new node of this kind has there; 0 where it has no such socket (groups)."""
    scratch: Any = bpy.data.node_groups.new("dnrpipe.repairing", "ShaderNodeTree")
    try:
        fresh = scratch.nodes.new(node.bl_idname)
        kind = "outputs" if socket.is_output else "inputs"
        found = next((s for s in getattr(fresh, kind) if s.identifier == socket.identifier), None)
        if isinstance(socket.default_value, float):
            socket.default_value = 0.0 if found is None else found.default_value
        else:
            socket.default_value = [0.0] * len(socket.default_value) if found is None else list(found.default_value)
    finally:
        bpy.data.node_groups.remove(scratch)
