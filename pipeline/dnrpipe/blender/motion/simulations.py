"""Simulations: frames that follow from the frames before."""

from __future__ import annotations

from typing import Any

import bpy

from ..shading.sockets import walk

PLAYED = {"CLOTH", "SOFT_BODY", "FLUID", "DYNAMIC_PAINT"}
"""Modifiers that compute a frame from the one before."""
SIMULATING = {"GeometryNodeSimulationInput", "GeometryNodeSimulationOutput"}


def is_simulated(scene: Any) -> bool:
    """Whether Blender has to go through the frames in order."""
    # Collections of no scene may be instanced.
    return any(plays(obj) for obj in bpy.data.objects if not obj.users_scene or scene in obj.users_scene)


def plays(obj: Any) -> bool:
    """Whether an object is simulated."""
    if obj.rigid_body is not None and obj.rigid_body.type == "ACTIVE":
        return True
    return any(_is_played(modifier) for modifier in obj.modifiers)


def _is_played(modifier: Any) -> bool:
    if modifier.type == "PARTICLE_SYSTEM":
        system = modifier.particle_system
        return system is not None and (system.settings.type == "EMITTER" or system.use_hair_dynamics)
    if modifier.type == "NODES":
        return any(node.bl_idname in SIMULATING for node in walk(modifier.node_group))
    return modifier.type in PLAYED


def play(scene: Any, last: int, after: int | None = None) -> None:
    """Go through the frames up to ``last`` in order, so that simulations that are not baked know them.

    after: the last frame that was played to before; None begins with the simulations.

    Blender keeps in memory what it computed; a frame that is jumped to is computed as if it followed the last one. The
    scene is back at its frame afterwards.
    """
    now, subframe = scene.frame_current, scene.frame_subframe
    for frame in range(_first_frame(scene) if after is None else after + 1, last + 1):
        scene.frame_set(frame)
    scene.frame_set(now, subframe=subframe)


def _first_frame(scene: Any) -> int:
    """Where the scene or the earliest of its simulations begins."""
    begins = [scene.frame_start]
    if scene.rigidbody_world is not None:
        begins.append(scene.rigidbody_world.point_cache.frame_start)
    for obj in bpy.data.objects:
        begins += [modifier.point_cache.frame_start for modifier in obj.modifiers if hasattr(modifier, "point_cache")]
        begins += [system.point_cache.frame_start for system in obj.particle_systems]
    return min(begins)
