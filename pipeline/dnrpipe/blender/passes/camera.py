"""A contract View as a Blender camera, and back."""

from __future__ import annotations

import math

import bpy
import mathutils
import numpy as np

from dnrpipe.core.scene_records import Lens, SceneCamera
from dnrtrain.contract import View

SENSOR = 36.0  # mm; only its ratio to the focal length counts
LENS = (
    *("type", "lens", "sensor_width", "sensor_height", "sensor_fit"),
    *("shift_x", "shift_y", "clip_start", "clip_end", "ortho_scale"),
)
"""Blender's settings of a camera that `SceneCamera` has by the same names."""


def apply_view(
    view: View, camera: bpy.types.Object, render: bpy.types.RenderSettings, clip: tuple[float, float]
) -> None:
    """Set pose, intrinsics and resolution so that Blender sees what ``view`` sees.

    With horizontal sensor fit Blender shifts both axes in units of the image width, and scales y by
    the pixel aspect a = fl_x / fl_y: shift_x = (w/2 - cx) / w, shift_y = (cy - h/2) a / w.
    """
    data = camera.data
    data.type = "PERSP"
    data.sensor_fit = "HORIZONTAL"
    lens = SENSOR * view.fl_x / view.width
    # Blender's shortest lens is 1 mm: scale the sensor for wider angles.
    data.lens = max(lens, 1.0)
    data.sensor_width = SENSOR if lens >= 1.0 else view.width / view.fl_x
    aspect = view.fl_x / view.fl_y
    data.shift_x = (view.width / 2 - view.cx) / view.width
    data.shift_y = (view.cy - view.height / 2) * aspect / view.width
    data.clip_start, data.clip_end = clip
    data.dof.use_dof = False
    camera.matrix_world = mathutils.Matrix(view.matrix.tolist())
    render.resolution_x, render.resolution_y = view.width, view.height
    render.resolution_percentage = 100
    render.pixel_aspect_x = max(1.0, 1.0 / aspect)
    render.pixel_aspect_y = max(1.0, aspect)


def clip_range(view: View, center: np.ndarray, radius: float) -> tuple[float, float]:
    """Near and far plane, scene units, that hold the whole bounding sphere: nothing in front is clipped."""
    distance = float(np.linalg.norm(view.position - center))
    return max(0.5 * (distance - radius), 1e-4 * radius), 1.01 * (distance + radius)


def rigid(matrix: mathutils.Matrix) -> list[list[float]]:
    """Camera-to-world of a camera object as 4x4 rows without its scale (shear and mirroring removed)."""
    m = np.array(matrix, np.float64)
    z = m[:3, 2] / np.linalg.norm(m[:3, 2])
    y = m[:3, 1] - z * (z @ m[:3, 1])
    y /= np.linalg.norm(y)
    result = np.eye(4)
    result[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    result[:3, 3] = m[:3, 3]
    return result.tolist()


def describe(camera: bpy.types.Object, render: bpy.types.RenderSettings) -> SceneCamera:
    """Pose and lens of a camera object, with the pixels of the scene's render settings."""
    return SceneCamera(
        name=camera.name,
        c2w=tuple(map(tuple, rigid(camera.matrix_world))),
        **{name: getattr(camera.data, name) for name in LENS},
        dof=_depth_of_field(camera),
        pixel_aspect=render.pixel_aspect_y / render.pixel_aspect_x,
    )


def _depth_of_field(camera: bpy.types.Object) -> Lens | None:
    """Thin lens of a camera with depth of field, scene units: aperture_radius = lens / (2000 fstop), as in Cycles.

    The focus object, where there is one, gives the distance along the view axis.
    """
    dof = camera.data.dof
    if not dof.use_dof or dof.aperture_fstop <= 0:
        return None
    distance = dof.focus_distance
    if dof.focus_object is not None:
        matrix = np.array(rigid(camera.matrix_world))
        distance = abs(float((matrix[:3, 3] - np.array(dof.focus_object.matrix_world.translation)) @ matrix[:3, 2]))
    if not 0 < distance < math.inf:  # the object may be lost (NaN)
        return None
    return {"aperture_radius": camera.data.lens / (2000 * dof.aperture_fstop), "focus_distance": distance}
