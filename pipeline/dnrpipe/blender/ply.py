"""Binary PLY as Mitsuba's ``ply`` shape reads it. No bpy here."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dnrtrain.atomic import atomic_path


def write_ply(path: Path, positions: np.ndarray, normals: np.ndarray, uv: np.ndarray | None) -> None:
    """Write unindexed triangles (little-endian PLY 1.0; properties x y z nx ny nz [s t]).

    Args:
        positions: float32 [3T, 3].
        normals: float32 [3T, 3], unit.
        uv: float32 [3T, 2] or None; Mitsuba takes s, t as they are (v = 0 is an image's first row).
    """
    count = len(positions)
    columns = [positions, normals] if uv is None else [positions, normals, uv]
    names = ["x", "y", "z", "nx", "ny", "nz"] + ([] if uv is None else ["s", "t"])
    vertices = np.ascontiguousarray(np.concatenate(columns, axis=1), dtype="<f4")
    faces = np.empty(count // 3, dtype=np.dtype([("n", "u1"), ("v", "<i4", 3)]))
    faces["n"] = 3
    faces["v"] = np.arange(count, dtype=np.int32).reshape(-1, 3)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        f"element face {count // 3}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
