"""Candidate cameras that do not stand on a sphere: a walk with long stops, and cameras inside the scene.

Notation
    center, radius   bounding sphere of the scene, scene units
    winding          signed solid angle of the surface seen from a point, over 4π: 1 inside a closed solid, 0 outside
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dnrtrain.contract import View

from ...blender.geometry.frozen import FrozenMesh
from ...core.cameras import framing, look_at_view
from ...core.errors import UserError
from ...core.scene_records import SceneSummary
from ...core.settings import CameraSettings

STOPS = 5
STOPPED, EMPTY = 0.6, 0.1
"""Shares of a walk's candidates: near-duplicates at its stops, and views that see nothing."""
TWIN = 0.2
"""Share of a stop's views that equal the view before them: the camera stands still."""
SWEEP = math.radians(300)
LENS, SENSOR = 24.0, 36.0
"""Of the cameras inside, mm: a wide one, as in rooms."""
CLEARANCE, REACH = 0.08, 0.35
"""In radii: least distance of a camera inside to any surface, and to the point that it looks at."""
SOLID, SHELL = 0.6, 0.95
"""Winding number from which on a point counts as inside of a solid; extent, over the scene's, that makes a shell."""
SURFACE_POINTS, TRIES, CHUNK = 4000, 40, 200_000


def walk(summary: SceneSummary, settings: CameraSettings) -> dict[str, list[View]]:
    """A walk around the scene, filmed: most frames are near-duplicates at a few stops, some look away.

    Candidates are in the order of the film. Test views are spread evenly along the same walk, none of them empty:
    every part of it counts alike, however long the camera stood there.
    """
    rng = np.random.default_rng([settings.seed, 0x5041])
    center = np.asarray(summary.bounds.center, np.float64)
    focal, distance = framing(summary, settings)
    count = settings.train
    empty = round(EMPTY * count)
    stopped = round(STOPPED * count)
    moving = count - empty - stopped
    stops = (np.arange(STOPS) + rng.uniform(0.2, 0.8, STOPS)) / STOPS
    # Stops differ in length, so that drawing candidates evenly does not draw places evenly.
    at = rng.choice(STOPS, stopped, p=np.arange(1, STOPS + 1) / (STOPS * (STOPS + 1) / 2))
    places = [(float(t), "moving") for t in (np.arange(moving) + rng.uniform(0, 1, moving)) / max(moving, 1)]
    places += [(float(stops[k]) + 1e-6 * i, f"stop {k}") for i, k in enumerate(at)]
    places += [(float(t), "empty") for t in rng.uniform(0, 1, empty)]
    turn = rng.uniform(0, 2 * math.pi)

    def view(name: str, t: float, jitter: float, away: bool = False) -> View:
        azimuth = turn + SWEEP * t + rng.normal(0, jitter)
        elevation = math.radians(28 + 16 * math.sin(2 * math.pi * 1.5 * t)) + rng.normal(0, jitter)
        far = distance * (0.85 + 0.15 * math.cos(2 * math.pi * 2 * t)) * (1 + rng.normal(0, jitter))
        ring = math.cos(elevation)
        position = center + far * np.array([ring * math.cos(azimuth), ring * math.sin(azimuth), math.sin(elevation)])
        target = 2 * position - center if away else center
        return look_at_view(name, position, target, focal, settings)

    train: list[View] = []
    before = ""
    for index, (t, kind) in enumerate(sorted(places)):
        name = f"{index:04d}"
        if kind.startswith("stop") and before == kind and rng.uniform() < TWIN:
            train.append(train[-1].model_copy(update={"name": name}))
        else:
            train.append(view(name, t, math.radians(0.6 if kind.startswith("stop") else 3), away=kind == "empty"))
        before = kind
    test = [view(f"test{i:04d}", (i + 0.5) / settings.test, math.radians(3)) for i in range(settings.test)]
    return {"train": train, "test": test}


