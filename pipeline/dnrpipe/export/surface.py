"""The diffuse outgoing light of the atlas as textures, for rasterisers."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from ..core.console import Console
from ..core.errors import UserError
from ..core.workspace import Workspace
from ..raytrace.light_worker import read_light
from ..raytrace.variants import choose_variant
from ..stages.base_images import light_path
from ..workers.view_tasks import only_answer

SAMPLES = 16
"""Points per texel."""
LARGEST = 2048
FINER = 2
"""Texels of the textures per texel of the light map, along a side: reflectance has finer detail than light."""


@dataclass(frozen=True)
class SurfaceMaps:
    """radiance: float32 [2, n, n, 4] (front, back): diffuse outgoing and emitted light of the texel, linear Rec.709;
    opacity. normal: float32 [n, n, 3], the triangles', world space. Row 0 at V = 0. thin: backs are visible."""

    radiance: np.ndarray
    normal: np.ndarray
    thin: bool


def surface_maps(workspace: Workspace, console: Console) -> SurfaceMaps:
    """Evaluate the surfaces in a worker process and light them with ``base/light.npz``.

    Raises UserError: no baked light, no jit variant of Mitsuba, or a scene that fails twice.
    """
    light = read_baked_light(workspace)
    size = min(FINER * light.shape[2], LARGEST)
    choice = choose_variant(workspace.manifest.settings.get("raytrace", {}).get("variant", "auto"))
    if choice.variant.startswith("scalar"):
        raise UserError("surface maps need a jit variant of Mitsuba (LLVM or CUDA; see `dnrpipe doctor`)")
    with tempfile.TemporaryDirectory(prefix="dnrpipe-") as folder, console.bar("surface maps", 1) as bar:
        task = {"output": str(Path(folder) / "maps.npz"), "size": size, "samples": SAMPLES, "seed": 0}
        common = {"bundle": str((workspace.scene / "scene.xml").resolve()), "variant": choice.variant}
        result = only_answer(
            "surface maps",
            "dnrpipe.raytrace.surface_maps",
            common,
            task,
            log=Path(folder) / "worker.log",
            console=console,
            environment=choice.environment,
        )
        if lost := result["lost"]:
            console.warn(f"repaired: {lost} samples of the surface maps were not finite and are left out")
        bar.advance(note=f"{size}² texels")
        with np.load(task["output"], allow_pickle=False) as data:
            maps = {name: data[name] for name in data.files}
    sides = torch.from_numpy(light[0]).permute(0, 3, 1, 2)
    lit = F.interpolate(sides, (size, size), mode="bilinear", align_corners=False).permute(0, 2, 3, 1).numpy()
    radiance = np.zeros((2, size, size, 4), np.float32)
    radiance[..., :3] = maps["albedo"] * lit + maps["emission"]
    radiance[..., 3] = maps["opacity"]
    return SurfaceMaps(radiance, maps["normal"], bool(maps["thin"]))


def read_baked_light(workspace: Workspace) -> np.ndarray:
    """``base/light.npz``, float32 [2, 2, n, n, 3]. Raises UserError: this workspace has none, or it is damaged."""
    path = light_path(workspace)
    if not path.is_file():
        raise UserError(f"{path}: no baked light; it comes with `dnrpipe raytrace-selected` where model.base is baked")
    light = read_light(path)
    if light.ndim != 5 or light.shape[:2] != (2, 2) or light.shape[2] != light.shape[3]:
        raise UserError(f"{path}: was baked by an older dnrpipe; run `dnrpipe raytrace-selected` again")
    return light
