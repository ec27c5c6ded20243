"""Names of data-blocks: text that old Blenders did not write as UTF-8, and names that libraries share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy


def repair_names() -> list[str]:
    """Rename data-blocks, UV layers, colour attributes and nodes whose names are not UTF-8; return a warning.

    Blender 2.4x wrote names in the user's own encoding; reading one raises UnicodeDecodeError. Latin-1,
    by far the commonest, reads any bytes.
    """
    repaired = []
    for block in _named():
        try:
            _ = block.name
        except UnicodeDecodeError as error:
            raw = error.object
            name = raw.decode("latin-1")
            try:
                block.name = name
            except (AttributeError, RuntimeError):  # linked data keep their library's names
                continue
            repaired.append(name)
    if not repaired:
        return []
    shown = ", ".join(repaired[:5])
    return [f"{len(repaired)} name(s) are not UTF-8, as in files of old Blenders; read as Latin-1: {shown}"]


def _named() -> Iterator[Any]:
    for collection in data_collections():
        yield from collection
    for mesh in bpy.data.meshes:
        yield from mesh.uv_layers
        yield from mesh.color_attributes
    for _, tree in node_trees():
        yield from tree.nodes


def data_collections() -> list[Any]:
    """All collections of data-blocks of the open file (``bpy.data.objects`` and so on)."""
    return [getattr(bpy.data, prop.identifier) for prop in bpy.data.bl_rna.properties if prop.type == "COLLECTION"]


def node_trees() -> Iterator[tuple[Any, Any]]:
    """(owner, tree) of every node tree of the open file: groups own themselves; materials, worlds and lights theirs."""
    for group in bpy.data.node_groups:
        yield group, group
    for owners in (bpy.data.materials, bpy.data.worlds, bpy.data.lights):
        for owner in owners:
            if owner.node_tree is not None:
                yield owner, owner.node_tree


def find_material(name_full: str) -> Any | None:
    """The material of that ``name_full``; None when there is none.

    A plain name is ambiguous: materials of several libraries may share it, and ``bpy.data.materials.get``
    returns any of them. ``name_full`` adds the library.
    """
    found = bpy.data.materials.get(name_full)
    if found is not None and found.name_full == name_full:
        return found
    return next((material for material in bpy.data.materials if material.name_full == name_full), None)
