"""An orbit of close frames: how much each renderer changes from frame to frame beyond what the light does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.cameras import orbit_views
from dnrpipe.studies.frames.baselines import make_baselines, render_baselines
from dnrpipe.studies.frames.ours import Ours
from dnrpipe.studies.frames.scene import BenchScene, Clock
from dnrtrain.contract import View

from .motion import Surface, flicker
from .reference import make_references

STEPS = 360
"""Frames of a full turn: one degree each, a quarter of a minute at 24 frames per second."""


def measure(
    scene: BenchScene,
    ours: Ours,
    clock: Clock,
    baselines: list[tuple[int, str]],
    *,
    frames: int,
    spp: int,
    kind: str,
    folder: Path,
    tell: Any,
) -> dict[str, Any]:
    """Flicker of ours, of the base image and of baselines, which draw new random numbers for every frame.

    Args:
        scene, ours, clock: of the benchmark.
        baselines: (samples, method) of each.
        frames: of the orbit.
        spp, kind: of the references.
        folder: references are kept there.
        tell: called with a line per frame.

    Returns {"frames", "degrees", "reference", "reference_spp", "reference_noise", "rows": {name: `motion.flicker`}}.
    """
    views = _orbit(scene, frames)
    reference = make_references(scene, views, "orbit", spp, kind, folder, tell)
    truth = [_plane(scene.shown(picture)) for picture in reference.pictures]
    surfaces: list[Surface] = []
    found: dict[str, list[np.ndarray]] = {}
    for number, view in enumerate(views):
        gbuffer = scene.frames.gbuffer(view)
        surfaces.append(surface_of(view, gbuffer))
        for name, frame in ours.frame(view, clock).items():
            found.setdefault(name, []).append(_plane(frame["picture"]))
        for spp_, method in baselines:
            single = make_baselines((spp_,), (method,))
            render_baselines(scene, view, 1_000_003 * (number + 1), clock, single)
            (one,) = single.values()
            found.setdefault(one.name, []).append(_plane(one.pictures[0]))
        tell(f"{scene.name}: orbit frame {number + 1} of {frames}")
    rows = {name: flicker(pictures, truth, surfaces) for name, pictures in found.items()}
    return {
        "frames": frames,
        "degrees": 360 / STEPS,
        "reference": reference.kind,
        "reference_spp": spp,
        "reference_noise": float(np.mean(reference.noise)),
        "rows": rows,
    }


def surface_of(view: View, gbuffer: dict[str, np.ndarray]) -> Surface:
    """What the G-buffer's camera sees."""
    position = np.stack([gbuffer[f"position.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    return Surface(view, position, gbuffer["depth.Z"].astype(np.float64), gbuffer["mask"] > 0.5)


def _orbit(scene: BenchScene, frames: int) -> list[View]:
    width, height = scene.size
    cameras = scene.settings.cameras.model_copy(update={"width": width, "height": height})
    return orbit_views(scene.summary, cameras, STEPS)[:frames]


def _plane(picture: Any) -> np.ndarray:
    """torch [1, 3, H, W] -> float64 [H, W, 3]."""
    return picture[0].double().clamp(0, 1).permute(1, 2, 0).numpy()
