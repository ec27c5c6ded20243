"""The frozen scene: evaluated, world-space triangles, and its file ``scene/geometry.npz``. No bpy here."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.errors import UserError
from dnrtrain.atomic import atomic_path
from dnrtrain.contract import NPZ_ERRORS

GEOMETRY_VERSION = 2

ATLAS_LAYER = "dnrpipe.atlas"
"""The scene atlas as a UV layer: ``FrozenMesh.atlas``."""
TextureSpace = tuple[tuple[float, float, float], tuple[float, float, float]]
UNIT_TEXTURE_SPACE: TextureSpace = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
ARRAY_FIELDS = ("positions", "normals", "material_index", "atlas", "object_to_world", "copies")
HEADER_FIELDS = (
    *("name", "object_name", "object_id", "materials", "active_uv", "uv_layers", "colors", "active_color"),
    *("texture_space", "camera_visible", "strands"),
)
"""Fields of `FrozenMesh` in the JSON header of the file; of the layers, their names."""


@dataclass
class FrozenMesh:
    """One object's surface as unindexed triangles: corner ``3 t + k`` is corner k of triangle t.

    Every instance of a scene has a mesh of its own, up to a budget; beyond it they are ``copies`` of one.

    Counter-clockwise winding seen from outside, also for mirrored transforms.
    """

    name: str
    """Unique per instance; safe for file names."""
    object_name: str
    """Name of the object that carries the geometry (shared by its instances)."""
    object_id: int
    """1-based; the value of channel ``object.Id``."""
    positions: np.ndarray
    """float32 [3T, 3], world space, scene units."""
    normals: np.ndarray
    """float32 [3T, 3], world space, unit."""
    material_index: np.ndarray
    """int32 [T], into ``materials``."""
    materials: list[str | None]
    """Material names by slot (object- or data-linked), never empty; None is an empty slot."""
    uv_layers: dict[str, np.ndarray] = field(default_factory=dict)
    """float32 [3T, 2] each: the artist's layers, V up."""
    active_uv: str | None = None
    """The layer that renders use by default, or None when there is no layer."""
    atlas: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    """float32 [3T, 2] in [0, 1), V up: this instance's own place in the scene's atlas ([0, 2] until packed)."""
    colors: dict[str, np.ndarray] = field(default_factory=dict)
    """float32 [3T, 4] each: colour attributes, linear Rec.709 and alpha."""
    active_color: str | None = None
    """The colour attribute that renders use by default, or None when there is none."""
    object_to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    """float64 [4, 4]: the object's matrix; its inverse takes ``positions`` to Blender's Object coordinates."""
    texture_space: TextureSpace = UNIT_TEXTURE_SPACE
    """(location, size), object space: Generated = (object position - location) / (2 size) + 1/2."""
    copies: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """float64 [K, 4, 4]: further instances, as maps from this mesh's world space to the copy's (identity not listed).

    They share the atlas place and the object id of this mesh.
    """
    camera_visible: bool = True
    """False: seen in mirrors and by indirect light only (Blender's Ray Visibility, Camera)."""

    strands: bool = False
    """Hair, as thin tubes."""

    @property
    def triangles(self) -> int:
        """Triangles stored, copies not counted."""
        return len(self.material_index)

    def extent(self) -> np.ndarray:
        """Points [N, 3], float64, world space, whose bounds are those of the mesh and all its copies.

        The vertices, and for every copy the corners of its (transformed) box.
        """
        points = self.positions.astype(np.float64)
        if not len(self.copies):
            return points
        low, high = points.min(0), points.max(0)
        box = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] + [1.0] for k in range(8)])
        return np.concatenate([points, (box @ self.copies.transpose(0, 2, 1)).reshape(-1, 4)[:, :3]])


def save_geometry(path: Path, meshes: Sequence[FrozenMesh]) -> None:
    """Write the meshes as an uncompressed npz, atomically."""
    arrays: dict[str, Any] = {}
    index = []
    for i, mesh in enumerate(meshes):
        names = {"uv_layers": list(mesh.uv_layers), "colors": list(mesh.colors)}
        index.append({key: names.get(key, getattr(mesh, key)) for key in HEADER_FIELDS})
        arrays |= {f"{i}.{key}": getattr(mesh, key) for key in ARRAY_FIELDS}
        for j, uv in enumerate(mesh.uv_layers.values()):
            arrays[f"{i}.uv.{j}"] = uv
        for j, color in enumerate(mesh.colors.values()):
            arrays[f"{i}.color.{j}"] = color
    header = json.dumps({"version": GEOMETRY_VERSION, "meshes": index}).encode()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, header=np.frombuffer(header, np.uint8), **arrays)


def load_geometry(path: Path) -> list[FrozenMesh]:
    """Read what `save_geometry` wrote.

    Raises UserError when the file is missing, damaged or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            header = json.loads(data["header"].tobytes())
            if header["version"] != GEOMETRY_VERSION:
                raise UserError(f"{path}: geometry of version {header['version']}; run `dnrpipe prepare` again")
            meshes = []
            for i, entry in enumerate(header["meshes"]):
                known = {key: entry[key] for key in HEADER_FIELDS}
                known["uv_layers"] = {name: data[f"{i}.uv.{j}"] for j, name in enumerate(entry["uv_layers"])}
                known["colors"] = {name: data[f"{i}.color.{j}"] for j, name in enumerate(entry["colors"])}
                location, size = entry["texture_space"]
                known["texture_space"] = tuple(location), tuple(size)
                meshes.append(FrozenMesh(**known, **{key: data[f"{i}.{key}"] for key in ARRAY_FIELDS}))
            return meshes
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; run `dnrpipe prepare` first") from None
    except NPZ_ERRORS as error:
        raise UserError(f"{path}: damaged geometry ({error}); run `dnrpipe prepare` again") from None
