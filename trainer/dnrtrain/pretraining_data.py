"""Training data of the shipped corrector: many scenes, few views each, memory-mapped half floats.

One folder per scene, written by the pipeline: ``maps.npy`` and ``scene.json``.
"""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel

from .contract import SceneFrame, View

SHARED = ("depth.Z", "normal.X", "normal.Y", "normal.Z", "mask", "coverage")
TARGET = ("target.R", "target.G", "target.B", "target.A")
LAYERS = (
    *("base.R", "base.G", "base.B", "base.A"),
    *("diffuse.R", "diffuse.G", "diffuse.B"),
    *("albedo.R", "albedo.G", "albedo.B", "noise"),
)
"""Of a base image: channels of a base file (see `contract`)."""
BRIGHT = {*TARGET[:3], *LAYERS[:3], *LAYERS[4:7], "noise"}
"""Channels that are radiance."""
RAY_COUNTS = (1, 2, 4, 8)


def channel_names(rays: Sequence[int]) -> list[str]:
    """Channels of ``maps.npy``, in order; those of a base image of k rays per pixel end in @k."""
    return [*SHARED, *TARGET, *(f"{name}@{k}" for k in rays for name in LAYERS)]


class Scene(BaseModel, extra="forbid", frozen=True):
    """``scene.json``.

    frame: its exposure is 0: radiance in the maps is in units of display white.
    rays: per pixel, of the base images.
    noise: of the references, relative RMSE in display space, as `dnrpipe raytrace-selected` measures it.
    """

    seed: int
    family: str
    views: list[View]
    rays: list[int]
    frame: SceneFrame
    triangles: int
    noise: float
    seconds: dict[str, float]
