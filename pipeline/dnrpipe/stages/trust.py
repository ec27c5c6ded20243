"""How far the shipped corrector is to be trusted on a scene: it is measured on a few small traced views.

It never saw the scene, and where its base image is unlike those that it was trained on it can do harm. The share of
its correction that is applied (`ModelSettings.trust`) is the one that does best here; 0 leaves the base image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel

from dnrtrain.contract import View

from ..core.cameras import scaled_to, spread
from ..core.scene_files import split_views
from ..core.workspace import Workspace
from .base_images import base_views
from .raytrace import trace_views
from .stage import Run
from .trainer import load

if TYPE_CHECKING:
    from dnrtrain.dataset import ViewSet
    from dnrtrain.model import DNR

SPLIT = "trust"
"""Of the views' files."""
VIEWS, SIDE, SPP = 4, 128, 32
"""Views, pixels of their longer side, samples per pixel: seconds, and half a decibel is seen."""
SHARES = tuple(i / 10 for i in range(11))


class Trust(BaseModel, frozen=True):
    """share: of the correction. psnr: of the base image, and with that share, dB, mean of the views."""

    share: float
    psnr: tuple[float, float]

    @property
    def told(self) -> str:
        """One line for the user."""
        base, ours = self.psnr
        if self.share == 0:
            return f"the shipped corrector does no good here: frames are base images ({base:.1f} dB on small views)"
        return f"shipped corrector, {self.share:.0%} of it: {base:.1f} -> {ours:.1f} dB on {VIEWS} small traced views"


def trust_views(workspace: Workspace) -> list[View]:
    """Candidates spread over all, as small pictures."""
    return [scaled_to(view, SIDE) for view in spread(split_views(workspace)["train"], VIEWS)]


def traced_small(run: Run) -> list[View]:
    """`trust_views`, traced and with their base images: made where they are not yet."""
    views = trust_views(run.workspace)
    trace_views(run, views, SPLIT, spp=SPP)
    base_views(run, views, SPLIT)
    return views


def measure_trust(run: Run, model: DNR) -> Trust:
    """Find the share that is good on the small views, whether their references are denoised or as traced. ``model`` is
    left with it.

    What was traced is clipped for display, which darkens bright noise (by 0.02 on `jewels`' caustics) and speaks for a
    darker picture, as a denoiser's softness speaks for a soft one: the lesser share does no harm by either.
    """
    views, base = traced_small(run), run.settings.model.base
    noisy = best_share(model, load(run.workspace, views, SPLIT, raytraced=True, raw=True, base=base))
    clean = load(run.workspace, views, SPLIT, raytraced=True, base=base)
    share = min(noisy, best_share(model, clean))
    _apply(model, share)
    before, after = mean_psnr(model, clean)
    return Trust(share=share, psnr=(before, after))


def best_share(model: DNR, views: ViewSet) -> float:
    """The share of the model's correction that is best on views with their references. ``model`` is left with it.

    Load them raw where they have many samples: a denoiser's softness speaks for a soft picture, while noise that is not
    clipped adds the same to the error of all.
    """
    import torch

    from dnrtrain.model import render_views

    target = views.tensors.target
    assert target is not None  # loaded with raytraced=True

    def error(share: float) -> float:
        _apply(model, share)
        return float((render_views(model, views) - target).square().mean())

    with torch.inference_mode():
        found = {share: error(share) for share in SHARES}
    share = min(found, key=lambda share: found[share])
    _apply(model, share)
    return share


def _apply(model: DNR, share: float) -> None:
    model.settings = model.settings.model_copy(update={"trust": share})


def mean_psnr(model: DNR, views: ViewSet) -> tuple[float, float]:
    """PSNR over white against the views' targets, dB, mean of the views: of the base images and of the model."""
    import torch

    from dnrtrain.metrics import psnr
    from dnrtrain.model import base_picture, render_views

    target = views.tensors.target
    assert target is not None
    with torch.inference_mode():
        both = base_picture(views.tensors), render_views(model, views)
    base, ours = (
        float(np.mean([float(psnr(p[None], t[None])) for p, t in zip(some, target, strict=True)])) for some in both
    )
    return base, ours
