"""What the base image gives to the network, and from the network's outputs and the base image to the picture.

Notation
    f        log space (see `to_log`) or display space
    base     the base image; with camera guides, of a frame that remembers: (1 - g) of what is remembered, g of the
             frame's own, in f
    K        per-pixel kernels, k×k weights each, that sum to 1; they start close to the identity
    a, m     added and multiplied correction, 3 channels each; they start at 0
    g        starts at sigmoid(OWN)
    t        share of the correction that is applied (``settings.trust``)

    f(picture) = (1 - t) · f(base) + t · (K * f(base) · (1 + m) + a)

A base image has few fixed directions per pixel: it is grainy on rough metal and jagged at edges. Kernels smooth that
and keep what is sharp (kernel prediction; Bako et al. 2017); in log space a single bright pixel does not win.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from .contract import ContractError
from .dataset import Batch
from .display import Display
from .settings import ModelSettings
from .srgb import LUMINANCE

LOG_SCALE = 10.0
"""k of log(1 + k x) / log(1 + k): with 10, the curve is close to display gamma in [0, 1] and keeps going above."""
IDENTITY = 4.0
"""What the kernels' middle weight has ahead of the others before the softmax, so it starts with 0.87 of the sum."""
OWN = -2.0
"""What g begins from before the sigmoid: 0.12 of the frame's own."""
LOG_CEILING = 30.0
"""Log values above it (radiance of 2e30) count as it: the exponential would overflow, and its gradient with it."""


def to_log(radiance: Tensor) -> Tensor:
    """Linear radiance >= 0 -> log(1 + k x) / log(1 + k); 0 stays 0, 1 stays 1."""
    return torch.log1p(LOG_SCALE * radiance) * (1.0 / math.log1p(LOG_SCALE))


def from_log(value: Tensor) -> Tensor:
    """Inverse of `to_log`; below 0 (darker than black) it goes on continuously, above LOG_CEILING it is flat."""
    return torch.expm1(value.clamp_max(LOG_CEILING) * math.log1p(LOG_SCALE)) / LOG_SCALE


def require_base(batch: Batch) -> tuple[Tensor, Display]:
    """The base image and the display transform. Raises ContractError when the views were loaded without."""
    if batch.base is None or batch.display is None:
        raise ContractError("this model corrects a base image, but the views were loaded without; load them with it")
    return batch.base, batch.display


def correct(batch: Batch, outputs: Tensor, settings: ModelSettings) -> tuple[Tensor, Tensor | None]:
    """-> (display RGB [N, 3, H, W], linear straight radiance or None where the output space is display).

    ``outputs``: a, m, the kernels' weights before the softmax and, with camera guides, g before the sigmoid:
    [N, `output_channels`, H, W].
    """
    base, display = require_base(batch)
    added, scaled = outputs[:, :6].chunk(2, dim=1)
    value = start = _encode(base, display, settings)
    if batch.fresh is not None and settings.guides == "camera":
        own = _encode(batch.fresh, display, settings)
        value = torch.lerp(start, own, torch.sigmoid(outputs[:, -1:] + OWN))
    kernels = outputs[:, 6 : 6 + settings.filter**2]
    value = filter_by(value, kernels) if settings.filter else value
    value = torch.addcmul(value + added, value, scaled)
    if settings.trust < 1:
        value = torch.lerp(start, value, settings.trust)
    return _decode(value, display, settings)


def uncorrected(batch: Batch, settings: ModelSettings) -> tuple[Tensor, Tensor | None]:
    """What `correct` gives at t = 0, where no network is asked."""
    base, display = require_base(batch)
    return _decode(_encode(base, display, settings), display, settings)


def _encode(radiance: Tensor, display: Display, settings: ModelSettings) -> Tensor:
    """f."""
    return to_log(display.scale * radiance) if settings.output == "log" else display(radiance)


def _decode(value: Tensor, display: Display, settings: ModelSettings) -> tuple[Tensor, Tensor | None]:
    """The picture of f(picture), as `correct` returns it."""
    if settings.output == "display":
        return value, None
    radiance = from_log(value).clamp_min(0.0) / display.scale
    return display(radiance), radiance


