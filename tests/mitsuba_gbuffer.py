"""What Mitsuba sees of a frozen scene at pixel centres, for a subprocess (a bad LLVM kills its process).

``python tests/mitsuba_gbuffer.py geometry.npz view.json OUT.npz`` writes float32 arrays: mask, depth (planar),
uv, normal, geometric (facing unchanged) and position, [H, W, ...].
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.blender.geometry.frozen import load_geometry
from dnrtrain.contract import View


def main(geometry: str, view_file: str, output: str) -> None:
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    view = View.model_validate(json.loads(Path(view_file).read_text()))
    shapes = {}
    for mesh in load_geometry(Path(geometry)):
        count = mesh.triangles
        shape = mi.Mesh(mesh.name, 3 * count, count, has_vertex_normals=True, has_vertex_texcoords=True)
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = mesh.positions.ravel()
        parameters["vertex_normals"] = mesh.normals.ravel()
        parameters["vertex_texcoords"] = mesh.atlas.ravel()
        parameters["faces"] = np.arange(3 * count, dtype=np.uint32)
        parameters.update()
        shapes[mesh.name] = shape
    width, height = view.width, view.height
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * width / view.fl_x))),
            "fov_axis": "x",
            "near_clip": 1e-3,
            "far_clip": 1e3,
            "principal_point_offset_x": (width / 2 - view.cx) / width,
            "principal_point_offset_y": (height / 2 - view.cy) / height,
            "to_world": mi.ScalarTransform4f((view.matrix @ np.diag([-1, 1, -1, 1])).tolist()),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
        }
    )
    scene = mi.load_dict({"type": "scene", **shapes})
    forward = -view.matrix[:3, 2]
    found = {name: np.zeros((height, width, size), np.float64) for name, size in SIZES.items()}
    for row in range(height):
        for column in range(width):
            sample = mi.Point2f((column + 0.5) / width, (row + 0.5) / height)
            ray, _ = sensor.sample_ray(0.0, 0.5, sample, mi.Point2f(0.5))
            hit = scene.ray_intersect(ray)
            if hit.is_valid():
                at = row, column
                found["mask"][at] = 1
                found["position"][at] = hit.p
                found["depth"][at] = (np.array(hit.p) - view.position) @ forward
                found["uv"][at] = hit.uv
                found["normal"][at] = hit.sh_frame.n
                found["geometric"][at] = hit.n
    arrays: dict[str, Any] = {name: values.squeeze().astype(np.float32) for name, values in found.items()}
    np.savez(output, **arrays)


SIZES = {"mask": 1, "depth": 1, "uv": 2, "normal": 3, "geometric": 3, "position": 3}

if __name__ == "__main__":
    main(*sys.argv[1:])
