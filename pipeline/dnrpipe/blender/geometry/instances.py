"""Which instances get a mesh of their own, and which share one.

A mesh of its own has an atlas place of its own, and so a light map of its own: toy bricks that share their map with
bricks inside the wall are too dark by half (base images of 25.7 dB, 31.3 with their own). That pays for a few thousand
instances of few triangles; tens of thousands would leave each surface hardly a texel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .local_mesh import LocalMesh

EXTRA_TRIANGLES = 300_000  # what instances may add to the triangles of the meshes that they repeat
EXTRA_MESHES = 4_000
SINGULAR = 1e-9  # |det| of a matrix with columns scaled to length 1: flat ones cannot be undone


@dataclass
class Placed:
    """One visible instance of a local mesh; object name and persistent id make the order stable."""

    name: str
    persistent: tuple[int, ...]
    matrix: np.ndarray
    mesh: LocalMesh
    digest: bytes
    camera_visible: bool = True


@dataclass
class Shared:
    """An instance, and the matrices of those that share its mesh (float64 [4, 4] each)."""

    lead: Placed
    others: list[Placed] = field(default_factory=list)


def share_instances(
    placed: Sequence[Placed], *, extra_triangles: int = EXTRA_TRIANGLES, extra_meshes: int = EXTRA_MESHES
) -> list[Shared]:
    """Group instances so that those with a mesh of their own add no more than the given triangles and meshes.

    Groups are opened up in order of what that costs, cheapest first; the rest are shared. Order: name, persistent id.
    """
    ordered = sorted(placed, key=lambda item: (item.name, item.persistent))
    groups: dict[tuple[bytes, bool], list[Placed]] = {}
    single: list[Shared] = []
    for item in ordered:
        if invertible(item.matrix):
            groups.setdefault((item.digest, item.camera_visible), []).append(item)
        else:
            single.append(Shared(item))

    def cost(group: list[Placed]) -> int:
        return (len(group) - 1) * len(group[0].mesh.material_index)

    for group in sorted(groups.values(), key=cost):
        triangles, meshes = cost(group), len(group) - 1
        if triangles <= extra_triangles and meshes <= extra_meshes:
            extra_triangles -= triangles
            extra_meshes -= meshes
            single += [Shared(item) for item in group]
        else:
            # Float32 positions are kept in the lead's world: the largest instance leaves the finest steps.
            sizes = [abs(float(np.linalg.det(item.matrix[:3, :3]))) for item in group]
            lead = group[int(np.argmax(sizes))]
            single.append(Shared(lead, [item for item in group if item is not lead]))
    return sorted(single, key=lambda shared: (shared.lead.name, shared.lead.persistent))


def copy_matrices(shared: Shared) -> np.ndarray:
    """float64 [K, 4, 4]: maps from the lead's world space to each other instance's."""
    if not shared.others:
        return np.zeros((0, 4, 4), np.float64)
    return np.stack([item.matrix for item in shared.others]) @ np.linalg.inv(shared.lead.matrix)


def invertible(matrix: np.ndarray, least: float = SINGULAR) -> bool:
    """Whether a matrix [4, 4] is finite, and |det| with columns scaled to length 1 above ``least``."""
    linear = matrix[:3, :3]
    length = np.linalg.norm(linear, axis=0)
    if not np.isfinite(matrix).all() or not (length > 0).all():
        return False
    return abs(float(np.linalg.det(linear / length))) > least
