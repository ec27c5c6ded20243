"""What a frame takes over of the conversion of another one: places in the atlas, and the bakes that still hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.frozen import FrozenMesh
from ..shading.sockets import Source
from ..tasks import ValueKind
from .graph import AROUND, FROM_CAMERA, PER_OBJECT

PLACED_NODES = {"NEW_GEOMETRY", "VECT_TRANSFORM", "TANGENT", *AROUND, *PER_OBJECT}
"""Nodes whose value depends on where in the world the surface is, or how it is turned."""
RIGID = 1e-5
"""Largest distance, of a mesh's size, between a mesh and an earlier one moved as a whole that counts as rounding."""


class Earlier:
    """The frozen meshes of another frame's conversion, in its order.

    meshes: as in its ``geometry.npz``.
    """

    def __init__(self, meshes: Sequence[FrozenMesh]) -> None:
        self.meshes = meshes
        self._before: dict[int, FrozenMesh] = {}

    def take_places(self, meshes: Sequence[FrozenMesh]) -> tuple[list[FrozenMesh], list[FrozenMesh]]:
        """Give meshes of the same name and number of triangles their earlier places in the atlas.

        Returns:
            The meshes that fill the atlas, in the earlier order (those that are gone as they were, so that every
            region keeps its texels), and the meshes that have no place.
        """
        now = {(mesh.name, mesh.triangles): mesh for mesh in meshes}
        filled = []
        for before in self.meshes:
            mesh = now.pop((before.name, before.triangles), None)
            filled.append(before if mesh is None else mesh)
            if mesh is not None:
                mesh.atlas = before.atlas
                self._before[id(mesh)] = before
        return filled, list(now.values())

    def stand_in(self, mesh: FrozenMesh, kind: ValueKind, nodes: Sequence[Source]) -> FrozenMesh:
        """The mesh that a value has the same bake on: the earlier one, or ``mesh`` where the bake has to be its own.

        kind, nodes: the value, and all that it depends on.
        """
        before = self._before.get(id(mesh))
        if before is None or kind == "normal" or not _looks_alike(mesh, before):
            return mesh
        types = {entry.node.type for entry in nodes}
        read = {
            (output.name, entry.node.object is not None)
            for entry in nodes
            if entry.node.type == "TEX_COORD"
            for output in entry.node.outputs
            if output.is_linked
        }
        names = {name for name, _ in read}
        if types & PLACED_NODES or names & set(FROM_CAMERA) or ("Object", True) in read:
            return mesh
        if names & {"Object", "Normal"} and not _is_rigid(mesh, before):
            return mesh
        return before


def _looks_alike(mesh: FrozenMesh, before: FrozenMesh) -> bool:
    """Whether nothing but positions and normals differs."""
    names = ("materials", "active_uv", "active_color")
    if any(getattr(mesh, name) != getattr(before, name) for name in names):
        return False
    pairs = [(mesh.material_index, before.material_index)]
    for now, then in ((mesh.uv_layers, before.uv_layers), (mesh.colors, before.colors)):
        if now.keys() != then.keys():
            return False
        pairs += [(now[name], then[name]) for name in now]
    return all(np.array_equal(now, then) for now, then in pairs)


def _is_rigid(mesh: FrozenMesh, before: FrozenMesh) -> bool:
    """Whether the mesh is the earlier one, moved as its object is (turned, scaled or sheared too)."""
    if abs(np.linalg.det(before.object_to_world[:3, :3])) < 1e-30:
        return False
    motion = mesh.object_to_world @ np.linalg.inv(before.object_to_world)
    moved = before.positions.astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]
    size = np.ptp(moved, axis=0).max() + np.abs(motion[:3, 3]).max() * 1e-2
    return bool(np.abs(moved - mesh.positions).max() <= RIGID * size)
