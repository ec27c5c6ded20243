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
ENOUGH = 0.95
"""Of the most that any share gains."""
LEAST_GAIN = 0.3
"""dB. The network takes about as long as two rays of each pixel (docs/frames.md), which beside eight bring as much."""


class Trust(BaseModel, frozen=True):
    """share: of the correction. psnr: of the base image, and with that share, dB, mean of the views."""

    share: float
    psnr: tuple[float, float]

    @property
    def told(self) -> str:
        """One line for the user."""
        base, ours = self.psnr
        if self.share == 0:
            return f"the shipped corrector gains too little here: frames are base images ({base:.1f} dB on small views)"
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
    """Find the share that does best on the small views; 0 where it gains less than LEAST_GAIN. ``model`` is left with
    it."""
    views, base = traced_small(run), run.settings.model.base
    noisy, clean = (load(run.workspace, views, SPLIT, raytraced=True, raw=raw, base=base) for raw in (True, False))
    trust = judged(best_share(model, noisy, clean), *mean_psnr(model, clean))
    _apply(model, trust.share)
    return trust


def judged(share: float, before: float, after: float) -> Trust:
    """``share``, or none where it gains less than LEAST_GAIN. before, after: PSNR without and with it, dB."""
    if after - before < LEAST_GAIN:
        return Trust(share=0, psnr=(before, before))
    return Trust(share=share, psnr=(before, after))


def best_share(model: DNR, noisy: ViewSet, clean: ViewSet) -> float:
    """The least share of the model's correction that gains nearly as much as any on views with references, whether
    these are as traced or denoised. ``model`` is left with it.

    Error over share is about a parabola: at 0.78 of the best share 95 % of the gain is there, and a best share that is
    too large by the choice of views does less harm.
    Noise is clipped for display, which darkens it (by 0.02 on `jewels`' caustics) and speaks for a darker picture; a
    denoiser's softness speaks for a soft one. The lesser share does no harm by either.

    Args:
        noisy, clean: the same views, their targets before and after the denoiser.
    """
    import torch

    from dnrtrain.model import render_views

    raw, smooth = noisy.tensors.target, clean.tensors.target
    assert raw is not None and smooth is not None  # loaded with raytraced=True

    def errors(share: float) -> list[float]:
        _apply(model, share)
        pictures = render_views(model, noisy)
        return [float((pictures - target).square().mean()) for target in (raw, smooth)]

    with torch.inference_mode():
        found = [errors(share) for share in SHARES]
    share = min(_sufficient(list(each)) for each in zip(*found, strict=True))
    _apply(model, share)
    return share


def _sufficient(errors: list[float]) -> float:
    """The least of SHARES with ENOUGH of the most that any gains. errors: of SHARES, in their order."""
    wanted = errors[0] - ENOUGH * (errors[0] - min(errors))
    return next(share for share, error in zip(SHARES, errors, strict=True) if error <= wanted)


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