def inside(
    summary: SceneSummary, settings: CameraSettings, meshes: Sequence[FrozenMesh], name: str
) -> dict[str, list[View]]:
    """Cameras within the bounds of the scene, in free air, each looking at some point of a surface.

    Raises UserError: no room for a camera.
    """
    rng = np.random.default_rng([settings.seed, 0x494E])
    bounds = summary.bounds
    low, high = np.asarray(bounds.min, np.float64), np.asarray(bounds.max, np.float64)
    surface = surface_points(meshes, SURFACE_POINTS, rng)
    # A mesh as large as the scene is a room's shell or its all: to be inside of that is the point.
    solids = [m for m in meshes if (np.ptp(m.positions.astype(np.float64), axis=0) < SHELL * (high - low)).any()]
    triangles = np.concatenate([np.zeros((0, 3, 3)), *(mesh.positions.reshape(-1, 3, 3) for mesh in solids)])
    wanted = settings.train + settings.test
    focal = LENS / SENSOR * max(settings.width, settings.height)
    found: list[np.ndarray] = []
    for _ in range(TRIES):
        # Between a quarter and nine tenths of the height: at eye level and above what lies around.
        spots = low + (high - low) * rng.uniform([0.08, 0.08, 0.25], [0.92, 0.92, 0.9], (wanted, 3))
        near = np.min(np.linalg.norm(spots[:, None] - surface[None], axis=-1), axis=1)
        spots = spots[near > CLEARANCE * bounds.radius]
        found += list(spots[winding(spots, triangles) < SOLID])
        if len(found) >= wanted:
            break
    else:
        raise UserError(
            f"pool indoor: {name} has room for {len(found)} of {wanted} cameras among its surfaces; leave the pool out"
        )
    views = []
    for index, position in enumerate(found[:wanted]):
        ahead = surface - position
        far = np.linalg.norm(ahead, axis=1)
        level = np.abs(ahead[:, 2]) < 0.7 * far  # people seldom look straight up or down
        seen = np.flatnonzero((far > REACH * bounds.radius) & level)
        if not len(seen):
            seen = np.flatnonzero(np.linalg.norm(ahead[:, :2], axis=1) > 1e-3 * far)
        target = surface[rng.choice(seen)]
        label = f"{index:04d}" if index < settings.train else f"test{index - settings.train:04d}"
        views.append(look_at_view(label, position, target, focal, settings))
    return {"train": views[: settings.train], "test": views[settings.train :]}


def surface_points(meshes: Sequence[FrozenMesh], count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` points drawn evenly by area over all surfaces and their copies, world space, float64 [count, 3]."""
    corners = []
    for mesh in meshes:
        own = mesh.positions.reshape(-1, 3, 3).astype(np.float64)
        corners.append(own)
        if len(mesh.copies):  # as many copies as keep the list short
            chosen = rng.choice(len(mesh.copies), min(len(mesh.copies), max(1, CHUNK // max(len(own), 1))), False)
            for matrix in mesh.copies[chosen]:
                corners.append(own @ matrix[:3, :3].T + matrix[:3, 3])
    triangles = np.concatenate(corners)
    edges = triangles[:, 1:] - triangles[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    picked = triangles[rng.choice(len(triangles), count, p=area / area.sum())]
    a, b = np.sqrt(rng.uniform(0, 1, (count, 1))), rng.uniform(0, 1, (count, 1))
    return (1 - a) * picked[:, 0] + a * (1 - b) * picked[:, 1] + a * b * picked[:, 2]


def winding(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Generalised winding number of each point (Jacobson et al. 2013, eq. 5), float64 [N].

    Solid angles by Van Oosterom and Strackee (1983). points: [N, 3]; triangles: [T, 3, 3], counter-clockwise from
    outside.
    """
    total = np.zeros(len(points))
    for index, point in enumerate(points):
        for start in range(0, len(triangles), CHUNK):
            a, b, c = np.moveaxis(triangles[start : start + CHUNK] - point, 1, 0)
            la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
            up = np.einsum("ij,ij->i", a, np.cross(b, c))
            down = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
            total[index] += 2 * np.arctan2(up, down).sum()
    return total / (4 * math.pi)
