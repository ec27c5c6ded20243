"""Binary PLY as Mitsuba's ``ply`` shape reads it. No bpy here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dnrtrain.atomic import atomic_path

BLOCK = 1 << 20  # vertices of copies written at a time


@dataclass
class Welded:
    """Indexed triangles: equal corners are one vertex, so that big meshes cost a third of the memory.

    vertices: float32 [V, C], columns as in ``names`` (x y z nx ny nz first). faces: int32 [T, 3].
    copies: float64 [K, 4, 4], further placements that are written out as geometry.
    """

    names: tuple[str, ...]
    vertices: np.ndarray
    faces: np.ndarray
    copies: np.ndarray

    @property
    def triangles(self) -> int:
        """Copies included."""
        return len(self.faces) * (1 + len(self.copies))


def weld(
    positions: np.ndarray,
    normals: np.ndarray,
    uv: np.ndarray | None,
    attributes: Sequence[tuple[str, np.ndarray]] = (),
    copies: np.ndarray | None = None,
) -> Welded:
    """Unindexed triangles as indexed ones, vertices in order of first use.

    Args:
        positions, normals: float32 [3T, 3], unit normals.
        uv: float32 [3T, 2] or None; Mitsuba takes s, t as they are (v = 0 is an image's first row).
        attributes: (name, float32 [3T, 3]); ``uv1`` becomes mesh attribute ``vertex_uv1``, ``color0``
            ``vertex_color0_color`` (Mitsuba groups columns by the letters after the last underscore, and appends
            "color" to r, g, b); a column [3T, 1] becomes a scalar attribute.
    """
    names = ["x", "y", "z", "nx", "ny", "nz"]
    columns = [positions, normals]
    if uv is not None:
        names += ["s", "t"]
        columns.append(uv)
    for name, values in attributes:
        letters = "rgb" if name.startswith("color") else "xyz"
        names += [f"{name}_{letter}" for letter in letters[: values.shape[1]]]
        columns.append(values)
    # + 0 turns -0 into 0: equal numbers, equal bits.
    corners = np.ascontiguousarray(np.concatenate(columns, axis=1), dtype=np.float32) + np.float32(0)
    first, inverse = _first_of_equal(corners)
    return Welded(
        tuple(names),
        corners[first],
        inverse.reshape(-1, 3).astype(np.int32),
        np.zeros((0, 4, 4)) if copies is None else copies,
    )


def _first_of_equal(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(index of the first of each set of equal rows, in order; each row's place in that list)."""
    state = np.full(len(rows), 0xCBF29CE484222325, np.uint64)
    for column in rows.view(np.uint32).T:
        state = (state ^ column) * np.uint64(0x9E3779B97F4A7C15)
        state ^= state >> np.uint64(29)
    _, first, inverse = np.unique(state, return_index=True, return_inverse=True)
    if not (rows == rows[first[inverse]]).all():  # two rows share a hash: keep all apart
        return np.arange(len(rows)), np.arange(len(rows))
    order = np.argsort(first)
    rank = np.empty(len(first), np.int64)
    rank[order] = np.arange(len(first))
    return first[order], rank[inverse]


def write_ply(path: Path, parts: Sequence[Welded]) -> None:
    """Write the parts, and their copies, as one mesh (little-endian PLY 1.0). All parts have the same columns."""
    names = parts[0].names
    vertices = sum(len(part.vertices) * (1 + len(part.copies)) for part in parts)
    faces = sum(part.triangles for part in parts)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {vertices}",
        *(f"property float {name}" for name in names),
        f"element face {faces}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        for part in parts:
            file.write(part.vertices.astype("<f4", copy=False).tobytes())
            step = max(1, BLOCK // max(1, len(part.vertices)))
            for start in range(0, len(part.copies), step):
                file.write(_placed(part.vertices, part.copies[start : start + step]).tobytes())
        first = 0
        for part in parts:
            count = len(part.vertices)
            step = max(1, BLOCK // max(1, len(part.faces)))
            for start in range(0, 1 + len(part.copies), step):
                offsets = first + count * np.arange(start, min(start + step, 1 + len(part.copies)))
                block = np.empty(len(offsets) * len(part.faces), np.dtype([("n", "u1"), ("v", "<i4", 3)]))
                block["n"] = 3
                block["v"] = (part.faces[None] + offsets[:, None, None].astype(np.int32)).reshape(-1, 3)
                file.write(block.tobytes())
            first += count * (1 + len(part.copies))


def _placed(vertices: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Vertices [V, C] under each matrix [K, 4, 4]: float32 [K, V, C]; normals by the inverse transpose."""
    result = np.repeat(vertices[None].astype("<f4"), len(matrices), axis=0)
    linear = matrices[:, :3, :3]
    result[..., :3] = vertices[:, :3].astype(np.float64) @ linear.transpose(0, 2, 1) + matrices[:, None, :3, 3]
    # Rows n^T M^-1 = (M^-T n)^T; of a flat matrix the pseudo-inverse.
    normals = vertices[:, 3:6].astype(np.float64) @ np.linalg.pinv(linear)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    result[..., 3:6] = normals / np.where(length > 0, length, 1)
    return result
