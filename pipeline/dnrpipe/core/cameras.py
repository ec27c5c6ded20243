"""Which views exist: domes and spheres around the scene, places inside, its own cameras, camera files.

Notation
    center, radius   bounding sphere of the scene, scene units
    elevation        angle above the horizontal plane through the centre, radians
    fl               focal length in pixels
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from dnrtrain.contract import SPLITS, ContractError, View, file_name, parse_transforms, unique_names

from .errors import UserError
from .scene_records import Lens, SceneCamera, SceneSummary
from .settings import CameraSettings
from .shot_records import ShotFacts

T = TypeVar("T")

KEYWORDS = ("auto", "dome", "sphere", "inside", "scene", "animation")
ENCLOSED = 0.75
"""Share of all directions in which the scene's camera meets a surface, from which on it stands inside."""
DEFAULT_LENS = 50.0  # mm on a 36 mm sensor: Blender's default camera
DEFAULT_SENSOR = 36.0
LOWEST, HIGHEST = math.radians(5.0), math.radians(85.0)
# Splits drawn from different streams, so that asking for more of one leaves the others as they were.
_STREAM = {"train": 0, "val": 1, "test": 2}


def make_cameras(summary: SceneSummary, settings: CameraSettings) -> dict[str, list[View]]:
    """Views of each split for a prepared scene.

    Raises UserError: a source that the scene does not have, or a broken camera file.
    """
    source = automatic_source(summary)[0] if settings.source == "auto" else settings.source
    if source in ("dome", "sphere"):
        return {split: sphere_views(summary, settings, split) for split in SPLITS}
    if source == "inside":
        return inside_views(summary, settings)
    if source in ("scene", "animation"):
        own = [view for view, _ in _own_views(summary, settings)]
        if source == "scene" and not own:
            raise UserError("--cameras scene: the scene has no perspective camera; use --cameras dome")
        if source == "animation" and len(own) < 2:
            raise UserError("--cameras animation: the active camera does not move; use --cameras scene or dome")
        return split_views(own, settings)
    path = Path(source)
    views = read_camera_file(path, settings)
    return own_splits(path, views) or split_views(views, settings)


def automatic_source(summary: SceneSummary) -> tuple[str, str]:
    """What ``auto`` comes to, ``dome`` or ``inside``, and why."""
    around = summary.surroundings
    if around is None or not around.standpoints:
        return "dome", "around the scene, which its own camera does not tell the inside of"
    if around.moves:
        return "inside", "beside the path of the scene's animated camera, looking at what it sees"
    if around.enclosed >= ENCLOSED:
        return "inside", f"inside, as the scene's own camera meets surfaces in {around.enclosed:.0%} of all directions"
    return "dome", f"around the scene, as its own camera meets surfaces in {around.enclosed:.0%} of all directions"


def inside_views(summary: SceneSummary, settings: CameraSettings) -> dict[str, list[View]]:
    """Views of each split from standpoints inside the scene, with the lens of the scene's own camera.

    Every split has standpoints of its own: half of all are for candidates, a quarter each for the others.

    Raises UserError: the scene has no standpoints, or too few.
    """
    around = summary.surroundings
    if around is None or not around.standpoints:
        raise UserError("--cameras inside: the scene's own camera stands in no free air; use --cameras dome")
    focal, _ = framing(summary, settings)
    shares = {"train": (0, 2), "val": (1, 4), "test": (3, 4)}
    views = {}
    for split, (first, step) in shares.items():
        own, wanted = around.standpoints[first::step], getattr(settings, split)
        if wanted > len(own):
            raise UserError(
                f"--cameras inside: the scene has {len(own)} standpoints for cameras.{split}, {wanted} are wanted;"
                f" use --set cameras.{split}={len(own)}, or --cameras dome"
            )
        order = np.random.default_rng([settings.seed, _STREAM[split]]).permutation(len(own))[:wanted]
        views[split] = [
            look_at_view(f"{index:04d}", np.array(own[k].place), np.array(own[k].target), focal, settings)
            for index, k in enumerate(order)
        ]
    return views


def own_splits(path: Path, views: Sequence[View]) -> dict[str, list[View]] | None:
    """Views by the ``"split"`` that each frame of a camera file names; None where no frame names one.

    Raises UserError: some frames name none, or one that is not train, val or test.
    """
    named = [frame.get("split") for frame in json.loads(path.read_text(encoding="utf-8"))["frames"]]
    if not any(named):
        return None
    if unknown := [view.name for view, split in zip(views, named, strict=True) if split not in SPLITS]:
        raise UserError(
            f"{path}: view {unknown[0]} has no split of {', '.join(SPLITS)}, but others have; give all of them one"
        )
    return {split: [v for v, own in zip(views, named, strict=True) if own == split] for split in SPLITS}


