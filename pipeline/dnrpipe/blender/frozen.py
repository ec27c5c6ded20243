"""The frozen scene: evaluated, world-space triangles, and its file ``scene/geometry.npz``. No bpy here."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.errors import UserError
from dnrtrain.atomic import atomic_path

GEOMETRY_VERSION = 1


def _empty_atlas() -> np.ndarray:
    return np.zeros((0, 2), np.float32)


@dataclass
class FrozenMesh:
    """One instance of one object as unindexed triangles: corner ``3 t + k`` is corner k of triangle t.

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
    atlas: np.ndarray = field(default_factory=_empty_atlas)
    """float32 [3T, 2] in [0, 1), V up: this instance's own place in the scene's atlas ([0, 2] until packed)."""

    @property
    def triangles(self) -> int:
        return len(self.material_index)


def save_geometry(path: Path, meshes: Sequence[FrozenMesh]) -> None:
    """Write the meshes as an uncompressed npz, atomically."""
    arrays: dict[str, Any] = {}
    index = []
    for i, mesh in enumerate(meshes):
        index.append(
            {
                "name": mesh.name,
                "object_name": mesh.object_name,
                "object_id": mesh.object_id,
                "materials": mesh.materials,
                "active_uv": mesh.active_uv,
                "uv_layers": list(mesh.uv_layers),
            }
        )
        arrays[f"{i}.positions"] = mesh.positions
        arrays[f"{i}.normals"] = mesh.normals
        arrays[f"{i}.material_index"] = mesh.material_index
        arrays[f"{i}.atlas"] = mesh.atlas
        for j, uv in enumerate(mesh.uv_layers.values()):
            arrays[f"{i}.uv.{j}"] = uv
    header = json.dumps({"version": GEOMETRY_VERSION, "meshes": index}).encode()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, header=np.frombuffer(header, np.uint8), **arrays)


def load_geometry(path: Path) -> list[FrozenMesh]:
    """Read what :func:`save_geometry` wrote.

    Raises UserError when the file is missing, damaged or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            header = json.loads(data["header"].tobytes())
            if header["version"] != GEOMETRY_VERSION:
                raise UserError(f"{path}: geometry of version {header['version']}; run `dnrpipe prepare` again")
            return [
                FrozenMesh(
                    name=entry["name"],
                    object_name=entry["object_name"],
                    object_id=entry["object_id"],
                    positions=data[f"{i}.positions"],
                    normals=data[f"{i}.normals"],
                    material_index=data[f"{i}.material_index"],
                    materials=entry["materials"],
                    uv_layers={name: data[f"{i}.uv.{j}"] for j, name in enumerate(entry["uv_layers"])},
                    active_uv=entry["active_uv"],
                    atlas=data[f"{i}.atlas"],
                )
                for i, entry in enumerate(header["meshes"])
            ]
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; run `dnrpipe prepare` first") from None
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: damaged geometry ({error}); run `dnrpipe prepare` again") from None
