"""A light meter: how bright the scene is in its camera, by a tiny Cycles picture."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

SIZE, SAMPLES, BLOCK = 32, 8, 4


def surfaces() -> np.ndarray:
    """Linear colours [N, 3] of blocks of pixels that show a surface.

    Blocks, as the display curve clips what noise makes bright and would call noisy scenes dark; and nothing clamped,
    as lamps have any level before they are metered.
    """
    scene: Any = bpy.context.scene
    render, cycles, settings = scene.render, scene.cycles, scene.render.image_settings
    wanted = {
        (render, "resolution_x"): SIZE,
        (render, "resolution_y"): SIZE,
        (render, "resolution_percentage"): 100,
        (render, "film_transparent"): True,
        (render, "threads_mode"): "FIXED",
        (render, "threads"): 1,
        (render, "filepath"): render.filepath,
        (cycles, "samples"): SAMPLES,
        (cycles, "use_denoising"): False,
        (cycles, "sample_clamp_indirect"): 0.0,
        (cycles, "use_adaptive_sampling"): False,
        (settings, "file_format"): "OPEN_EXR",
        (settings, "color_mode"): "RGBA",
    }
    before = {key: getattr(*key) for key in wanted}
    with tempfile.TemporaryDirectory() as folder:
        for (owner, name), value in wanted.items():
            setattr(owner, name, value)
        render.filepath = str(Path(folder) / "meter.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(render.filepath)
        pixels = np.empty(len(image.pixels), dtype=np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
        for (owner, name), value in before.items():
            setattr(owner, name, value)
    side = SIZE // BLOCK
    blocks = np.nan_to_num(pixels).reshape(side, BLOCK, side, BLOCK, 4).mean(axis=(1, 3)).reshape(-1, 4)
    blocks = blocks[blocks[:, 3] > 0.5]
    return blocks[:, :3] / blocks[:, 3:]


def factor_for(colours: np.ndarray, wanted: float) -> float:
    """What to multiply light by so that the mean display value is ``wanted``; a power of the fourth root of two, so
    that the last bits of a render do not show in the scene."""

    def mean(steps: int) -> float:
        c = np.clip(colours * 2 ** (steps / 4), 0, 1)
        return float(np.where(c < 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055).mean())

    low, high = -80, 80
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if mean(middle) < wanted else (low, middle)
    return float(2 ** (high / 4))


def scale_light(factor: float) -> None:
    """Multiply all that shines: lamps, the world, emission."""
    lamps: Any = bpy.data.lights
    for lamp in lamps:
        lamp.energy *= factor
    owners = [w for w in bpy.data.worlds if w.node_tree] + [m for m in bpy.data.materials if m.node_tree]
    for owner in owners:
        for node in owner.node_tree.nodes:
            sockets: Any = node.inputs
            name = {"BACKGROUND": "Strength", "EMISSION": "Strength", "BSDF_PRINCIPLED": "Emission Strength"}
            socket = sockets.get(name.get(node.type, ""))
            if socket is not None and not socket.is_linked:
                socket.default_value *= factor