def view_lenses(summary: SceneSummary, settings: CameraSettings) -> dict[str, Lens]:
    """Lenses of the views whose camera in the scene has depth of field, by view name.

    Only the scene's own cameras have lenses; domes, spheres and camera files are pinholes.
    """
    return {view.name: camera.dof for view, camera in _own_views(summary, settings) if camera.dof}


def _own_views(summary: SceneSummary, settings: CameraSettings) -> list[tuple[View, SceneCamera]]:
    """Views of the scene's own cameras, or of the active one's animation; [] for other sources."""
    sources = {"scene": summary.cameras, "animation": summary.animation}
    cameras = [camera for camera in sources.get(settings.source, ()) if camera.type == "PERSP"]
    views = [_scene_view(camera, settings.width, settings.height) for camera in cameras]
    return list(zip(unique_names(views), cameras, strict=True))


def read_camera_file(path: Path, settings: CameraSettings) -> list[View]:
    """Views of a NeRF ``transforms.json`` that the whole pipeline can use.

    Raises UserError: broken, or several image sizes (the trainer needs one).
    """
    try:
        views = parse_transforms(path, (settings.width, settings.height))
    except ContractError as error:
        raise UserError(str(error)) from None
    sizes = sorted({(view.width, view.height) for view in views})
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sizes[:4])
        raise UserError(f"{path}: has several image sizes ({listed}); training needs one: resample the cameras")
    return views


def sphere_views(summary: SceneSummary, settings: CameraSettings, split: str) -> list[View]:
    """Views of a split on a sphere, or by default a hemisphere, that look at the scene's centre.

    Directions are a Fibonacci lattice with a random turn and jitter: even like the lattice, and two
    splits never share a direction. The lens is the scene camera's where it has one.
    """
    count, hemisphere = getattr(settings, split), settings.source != "sphere"
    rng = np.random.default_rng([settings.seed, _STREAM[split]])
    center = np.asarray(summary.bounds.center, dtype=np.float64)
    focal, distance = framing(summary, settings)
    low, high = (math.sin(LOWEST), math.sin(HIGHEST)) if hemisphere else (-math.sin(HIGHEST), math.sin(HIGHEST))
    turn = rng.uniform(0, 2 * math.pi)
    order = (np.arange(count) + rng.uniform(0, 1, count)) / max(count, 1)
    # Uniform in height is uniform in area on a sphere (Archimedes).
    heights = low + (high - low) * order
    azimuths = turn + math.pi * (3 - math.sqrt(5)) * np.arange(count) + rng.normal(0, 0.15, count)
    order = rng.permutation(count)
    views = []
    for index, (z, azimuth) in enumerate(zip(heights[order], azimuths[order], strict=True)):
        ring = math.sqrt(max(0.0, 1 - z * z))
        direction = np.array([ring * math.cos(azimuth), ring * math.sin(azimuth), z])
        views.append(look_at_view(f"{index:04d}", center + distance * direction, center, focal, settings))
    return views


def orbit_views(
    summary: SceneSummary, settings: CameraSettings, count: int, elevation_degrees: float = 25.0
) -> list[View]:
    """A turntable: ``count`` views at one elevation, evenly spaced over a full turn."""
    center = np.asarray(summary.bounds.center, dtype=np.float64)
    focal, distance = framing(summary, settings)
    elevation = math.radians(elevation_degrees)
    views = []
    for index in range(count):
        azimuth = 2 * math.pi * index / count
        around = math.cos(elevation) * np.array([math.cos(azimuth), math.sin(azimuth)])
        direction = np.array([*around, math.sin(elevation)])
        views.append(look_at_view(f"{index:04d}", center + distance * direction, center, focal, settings))
    return views


