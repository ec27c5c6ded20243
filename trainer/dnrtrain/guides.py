"""What the renderer sees beside the neural texture: the base image, its parts, and directions."""

from __future__ import annotations

from torch import Tensor

from .correction import require_base, to_log
from .dataset import Batch
from .settings import ModelSettings


def guide_channels(settings: ModelSettings) -> int:
    """Channels of `guide_maps`."""
    shown = 0 if settings.base == "none" else 3
    if not settings.guides:
        return shown
    return shown + 10 + (6 if settings.base in ("baked", "direct", "path") else 0)


def guide_maps(batch: Batch, settings: ModelSettings) -> list[Tensor]:
    """The base in display space, where there is one: what is to be corrected must be seen. With ``settings.guides``
    also view direction, normal, reflection direction and their cosine, and, as far as the base image has them, the
    albedo and the specular part in log space (display space would clip it). [N, C, H, W] each.

    Raises ContractError when the model wants a base image and the views were loaded without.
    """
    maps: list[Tensor] = []
    if settings.base != "none":
        base, display = require_base(batch)
        maps.append(display(base))
    if not settings.guides:
        return maps
    cosine = (batch.normal * batch.view_dir).sum(dim=1, keepdim=True)
    reflection = 2.0 * cosine * batch.normal - batch.view_dir
    maps += [batch.view_dir, batch.normal, reflection * batch.mask, cosine]
    if settings.base in ("baked", "direct", "path"):
        base, display = require_base(batch)
        assert batch.diffuse is not None and batch.albedo is not None  # base files hold them all
        maps += [batch.albedo, to_log(display.scale * (base - batch.diffuse).clamp_min(0.0))]
    return maps
