"""The light-baking worker: path-traces a bundle's light map into a file (see :mod:`.lightmap`)."""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.errors import UserError
from dnrtrain.atomic import atomic_path
from dnrtrain.contract import NPZ_ERRORS

from .engine import Engine
from .lightmap import LightBaker
from .texels import grouped_meshes
from .visibility import ROULETTE_DEPTH


class Worker:
    """Bakes light maps.

    common: {"bundle", "variant"}
    task: {"output", "size", "spp", "integrator", "max_depth", "seed", "fingerprint"}; the file is an ``npz`` with
    ``light`` (float32 [2, 2, size, size, 3]: E and G of front and back, row 0 at V = 0) and ``fingerprint``. ``lost``
    of the answer: samples that were not finite.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.bundle = Path(common["bundle"])
        self.engine = Engine(common["variant"], 0, [self.bundle])
        if not self.engine.compiled:
            raise UserError("baked light needs a jit variant of Mitsuba (LLVM or CUDA; see `dnrpipe doctor`)")

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        started, cpu = time.monotonic(), time.process_time()
        scene, groups = self.engine.scenes[str(self.bundle)], grouped_meshes(self.bundle)
        baker = LightBaker(self.engine.mi, scene, self._onwards(task), groups)
        light = baker.bake(int(task["size"]), int(task["spp"]), int(task["seed"]))
        with atomic_path(task["output"]) as temporary, temporary.open("wb") as file:
            np.savez(file, light=light, fingerprint=np.array(task["fingerprint"]))
        return {
            "seconds": time.monotonic() - started,
            "cpu_seconds": time.process_time() - cpu,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "texels": int((light[0, 0].sum(axis=-1) > 0).sum()),
            "spp": int(task["spp"]),
            "lost": baker.lost,
        }

    def _onwards(self, task: dict[str, Any]) -> Any:
        """What follows paths from their first diffuse bounce on; None where the plan is direct light alone."""
        kind, depth = task["integrator"], int(task["max_depth"]) - 1
        if kind == "direct" or depth < 2:
            return None
        settings: dict[str, Any] = {"type": kind}
        if kind == "path-without-caustics":
            settings = {"type": "dnr_path", "caustics": False, "after_diffuse": True}
        settings |= {"max_depth": depth, "rr_depth": ROULETTE_DEPTH, "hide_emitters": True}
        return self.engine.mi.load_dict(settings)


def read_light(path: Path) -> np.ndarray:
    """float32 [2, 2, size, size, 3]. Raises UserError when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return np.asarray(data["light"], np.float32)
    except NPZ_ERRORS as error:
        raise UserError(f"{path}: no baked light ({error}); delete it and run the stage again") from None
