"""Local meshes -> world space: transformed triangles with unit normals, repaired where they have to be."""

from __future__ import annotations

import numpy as np

from .frozen import FrozenMesh
from .local_mesh import LocalMesh

# A triangle whose doubled area is below this fraction of its longest edge squared has no usable normal.
DEGENERATE = 1e-12
REPAIRS = ("degenerate_triangles", "non_finite_triangles", "normals_replaced", "uv_replaced", "colors_replaced")
BLOCK = 1 << 17  # triangles transformed at a time


def to_world(name: str, matrix: np.ndarray, local: LocalMesh, repairs: dict[str, int]) -> FrozenMesh:
    """``local`` placed in the world; ``repairs`` (see ``REPAIRS``) is added to. Object id and atlas are not set yet."""
    linear = matrix[:3, :3]
    # det(M) inv(M)^T = cofactor matrix: the inverse transpose without a division, so flat scales survive.
    columns = linear.T
    cofactor = np.stack([*np.cross(np.roll(columns, -1, axis=0), np.roll(columns, -2, axis=0))], axis=1)
    mirrored = bool(np.linalg.det(linear) < 0)
    count = len(local.material_index)
    positions = np.empty((count, 3, 3), np.float32)
    normals = np.empty((count, 3, 3), np.float32)
    keep = np.empty(count, bool)
    # In blocks: double precision for a million polygons at once would take more than a gigabyte.
    for start in range(0, count, BLOCK):
        block = slice(start, min(start + BLOCK, count))
        corners = local.positions[3 * block.start : 3 * block.stop].astype(np.float64) @ linear.T + matrix[:3, 3]
        turned = local.normals[3 * block.start : 3 * block.stop].astype(np.float64) @ cofactor.T
        corners, turned = corners.reshape(-1, 3, 3), turned.reshape(-1, 3, 3)
        if mirrored:
            corners, turned = corners[:, [0, 2, 1]], -turned[:, [0, 2, 1]]
        with np.errstate(invalid="ignore", over="ignore"):
            positions[block] = corners
            corners = positions[block].astype(np.float64)  # as stored: far from the origin triangles collapse
            edges = corners - np.roll(corners, 1, axis=1)
            cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            area = np.linalg.norm(cross, axis=1)
            longest = (edges**2).sum(-1).max(-1)
            finite = np.isfinite(positions[block]).all((1, 2))
            solid = area > DEGENERATE * longest
            face = cross / np.where(area > 0, area, 1)[:, None]
        keep[block] = finite & solid
        repairs["non_finite_triangles"] += int((~finite).sum())
        repairs["degenerate_triangles"] += int((finite & ~solid).sum())
        normals[block], bad = _unit_normals(turned, face)
        repairs["normals_replaced"] += int(bad[keep[block]].sum())

    def corner(values: np.ndarray, kind: str) -> np.ndarray:
        """Corner values [3T, C] of the kept triangles, in their winding; non-finite ones become 0."""
        ordered = values.reshape(count, 3, -1)[keep]
        ordered = (ordered[:, [0, 2, 1]] if mirrored else ordered).reshape(-1, values.shape[1])
        bad = ~np.isfinite(ordered)
        if bad.any():
            repairs[kind] += int(bad.any(1).sum())
            ordered[bad] = 0
        return ordered

    colors = {layer: corner(values, "colors_replaced") for layer, values in local.colors.items()}
    return FrozenMesh(
        name=name,
        object_name=name,
        object_id=0,
        positions=positions[keep].reshape(-1, 3),
        normals=normals[keep].reshape(-1, 3),
        material_index=np.ascontiguousarray(local.material_index[keep], np.int32),
        materials=list(local.materials),
        uv_layers={layer: corner(values, "uv_replaced") for layer, values in local.uv_layers.items()},
        active_uv=local.active_uv,
        atlas=np.zeros((3 * int(keep.sum()), 2), np.float32),
        colors=colors,
        active_color=local.active_color if local.active_color in colors else None,
        object_to_world=matrix,
        texture_space=local.texture_space,
        strands=local.strands,
    )


def _unit_normals(normals: np.ndarray, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit corner normals [T, 3, 3]; zero or non-finite ones, marked in bool [T, 3], become the face normal [T, 3]."""
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(normals, axis=2)
        bad = ~np.isfinite(length) | (length == 0)
        unit = normals / np.where(bad, 1, length)[..., None]
    return np.where(bad[..., None], face[:, None], unit), bad
