"""How far the shipped corrector is to be trusted on a scene: it is measured on a few small traced views.

It never saw the scene, and where its base image is unlike those that it was trained on it can do harm. The share of
its correction that is applied (`ModelSettings.trust`) is the one that does best here; 0 leaves the base image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

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


def measure_trust(run: Run, model: DNR) -> Trust:
    """Trace the views and their base images, where that is not done, and find the best share.

    ``model`` is left with that share.
    """
    views = trust_views(run.workspace)
    trace_views(run, views, SPLIT, spp=SPP)
    base_views(run, views, SPLIT)
    return best_share(model, load(run.workspace, views, SPLIT, raytraced=True, base=run.settings.model.base))


def best_share(model: DNR, views: ViewSet) -> Trust:
    """The share of the model's correction that is best on views with their references. ``model`` is left with it."""
    import torch

    from dnrtrain.metrics import psnr
    from dnrtrain.model import render_views

    target = views.tensors.target
    assert target is not None  # loaded with raytraced=True

    def apply(share: float) -> None:
        model.settings = model.settings.model_copy(update={"trust": share})

    def quality(share: float) -> float:
        apply(share)
        pictures = zip(render_views(model, views), target, strict=True)
        return sum(float(psnr(picture[None], truth[None])) for picture, truth in pictures) / len(views)

    with torch.inference_mode():
        found = {share: quality(share) for share in SHARES}
    share = max(found, key=lambda share: found[share])
    apply(share)
    return Trust(share=share, psnr=(found[0.0], found[share]))
