"""What a frame takes over of the conversion of another one: the objects' numbers, places in the atlas, and the bakes
that still hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.freeze import MOST_IDS
from ..geometry.frozen import FrozenMesh
from ..shading.sockets import Source, resolve
from ..tasks import ValueKind
from .graph import AROUND, FROM_CAMERA, PER_OBJECT

PLACED_NODES = {"NEW_GEOMETRY", "VECT_TRANSFORM", "TANGENT", *AROUND, *PER_OBJECT}
"""Nodes whose value depends on where in the world the surface is, or how it is turned."""
RIGID = 1e-5
"""Largest difference, of the largest number, that counts as rounding."""


class Earlier:
    """The frozen meshes of another frame's conversion, in its order.

    meshes: as in its ``geometry.npz``.
    """

    def __init__(self, meshes: Sequence[FrozenMesh]) -> None:
        self.meshes = meshes
        self._before: dict[int, FrozenMesh] = {}

    def take_numbers(self, meshes: Sequence[FrozenMesh], known: Sequence[str]) -> None:
        """Give objects their earlier numbers, which ``object_names`` of the scene's summary holds, and those that were
        not there numbers above these: the same at every frame.

        known: names of all objects of the file, in an order that all frames share.
        """
        numbers = {before.object_name: before.object_id for before in self.meshes}
        last = max(numbers.values(), default=0)
        for name in (*known, *(mesh.object_name for mesh in meshes)):
            if name not in numbers:
                last = min(last + 1, MOST_IDS)
                numbers[name] = last
        for mesh in meshes:
            mesh.object_id = numbers[mesh.object_name]

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

    def before(self, mesh: FrozenMesh) -> FrozenMesh:
        """The earlier mesh in its place, or itself."""
        return self._before.get(id(mesh), mesh)

    def stand_in(self, mesh: FrozenMesh, kind: ValueKind, nodes: Sequence[Source]) -> FrozenMesh:
        """The mesh that a value has the same bake on: the earlier one, or ``mesh`` where the bake has to be its own.

        kind, nodes: the value, and all that it depends on.
        """
        return mesh if kind == "normal" or not self._keeps(mesh, nodes) else self.before(mesh)

    def turns(self, meshes: Sequence[FrozenMesh], source: Source, nodes: Sequence[Source]) -> np.ndarray | None:
        """How baked normals have turned on each mesh: rotations float64 [K, 3, 3]; None where they are not just that.

        source, nodes: the normals, and all that they depend on.
        """
        if not _is_relief(source) or not all(self._keeps(mesh, nodes) for mesh in meshes):
            return None
        found = []
        for mesh in meshes:
            before = self.before(mesh)
            if not _is_rigid(mesh, before):
                return None
            turn = np.eye(3) if mesh is before else _motion(mesh, before)[:3, :3]
            if np.abs(turn @ turn.T - np.eye(3)).max() > RIGID or np.linalg.det(turn) < 0:
                return None
            found.append(turn)
        return np.array(found)

    def _keeps(self, mesh: FrozenMesh, nodes: Sequence[Source]) -> bool:
        """Whether values that depend on the nodes stick to the surface since the earlier frame."""
        before = self.before(mesh)
        if before is mesh:
            return True
        if not _looks_alike(mesh, before):
            return False
        types = {entry.node.type for entry in nodes}
        coordinates = [entry.node for entry in nodes if entry.node.type == "TEX_COORD"]
        read = {output.name for node in coordinates for output in node.outputs if output.is_linked}
        if types & PLACED_NODES or read & set(FROM_CAMERA) or any(node.object is not None for node in coordinates):
            return False
        return not read & {"Object", "Normal"} or _is_rigid(mesh, before)


def _is_relief(source: Source) -> bool:
    """Whether normals come from bumps and normal maps alone, which turn with their surface."""
    node = source.node
    if node.type == "NORMAL_MAP":
        return node.space in {"TANGENT", "OBJECT", "BLENDER_OBJECT"}
    if node.type != "BUMP":
        return False
    below = resolve(node.inputs["Normal"], source.scope)
    return not below.linked or _is_relief(below)


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


def _motion(mesh: FrozenMesh, before: FrozenMesh) -> np.ndarray:
    """World space then -> world space now, float64 [4, 4], of an object that is not flat."""
    return mesh.object_to_world @ np.linalg.inv(before.object_to_world)


def _is_rigid(mesh: FrozenMesh, before: FrozenMesh) -> bool:
    """Whether the mesh is the earlier one, moved as its object is (turned, scaled or sheared too)."""
    if mesh is before:
        return True
    if abs(np.linalg.det(before.object_to_world[:3, :3])) < 1e-30:
        return False
    motion = _motion(mesh, before)
    moved = before.positions.astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]
    return bool(np.abs(moved - mesh.positions).max() <= RIGID * np.abs(moved).max())
