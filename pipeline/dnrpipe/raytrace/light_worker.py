"""The light-baking worker: path-traces a bundle's light map into a file (see `lightmap`)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.errors import UserError
from dnrtrain.atomic import atomic_path
from dnrtrain.contract import NPZ_ERRORS

from .engine import BundleWorker
from .gathering import GatheringBaker, can_gather
from .lightmap import LightBaker
from .seen_texels import pixels_of_cells
from .tasks import LightAnswer, LightTask, costs_since
from .texels import grouped_meshes
from .visibility import ROULETTE_DEPTH, integrator_settings


class Worker(BundleWorker):
    """Bakes light maps. common: a `BundleCommon`, task: a `LightTask`.

    The file is an ``npz`` with ``light`` (float32 [2, 2, size, size, 3]: E and S of front and back, row 0 at V = 0) and
    ``fingerprint``.
    """

    compiled_for = "baked light needs"

    def __call__(self, asked: dict[str, Any]) -> LightAnswer:
        task = LightTask.model_validate(asked)
        started, cpu = time.monotonic(), time.process_time()
        scene, groups = self.engine.scenes[str(self.bundle)], grouped_meshes(self.bundle)
        pixels = pixels_of_cells(self.engine.mi, scene, task.views, self.engine.unit_scale) if task.views else None
        baker = light_baker(self.engine.mi, scene, groups, task, pixels)
        light = baker.bake(task.size, task.spp, task.seed)
        with atomic_path(task.output) as temporary, temporary.open("wb") as file:
            np.savez(file, light=light, fingerprint=np.array(task.fingerprint))
        return {
            **costs_since(started, cpu),
            "texels": int((light[0, 0].sum(axis=-1) > 0).sum()),
            "spp": task.spp,
            "gathered": isinstance(baker, GatheringBaker),
            "lost": baker.lost,
        }


def light_baker(
    mi: Any,
    scene: Any,
    groups: Sequence[tuple[Path, np.ndarray]],
    task: LightTask,
    pixels: np.ndarray | None = None,
) -> LightBaker:
    """What bakes the light as the task wants it. Paths are traced where rays are wanted but the scene has media."""
    indirect = indirect_integrator(mi, scene, task.integrator, task.max_depth)
    if not task.gather or indirect is None or not can_gather(scene):
        return LightBaker(mi, scene, indirect, groups, gloss=task.gloss, pixels=pixels)
    coarse = indirect_integrator(mi, scene, task.integrator, task.max_depth - 1)
    caustics = task.integrator != "path-without-caustics"
    return GatheringBaker(mi, scene, coarse, groups, gloss=task.gloss, caustics=caustics, pixels=pixels)


def indirect_integrator(mi: Any, scene: Any, kind: str, max_depth: int) -> Any:
    """The integrator that follows paths from their first diffuse bounce on; None: direct light is all."""
    depth = max_depth - 1
    if kind == "direct" or depth < 2:
        return None
    settings = integrator_settings(mi, scene, kind)
    if kind == "path-without-caustics":
        settings["after_diffuse"] = True
    return mi.load_dict(settings | {"max_depth": depth, "rr_depth": ROULETTE_DEPTH, "hide_emitters": True})


def read_light(path: Path) -> np.ndarray:
    """float32 [2, 2, size, size, 3]. Raises UserError when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return np.asarray(data["light"], np.float32)
    except NPZ_ERRORS as error:
        raise UserError(f"{path}: no baked light ({error}); delete it and run the stage again") from None