def filter_by(image: Tensor, weights: Tensor) -> Tensor:
    """``image`` [N, C, H, W] smoothed by kernels of its own in each pixel.

    ``weights`` [N, k², H, W] row by row; their softmax, the middle ahead by IDENTITY, is the kernel. Beyond the border
    the last pixel continues.
    """
    count = int(weights.shape[1])  # a number also where torch traces shapes
    side = round(count**0.5)
    ahead = F.one_hot(torch.tensor(count // 2, device=weights.device), count).view(1, count, 1, 1) * IDENTITY
    kernel = (weights + ahead).softmax(dim=1)
    height, width = image.shape[-2:]
    padded = F.pad(image, (side // 2,) * 4, mode="replicate")
    total = kernel[:, :1] * padded[..., :height, :width]
    for i in range(1, count):  # shifted views: ten times faster than unfolding the image
        y, x = divmod(i, side)
        total = torch.addcmul(total, kernel[:, i : i + 1], padded[..., y : y + height, x : x + width])
    return total


def output_channels(settings: ModelSettings) -> int:
    """Of the network: what `correct` reads, or a colour."""
    if settings.base == "none":
        return 3
    return 6 + settings.filter**2 + (1 if settings.guides == "camera" else 0)


def guide_channels(settings: ModelSettings) -> int:
    """Channels of `guide_maps`."""
    shown = 0 if settings.base == "none" else 3
    if settings.guides == "camera":
        return shown + 17
    if not settings.guides:
        return shown
    return shown + 10 + (6 if settings.base in ("baked", "direct", "path") else 0)


def guide_maps(batch: Batch, settings: ModelSettings) -> list[Tensor]:
    """The base in display space, where there is one: what is to be corrected must be seen. With ``settings.guides``
    also view direction, normal, reflection direction and their cosine, and, as far as the base image has them, the
    albedo and the specular part in log space (display space would clip it). [N, C, H, W] each.

    Camera guides say nothing of where in the world the camera is: normal in camera space, cosine, albedo, specular
    part, coverage, the base's standard error relative to its luminance, log2 of the rays per pixel over 3; and the
    frame's own base image with its rays, which are the same where nothing is remembered.

    Raises ContractError when the model wants a base image and the views were loaded without.
    """
    maps: list[Tensor] = []
    if settings.base != "none":
        base, display = require_base(batch)
        maps.append(display(base))
    if not settings.guides:
        return maps
    cosine = (batch.normal * batch.view_dir).sum(dim=1, keepdim=True)
    if settings.guides == "camera":
        base, display = require_base(batch)
        assert batch.diffuse is not None and batch.albedo is not None and batch.noise is not None
        assert batch.rays is not None and batch.camera_normal is not None  # base files hold them all
        luminance = (base * base.new_tensor(LUMINANCE).view(1, 3, 1, 1)).sum(dim=1, keepdim=True)
        noise = display.scale * batch.noise / (display.scale * luminance.clamp_min(0.0) + 1.0 / LOG_SCALE)
        specular = to_log(display.scale * (base - batch.diffuse).clamp_min(0.0))
        rays = batch.rays.log2() / 3.0
        own = [maps[0], rays]
        if batch.fresh is not None and batch.fresh_rays is not None:
            own = [display(batch.fresh), batch.fresh_rays.log2() / 3.0]
        maps += [batch.camera_normal, cosine, batch.albedo, specular, batch.coverage, noise.clamp_max(2.0), rays]
        return [*maps, *own]
    reflection = 2.0 * cosine * batch.normal - batch.view_dir
    maps += [batch.view_dir, batch.normal, reflection * batch.mask, cosine]
    if settings.base in ("baked", "direct", "path"):
        base, display = require_base(batch)
        assert batch.diffuse is not None and batch.albedo is not None  # base files hold them all
        maps += [batch.albedo, to_log(display.scale * (base - batch.diffuse).clamp_min(0.0))]
    return maps
