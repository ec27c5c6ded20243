"""Small shots: still scenes with one thing in them that changes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy
from tests.nasty_scenes import cube, empty, link, save


def still() -> tuple[Any, Any]:
    """A floor, a block, a lamp and two cameras, of which "wide" is active: (scene, that camera)."""
    empty()
    scene: Any = bpy.context.scene
    cube("floor").scale = (4, 4, 0.1)
    cube("block").location = (-2, 1, 1)
    lamp = link("lamp", bpy.data.lights.new("lamp", "POINT"))
    lamp.location, lamp.data.energy = (2, -2, 5), 300
    for name, place in (("wide", (0, -9, 1.5)), ("close", (3, -5, 1.0))):
        camera = link(name, bpy.data.cameras.new(name))
        camera.location, camera.rotation_euler = place, (math.radians(85), 0, 0)
        scene.camera = scene.camera or camera
    scene.frame_start, scene.frame_end = 1, 5
    scene.render.resolution_x, scene.render.resolution_y = 320, 180
    return scene, scene.camera


def cameras(folder: Path) -> Path:
    """Lens, sensor and shift keyed, a driver on the scene's frame, oblong pixels, half size, markers."""
    scene, wide = still()
    render = scene.render
    render.pixel_aspect_x, render.pixel_aspect_y, render.resolution_percentage = 1.0, 1.5, 50
    render.fps, render.fps_base = 30, 1.001
    for frame, lens, sensor, shift in ((1, 30, 36, 0.0), (5, 50, 28, 0.2)):
        for name, value in (("lens", lens), ("sensor_width", sensor), ("shift_x", shift), ("shift_y", -shift)):
            setattr(wide.data, name, value)
            wide.data.keyframe_insert(name, frame=frame)
    driver = wide.driver_add("location", 0).driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id_type, variable.targets[0].id = "now", "SCENE", scene
    variable.targets[0].data_path, driver.expression = "frame_current", "now * 0.1"
    scene.timeline_markers.new("a", frame=2).camera = wide
    scene.timeline_markers.new("b", frame=4).camera = bpy.data.objects["close"]
    flat = link("flat", bpy.data.cameras.new("flat"))
    flat.data.type = "ORTHO"
    return save(folder / "cameras.blend")
