"""Whole records of a scene, of which a test names what it is about."""

from __future__ import annotations

from typing import Any

import numpy as np

from dnrpipe.core.scene_records import Census, SceneSummary

CAMERA: dict[str, Any] = {
    "name": "Camera",
    "type": "PERSP",
    "c2w": np.eye(4).tolist(),
    "lens": 35.0,
    "sensor_width": 36.0,
    "sensor_height": 24.0,
    "sensor_fit": "AUTO",
    "shift_x": 0.0,
    "shift_y": 0.0,
    "clip_start": 0.1,
    "clip_end": 100.0,
    "ortho_scale": 6.0,
    "dof": None,
}
ATLAS: dict[str, Any] = {
    "method": "smart",
    "seconds": 0.5,
    "size": 512,
    "occupancy": 0.641,
    "overlap": 0.0,
    "triangles_without_texel": 0.01,
    "texels_per_unit": {"median": 100.0, "min": 50.0, "max": 200.0},
}
SUMMARY: dict[str, Any] = {
    "bounds": {"min": [-1, -1, -1], "max": [1, 1, 1], "center": [0, 0, 0], "radius": 1.8},
    "triangles": 12,
    "objects": 1,
    "instances": 1,
    "object_names": {"1": "Cube"},
    "cameras": [],
    "animation": [],
    "resolution": [64, 64],
    "blender_version": "5.0.1",
    "atlas": ATLAS,
    "repairs": {},
    "has_light": True,
    "bake_size": None,
    "external": {},
    "warnings": [],
}
MATT: dict[str, Any] = {
    "bsdfs": ["Diffuse BSDF"],
    "nodes": {},
    "procedural": [],
    "reflects": True,
    "glossy": False,
    "transparent": False,
    "transmissive": False,
    "refractive": False,
    "ior": None,
    "emissive": False,
    "subsurface": False,
    "metallic": False,
    "normal_map": False,
    "bump": False,
    "volume": False,
    "displacement": False,
    "thin_film": False,
    "hair": False,
    "view_dependent": [],
    "min_roughness": None,
    "roughness_linked": False,
    "objects": ["Floor"],
}
"""A material."""
NAMES = (
    *("default_material", "lights", "images", "node_groups", "procedural_textures", "transparency", "transmission"),
    *("emission", "subsurface", "metals", "normal_maps", "view_dependent_nodes", "volumes", "hair", "depth_of_field"),
    *("motion", "findings"),
)


def scene_summary(**changes: Any) -> SceneSummary:
    """The summary of a cube, with these changes."""
    return SceneSummary.model_validate(SUMMARY | changes)


def sphere_summary(center: tuple[float, float, float], radius: float, **changes: Any) -> SceneSummary:
    """The summary of a scene in this sphere."""
    low, high = ([c + sign * radius for c in center] for sign in (-1, 1))
    return scene_summary(bounds={"min": low, "max": high, "center": center, "radius": radius}, **changes)


def scene_census(**changes: Any) -> Census:
    """The census of a matt cube, with these changes."""
    counts = {"meshes": 1, "instances": 1, "triangles": 12, "triangles_by_object": {}}
    names: dict[str, Any] = {name: [] for name in NAMES}
    file = {"scene": "Scene", "blender": "5.0.1", "file_version": "5.0.1", "objects": {}}
    display = {"view_transform": "Standard", "render_engine": "CYCLES"}
    base = {**file, **counts, **names, **display, "materials": {"Chalk": MATT}, "world": None}
    return Census.model_validate(base | changes)
