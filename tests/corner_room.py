"""A floor and a wall with places in the atlas, straight in Mitsuba: for tests of baked light."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.blender.bundle.ply import weld, write_ply


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def quad(path: Path, corners: list[list[float]], place: tuple[float, float], bsdf: dict[str, Any]) -> dict[str, Any]:
    """A square of two triangles; its chart is [place, place + 0.4]² of the atlas."""
    corner = np.array(corners, np.float32)
    order = [0, 1, 2, 0, 2, 3]
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    normals = np.tile(normal / np.linalg.norm(normal), (6, 1)).astype(np.float32)
    atlas = np.concatenate([unit * 0.4 + place, np.zeros((4, 1))], axis=1).astype(np.float32)
    write_ply(path, [weld(corner[order], normals, unit[order], [("atlas", atlas[order])])])
    return {"type": "ply", "filename": str(path), "bsdf": bsdf}


def corner_room(
    folder: Path, floor: dict[str, Any], wall: dict[str, Any], light: dict[str, Any], **more: dict[str, Any]
) -> Any:
    """A floor and a wall behind it."""
    import mitsuba as mi

    return mi.load_dict(
        {
            "type": "scene",
            "floor": quad(folder / "f.ply", [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], (0.05, 0.05), floor),
            "wall": quad(folder / "w.ply", [[-1, 1, 0], [1, 1, 0], [1, 1, 1.5], [-1, 1, 1.5]], (0.55, 0.05), wall),
            "light": light,
            **more,
        }
    )


def onwards(depth: int = 7, kind: str = "path") -> Any:
    """Follows light from its first bounce on."""
    import mitsuba as mi

    return mi.load_dict({"type": kind, "max_depth": depth, "rr_depth": 5, "hide_emitters": True})
