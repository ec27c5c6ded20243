"""A camera for scenes that have none: it sees everything from the front right."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import bpy
import mathutils
import numpy as np

from ..geometry.instances import invertible

CAMERA = "dnrpipe.framing"
LENS, SENSOR = 50.0, 36.0  # mm: Blender's default camera
AZIMUTH, ELEVATION = math.radians(-60), math.radians(25)
MARGIN = 1.08  # of the distance at which the scene touches the frame


def ensure_camera(scene: bpy.types.Scene, center: np.ndarray, points: Iterable[np.ndarray]) -> list[str]:
    """Give ``scene`` an active camera where it has no usable one; say so in one line.

    center [3], points (arrays [N, 3]): what to look at and what to frame, world space. A camera of the file is
    preferred to a new one. An active object that is no camera (Blender allows
    lamps and empties), or whose matrix is singular or not finite, does not count.
    """
    if usable(scene.camera):
        return []
    why = "has no camera" if scene.camera is None else f"has a camera '{scene.camera.name}' that cannot see"
    others = sorted((obj for obj in scene.objects if usable(obj)), key=lambda obj: obj.name_full)
    if others:
        scene.camera = others[0]
        active = "no active camera" if why == "has no camera" else why.removeprefix("has ")
        return [f"scene '{scene.name}' has {active}: its camera '{others[0].name}' is used"]
    data = bpy.data.cameras.new(CAMERA)
    data.lens, data.sensor_width, data.sensor_fit = LENS, SENSOR, "AUTO"
    distance, depth = _framing_distance(scene, center, points)
    data.clip_start, data.clip_end = max(0.1 * (distance - depth), 1e-6), 2 * (distance + depth)
    camera = bpy.data.objects.new(CAMERA, data)
    scene.collection.objects.link(camera)
    camera.matrix_world = mathutils.Matrix(framing_pose(center, distance).tolist())
    scene.camera = camera
    bpy.context.view_layer.update()
    return [f"scene '{scene.name}' {why}: a {LENS:g} mm camera that frames everything is added"]


def framing_pose(center: np.ndarray, distance: float) -> np.ndarray:
    """Camera-to-world (looks along -Z, Y up), float64 [4, 4], ``distance`` from ``center``, 25 degrees above."""
    flat = math.cos(ELEVATION)
    back = np.array([flat * math.cos(AZIMUTH), flat * math.sin(AZIMUTH), math.sin(ELEVATION)])
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = np.asarray(center, np.float64) + distance * back
    return pose


def usable(obj: Any) -> bool:
    """Whether an object is a camera with a finite lens and a finite, invertible matrix."""
    if obj is None or obj.type != "CAMERA" or obj.data is None:
        return False
    numbers = [getattr(obj.data, name) for name in ("lens", "sensor_width", "sensor_height", "shift_x", "shift_y")]
    return bool(np.isfinite(numbers).all()) and invertible(np.array(obj.matrix_world, np.float64), least=1e-6)


def _framing_distance(scene: bpy.types.Scene, center: np.ndarray, points: Iterable[np.ndarray]) -> tuple[float, float]:
    """(distance from ``center`` at which all points are in the picture, farthest point's depth in front of it).

    With the point at (x, y, z) in camera axes about the centre, |x| <= (distance - z) tan(half angle), same for y.
    """
    width = scene.render.resolution_x * scene.render.pixel_aspect_x
    height = scene.render.resolution_y * scene.render.pixel_aspect_y
    tangent = 0.5 * SENSOR / LENS * np.array([width, height]) / max(width, height)
    axes = framing_pose(np.zeros(3), 1.0)[:3, :3]
    distance = depth = 0.0
    for cloud in points:
        local = (np.asarray(cloud, np.float64) - center) @ axes
        needed = local[:, 2] + (np.abs(local[:, :2]) / tangent).max(1)
        distance = max(distance, float(needed.max()))
        depth = max(depth, float(np.abs(local[:, 2]).max()))
    return max(MARGIN * distance, 1e-6), depth
