"""``python -m dnrpipe.raytrace.probe VARIANT``: does this Mitsuba variant render? One JSON line."""

from __future__ import annotations

import json
import sys

import numpy as np


def probe(variant: str) -> dict[str, object]:
    """Render a lit sphere with textures and a rough metal, the plugins that reach deepest into LLVM."""
    import mitsuba as mi

    mi.set_variant(variant)
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgba"},
            },
            "light": {"type": "constant"},
            "metal": {"type": "sphere", "bsdf": {"type": "roughconductor", "alpha": 0.2}},
            "glass": {"type": "sphere", "center": [1.5, 0, 0], "bsdf": {"type": "roughdielectric"}},
            "plastic": {
                "type": "sphere",
                "center": [-1.5, 0, 0],
                "bsdf": {"type": "principled", "spec_trans": 0.5},
            },
        }
    )
    image = np.array(mi.render(scene, spp=4, seed=1))  # pyright: ignore[reportArgumentType]
    good = bool(np.isfinite(image).all() and image[..., 3].max() > 0.9 and image[..., :3].max() > 0.1)
    return {"ok": good, "error": None if good else "rendered a wrong picture", "version": mi.__version__}


if __name__ == "__main__":
    try:
        answer = probe(sys.argv[1])
    except Exception as error:  # the caller wants the reason, not a traceback
        answer = {"ok": False, "error": " ".join(str(error).split())[:200]}
    print(json.dumps(answer), flush=True)