def split_views(views: Sequence[View], settings: CameraSettings) -> dict[str, list[View]]:
    """Deal given views out to the splits: every k-th to test and val, the rest are candidates.

    At most the settings' numbers of val and test views are taken, and never more than a fifth of all
    for either, so that a short list still trains. One view serves as its own candidate only.
    """
    count = len(views)
    test = min(settings.test, count // 5)
    val = min(settings.val, count // 5)
    chosen_test = set(spread(range(count), test))
    rest = [i for i in range(count) if i not in chosen_test]
    chosen_val = set(spread(rest, val))
    train = [i for i in rest if i not in chosen_val]
    return {
        "train": [views[i] for i in train],
        "val": [views[i] for i in sorted(chosen_val)],
        "test": [views[i] for i in sorted(chosen_test)],
    }


def spread(items: Sequence[T], count: int) -> list[T]:
    """``count`` of the items, or all where there are fewer, evenly spread, in their order."""
    count = min(count, len(items))
    return [items[(2 * i + 1) * len(items) // (2 * count)] for i in range(count)]


def scaled_to(view: View, side: int) -> View:
    """The same picture with at most ``side`` pixels on its longer side; smaller views stay as they are."""
    scale = min(1.0, side / max(view.width, view.height))
    width, height = max(8, round(view.width * scale)), max(8, round(view.height * scale))
    return view.model_copy(
        update={
            "width": width,
            "height": height,
            "fl_x": view.fl_x * scale,
            "fl_y": view.fl_y * scale,
            "cx": view.cx * width / view.width,
            "cy": view.cy * height / view.height,
        }
    )


def window(view: View, width: int, height: int, place: tuple[float, float]) -> View:
    """A part of the picture, pixel for pixel; pictures that are smaller stay as they are.

    place: where it lies, in [0, 1] from left to right and from top to bottom.
    """
    width, height = min(width, view.width), min(height, view.height)
    left, top = round((view.width - width) * place[0]), round((view.height - height) * place[1])
    return view.model_copy(update={"width": width, "height": height, "cx": view.cx - left, "cy": view.cy - top})


def depth_range(views: Sequence[View], summary: SceneSummary) -> tuple[float, float]:
    """(near, far) planar depth, scene units, that holds the bounding sphere for every view."""
    center = np.asarray(summary.bounds.center)
    radius = summary.bounds.radius
    planar = [float(-(np.linalg.inv(v.matrix) @ np.append(center, 1.0))[2]) for v in views]
    near = max(min(planar) - radius, 1e-3 * radius)
    return near, max(max(planar) + radius, near * 1.001)


def framing(summary: SceneSummary, settings: CameraSettings) -> tuple[float, float]:
    """(focal length in pixels, camera distance): the bounding sphere fits the shorter side.

    The lens is the scene camera's, or Blender's default where it has none.
    """
    active = next((c for c in summary.cameras if c.active and c.type == "PERSP"), None)
    lens, sensor = (active.lens, active.sensor_width) if active else (DEFAULT_LENS, DEFAULT_SENSOR)
    focal = lens / sensor * max(settings.width, settings.height)
    half_angle = math.atan(0.5 * min(settings.width, settings.height) / focal)
    # A sphere touches the edge of the frustum at radius / sin(half angle).
    return focal, settings.distance * summary.bounds.radius / math.sin(half_angle)


def look_at_view(name: str, position: np.ndarray, target: np.ndarray, focal: float, settings: CameraSettings) -> View:
    """The upright view from ``position`` [3] to ``target`` [3], which is not straight above or below it."""
    forward = target - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, 0], c2w[:3, 1], c2w[:3, 2], c2w[:3, 3] = right, np.cross(right, forward), -forward, position
    return View(
        name=name,
        width=settings.width,
        height=settings.height,
        fl_x=focal,
        fl_y=focal,
        cx=settings.width / 2,
        cy=settings.height / 2,
        c2w=tuple(tuple(float(x) for x in row) for row in c2w),
    )


def shot_views(shot: ShotFacts, width: int, height: int) -> list[View]:
    """A view of ``width`` x ``height`` pixels for each frame of a shot, in order, named ``frame00012``.

    The file's pixel aspect is kept: where its pixels are not square, fl_x and fl_y differ.

    Raises UserError: a camera is orthographic or panoramic.
    """
    require_perspective(shot.cameras)
    return [_scene_view(camera, width, height) for camera in shot.cameras]


def require_perspective(cameras: Sequence[SceneCamera]) -> None:
    """Raise UserError for the first camera that is orthographic or panoramic."""
    for camera in cameras:
        if camera.type != "PERSP":
            kind = {"ORTHO": "orthographic", "PANO": "panoramic"}.get(camera.type, camera.type)
            raise UserError(
                f"camera '{camera.name}' is {kind} at frame {camera.frame}; only perspective cameras can be rendered:"
                " change its lens type, or choose another with --camera"
            )


def _scene_view(camera: SceneCamera, width: int, height: int) -> View:
    """Blender camera -> View. Sensor fit and shift as in Blender's manual, "Camera / Lens".

    Blender measures in widths of pixels: the picture is ``height * pixel_aspect`` of them high
    (BKE_camera_params_compute_viewplane).
    """
    pixel_aspect = camera.pixel_aspect
    if camera.sensor_fit == "AUTO":
        side, sensor = max(width, height * pixel_aspect), camera.sensor_width
    elif camera.sensor_fit == "HORIZONTAL":
        side, sensor = width, camera.sensor_width
    else:
        side, sensor = height * pixel_aspect, camera.sensor_height
    focal = camera.lens / sensor * side
    name = f"frame{camera.frame:05d}" if camera.frame is not None else camera.name
    return View(
        name=file_name(name),
        width=width,
        height=height,
        fl_x=focal,
        fl_y=focal / pixel_aspect,
        cx=width / 2 - camera.shift_x * side,
        cy=height / 2 + camera.shift_y * side / pixel_aspect,
        c2w=camera.c2w,
    )
