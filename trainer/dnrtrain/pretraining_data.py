"""Training data of the shipped corrector: many scenes, few views each, memory-mapped half floats.

One folder per scene, written by the pipeline: ``maps.npy`` and ``scene.json``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor

from .contract import FRESH_CHANNELS, SceneFrame, View
from .dataset import Batch, in_camera_space
from .display import ALPHA_FLOOR, Display, DisplayTransform

SHARED = ("depth.Z", "normal.X", "normal.Y", "normal.Z", "mask", "coverage")
TARGET = ("target.R", "target.G", "target.B", "target.A")
LAYERS = (
    *("base.R", "base.G", "base.B", "base.A"),
    *("diffuse.R", "diffuse.G", "diffuse.B"),
    *("albedo.R", "albedo.G", "albedo.B", "noise", "rays"),
)
"""Of a base image: channels of a base file (see `contract`)."""
BRIGHT = {*TARGET[:3], *LAYERS[:3], *LAYERS[4:7], "noise", *FRESH_CHANNELS[:3]}
"""Channels that are radiance."""
RAY_COUNTS = (1, 2, 4, 8)


def channel_names(inputs: Sequence[str]) -> list[str]:
    """Channels of ``maps.npy``, in order; those of the base image called k end in @k."""
    layers = [f"{name}@{k}" for k in inputs for name in (*LAYERS, *(FRESH_CHANNELS if has_own(k) else ()))]
    return [*SHARED, *TARGET, *layers]


def has_own(chosen: str) -> bool:
    """Whether a base image is denoised, so that the frame's own, with its grain, stands beside it."""
    return not chosen.isdecimal()


class Scene(BaseModel, extra="forbid", frozen=True):
    """``scene.json``.

    frame: its exposure is 0: radiance in the maps is in units of display white.
    inputs: the base images of each view: "8" of eight rays per pixel, "8 denoised", and "8 remembered", into which
        earlier frames went before it was denoised.
    noise: of the references, relative RMSE in display space, as `dnrpipe raytrace-selected` measures it. They are not
        denoised.
    """

    seed: int
    family: str
    views: list[View]
    inputs: list[str]
    frame: SceneFrame
    triangles: int
    noise: float
    seconds: dict[str, float]


class Displays:
    """Display transforms of a batch's pictures, one each, none with an exposure. As `DisplayTransform` otherwise."""

    scale = 1.0

    def __init__(self, displays: Sequence[Display]) -> None:
        self.displays = displays

    def __call__(self, radiance: Tensor) -> Tensor:
        return torch.cat([show(part) for show, part in zip(self.displays, radiance.split(1), strict=True)])

    def over_white(self, premultiplied: Tensor, alpha: Tensor) -> Tensor:
        pictures = zip(self.displays, premultiplied.split(1), alpha.split(1), strict=True)
        return torch.cat([show.over_white(colour, cover) for show, colour, cover in pictures])


def joined(pictures: Sequence[Batch]) -> Batch:
    """Batches of one picture each, of one size, as one batch."""
    tensors = {
        field.name: torch.cat([getattr(picture, field.name) for picture in pictures])
        for field in fields(Batch)
        if isinstance(getattr(pictures[0], field.name), Tensor)
    }
    displays = [picture.display for picture in pictures if picture.display is not None]
    return Batch(**tensors, display=Displays(displays))


class SceneMaps:
    """One scene of the training data, memory-mapped.

    Raises FileNotFoundError, DamagedFile: not one.
    """

    def __init__(self, folder: Path) -> None:
        self.scene = Scene.model_validate_json((folder / "scene.json").read_bytes())
        self.maps = np.load(folder / "maps.npy", mmap_mode="r", allow_pickle=False)
        self.display = DisplayTransform(self.scene.frame, folder)
        self.places = {name: index for index, name in enumerate(channel_names(self.scene.inputs))}
        self.view_dirs = [torch.from_numpy(-view.ray_directions()).permute(2, 0, 1) for view in self.scene.views]

    def draw(self, random: np.random.Generator, side: int) -> Batch:
        """A random square of a random view, with one of its base images."""
        view, chosen = int(random.integers(len(self.scene.views))), str(random.choice(self.scene.inputs))
        height, width = self.maps.shape[-2:]
        top, left = (int(random.integers(max(1, size - side + 1))) for size in (height, width))
        return self.batch(view, chosen, (slice(top, top + side), slice(left, left + side)))

    def batch(self, view: int, chosen: str, window: tuple[slice, slice] = (slice(None), slice(None))) -> Batch:
        """One view as the model sees it, by one of its inputs. ``target`` is linear, premultiplied, with its alpha:
        [1, 4, H, W]."""

        def of(*names: str) -> Tensor:
            planes = [self.places[name] for name in names]
            return torch.from_numpy(np.asarray(self.maps[view, planes, window[0], window[1]], dtype=np.float32))[None]

        def layer(name: str) -> Tensor:
            return of(*(f"{name}.{c}@{chosen}" for c in "RGB")) / alpha

        alpha = of(f"base.A@{chosen}").clamp(ALPHA_FLOOR, 1.0)
        mask = (of("mask") > 0.5).float()
        normal = of("normal.X", "normal.Y", "normal.Z") * mask
        zero = torch.zeros_like(mask)
        return Batch(
            uv=zero.expand(-1, 2, -1, -1),
            depth=zero,
            normal=normal,
            mask=mask,
            coverage=of("coverage").clamp(0.0, 1.0),
            view_dir=self.view_dirs[view][None, :, window[0], window[1]],
            camera_normal=in_camera_space(normal[0], self.scene.views[view])[None],
            target=of(*TARGET),
            base=layer("base"),
            fresh=layer("fresh" if has_own(chosen) else "base"),
            fresh_rays=of(f"{'fresh.' if has_own(chosen) else ''}rays@{chosen}").clamp_min(1.0),
            diffuse=layer("diffuse"),
            albedo=layer("albedo"),
            noise=of(f"noise@{chosen}") / alpha,
            rays=of(f"rays@{chosen}").clamp_min(1.0),
            display=self.display,
        )
