"""Scene-linear radiance -> display RGB, in one place.

The transform is the scene's own: exposure in stops, then its baked view transform (a 3-D LUT) or the
sRGB opto-electronic transfer function (IEC 61966-2-1), then Blender's extra gamma. Losses, metrics and
8-bit files all live on its output.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .contract import NPZ_ERRORS, DamagedFile, SceneFrame
from .precision import at_least_float32
from .srgb import LINEAR_END

MAX_LUT_BYTES = 64 << 20
ALPHA_FLOOR = 1e-6
GAMMA_FLOOR = 1e-6
"""Below it Blender's extra gamma is its chord: the power's slope at black is infinite, and so would gradients be."""


def srgb_oetf(linear: Tensor) -> Tensor:
    """Linear Rec.709 -> sRGB code values in [0, 1]; negatives become 0, values above 1 become 1."""
    x = linear.clamp(0.0, 1.0)
    # The power's argument is kept above the linear segment: its slope at 0 is infinite.
    curve = (x.clamp_min(LINEAR_END) ** (1 / 2.4)).mul_(1.055).sub_(0.055)
    return torch.where(x <= LINEAR_END, 12.92 * x, curve)


class Display(Protocol):
    """Linear Rec.709 -> display RGB. scale: of its exposure, linear."""

    scale: float

    def __call__(self, radiance: Tensor) -> Tensor: ...

    def over_white(self, premultiplied: Tensor, alpha: Tensor) -> Tensor: ...


class DisplayTransform:
    """The scene's display transform.

    Args:
        frame: exposure, gamma and the name of the LUT file.
        folder: where ``frame.display_lut`` lies (the workspace's ``scene`` folder).

    Raises:
        DamagedFile: the LUT is missing, too large, has another shape than [N, N, N, 3] or is not finite.
    """

    def __init__(self, frame: SceneFrame, folder: Path) -> None:
        self.scale = 2.0**frame.exposure
        self.inverse_gamma = 1.0 / frame.gamma
        self.lut: Tensor | None = None
        self.maximum = self.k = 1.0
        if frame.display_lut is not None:
            self._read(Path(folder) / frame.display_lut)

    def _read(self, path: Path) -> None:
        if not path.is_file():
            raise DamagedFile(path, "the display transform is missing")
        try:
            with np.load(path, allow_pickle=False) as data:
                size = sum(entry.file_size for entry in data.zip.infolist())
                if size > MAX_LUT_BYTES:
                    raise ValueError(f"{size} bytes are no display transform")
                lut = np.asarray(data["lut"], dtype=np.float32)
                self.maximum, self.k = float(data["max"]), float(data["k"])
        except NPZ_ERRORS as error:
            raise DamagedFile(path, f"not a display transform: {error}") from None
        if lut.ndim != 4 or lut.shape[3] != 3 or len(set(lut.shape[:3])) != 1 or lut.shape[0] < 2:
            raise DamagedFile(path, f"lut has shape {lut.shape}, expected [N, N, N, 3]")
        if not np.isfinite(lut).all() or not (self.maximum > 0 and self.k > 0):
            raise DamagedFile(path, "lut, max or k is not finite and positive")
        # [1, 3, r, g, b] for grid_sample, whose coordinates run (x, y, z) = (b, g, r).
        self.lut = torch.from_numpy(np.ascontiguousarray(lut.transpose(3, 0, 1, 2)))[None]

    def __call__(self, radiance: Tensor) -> Tensor:
        """Linear Rec.709 radiance [..., 3, H, W] -> display RGB in [0, 1], same shape, float32."""
        x = at_least_float32(radiance)
        x = x * self.scale if self.scale != 1.0 else x
        shown = srgb_oetf(x) if self.lut is None else self._look_up(x)
        if self.inverse_gamma == 1.0:
            return shown
        chord = shown * GAMMA_FLOOR ** (self.inverse_gamma - 1.0)
        return torch.where(shown < GAMMA_FLOOR, chord, shown.clamp_min(GAMMA_FLOOR) ** self.inverse_gamma)

    def _look_up(self, x: Tensor) -> Tensor:
        """Trilinear look-up; node coordinate t = log2(1 + k x) / log2(1 + k max) per channel."""
        assert self.lut is not None
        t = torch.log2(1 + self.k * x.clamp(0.0, self.maximum)) / float(np.log2(1 + self.k * self.maximum))
        flat = t.reshape(-1, 3, t.shape[-2] * t.shape[-1])
        grid = (2 * flat - 1).flip(1).permute(0, 2, 1).reshape(1, 1, 1, -1, 3)
        sampled = F.grid_sample(self.lut.to(x), grid, align_corners=True, padding_mode="border")
        return sampled.reshape(3, flat.shape[0], -1).transpose(0, 1).reshape(x.shape).clamp(0.0, 1.0)

    def over_white(self, premultiplied: Tensor, alpha: Tensor) -> Tensor:
        """Premultiplied linear RGB [..., 3, H, W] and alpha [..., 1, H, W] -> display RGB over white.

        c = display(rgb / alpha) · alpha + (1 − alpha): un-premultiply, display transform, then composite
        in display space. NeRF-Synthetic's PNGs are composed so (8-bit straight RGBA over white).
        """
        cover = at_least_float32(alpha).clamp(0.0, 1.0)
        straight = at_least_float32(premultiplied) / cover.clamp_min(ALPHA_FLOOR)
        return self(straight) * cover + (1.0 - cover)
