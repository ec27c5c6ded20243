"""Images of a scene: reading from Blender, arithmetic on texels, writing into the bundle.

Rows: arrays hold Blender's order, bottom row first. Mitsuba's ``bitmap`` maps v = 0 to the *first* row of a
file, so files are written in array order (they look upside down in a viewer) and UVs stay Blender's.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dnrtrain.srgb import decode, encode

from ..bundle import xmltree
from ..findings import Findings
from .image_files import HALF_MAX, write_colour_exr, write_png

MISSING_COLOUR = (1.0, 0.0, 1.0)
"""What Blender shows for an image that cannot be read."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
"""Rec.709 luminance, as Cycles' linear_rgb_to_gray in a Rec.709 working space."""


@dataclass(frozen=True)
class Constant:
    """A socket without texture: scene-linear colour (scalars repeat)."""

    rgb: tuple[float, float, float]

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.rgb, dtype=np.float32)

    @property
    def scalar(self) -> float:
        return float(self.mean @ LUMINANCE)


@dataclass(frozen=True)
class Placement:
    """How an image lies on a surface.

    uv: name of the UV layer, None for the mesh's render-active one.
    to_uv: 3x3 affine map from that layer's coordinates to image coordinates, row-major.
    region: the texels are those of this material's region of the scene atlas, [N, 1, C] (see `baking.regions`).
    corners: the texels are a colour attribute's values at the material's stacked corners, [M, 1, C].
    """

    uv: str | None = None
    to_uv: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    filter: Literal["bilinear", "nearest"] = "bilinear"
    wrap: Literal["repeat", "clamp", "mirror"] = "repeat"
    region: str | None = None
    corners: str | None = None

    @property
    def plain(self) -> bool:
        """An image of its own, placed by a UV layer."""
        return self.region is None and self.corners is None


@dataclass(frozen=True, eq=False)
class Textured:
    """Texels [H, W, 1 or 3], bottom row first: uint8 (``srgb`` encoded or linear) or float32 (linear)."""

    texels: np.ndarray
    srgb: bool
    placement: Placement

    def linear(self) -> np.ndarray:
        """Texels as float32, linear."""
        if self.texels.dtype != np.uint8:
            return self.texels
        codes = np.arange(256, dtype=np.float32) / 255
        return (srgb_to_linear(codes) if self.srgb else codes)[self.texels]

    @property
    def mean(self) -> np.ndarray:
        """Mean linear colour, float32 [3]."""
        average = self.linear().mean(axis=(0, 1))
        return np.broadcast_to(average, (3,)).astype(np.float32)

    @property
    def scalar(self) -> float:
        return float(self.mean @ LUMINANCE)

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> Textured:
        """Apply ``change`` to the linear texels; 8-bit images stay 8-bit while the result fits in [0, 1]."""
        result = np.asarray(change(self.linear()), dtype=np.float32)
        if self.texels.dtype == np.uint8 and result.min() >= 0 and result.max() <= 1:
            coded = linear_to_srgb(result) if self.srgb else result
            return replace(self, texels=np.round(coded * 255).astype(np.uint8))
        return replace(self, texels=result, srgb=False)

    def grey(self) -> Textured:
        """One channel: luminance, as Blender converts a colour for a scalar socket."""
        if self.texels.shape[2] == 1:
            return self
        if (self.texels == self.texels[..., :1]).all():
            return replace(self, texels=self.texels[..., :1])
        if not self.srgb:
            return self.map(lambda rgb: (rgb @ LUMINANCE)[..., None])
        return replace(self, texels=(self.linear() @ LUMINANCE)[..., None], srgb=False)


Value = Constant | Textured


def constant(value: Any) -> Constant:
    """Constant from a number, or from a sequence whose first three entries count."""
    if isinstance(value, int | float | np.floating):
        number = float(value)
        return Constant((number, number, number))
    x, y, z = (float(v) for v in list(value)[:3])
    return Constant((x, y, z))


def scale(value: Value, factor: np.ndarray | float) -> Value:
    """Multiply by a number or a linear colour."""
    if isinstance(value, Constant):
        return constant(value.mean * np.asarray(factor, dtype=np.float32))
    if np.allclose(factor, 1.0, atol=1e-6):
        return value
    return value.map(lambda texels: texels * np.asarray(factor, dtype=np.float32))


def srgb_to_linear(x: np.ndarray) -> np.ndarray:
    """sRGB code values -> linear light, float32."""
    return decode(x).astype(np.float32)


def linear_to_srgb(x: np.ndarray) -> np.ndarray:
    """Linear light -> sRGB code values, float32."""
    return encode(x).astype(np.float32)


@dataclass
class ImageReader:
    """Reads each Blender image once."""

    findings: Findings
    _cache: dict[str, tuple[np.ndarray, bool] | None] = field(default_factory=dict)

    def read(self, image: Any, material: str | None) -> tuple[np.ndarray, bool]:
        """Texels [H, W, 4] (uint8 or float32 scene-linear, straight alpha) and whether they are sRGB encoded.

        An image that cannot be read becomes one magenta texel, with a finding ``missing``.
        """
        key = image.name_full
        if key not in self._cache:
            self._cache[key] = self._load(image, material)
        loaded = self._cache[key]
        if loaded is None:
            self.findings.add(
                "missing",
                f"image '{image.name}'",
                f"cannot read '{image.filepath or image.name}'; magenta stands for it",
                material=material,
            )
            return np.array([[[*MISSING_COLOUR, 1.0]]], dtype=np.float32), False
        return loaded

    def _load(self, image: Any, material: str | None) -> tuple[np.ndarray, bool] | None:
        if image.source == "TILED":
            tiles = [tile.number for tile in image.tiles]
            if tiles != [1001]:
                self.findings.add(
                    "approximated",
                    f"UDIM image '{image.name}'",
                    f"only tile 1001 of {len(tiles)} is used",
                    material=material,
                )
        elif image.source in {"MOVIE", "SEQUENCE"}:
            self.findings.add("approximated", f"animated image '{image.name}'", "one frame is used", material=material)
        if not image.has_data:
            # Reading pixels loads the file; without one the size stays 0.
            len(image.pixels)
        width, height = image.size
        if width == 0 or height == 0 or len(image.pixels) == 0:
            return None
        channels = image.channels
        flat = np.empty(width * height * channels, dtype=np.float32)
        image.pixels.foreach_get(flat)
        texels = _to_rgba(flat.reshape(height, width, channels))
        space = image.colorspace_settings.name
        if image.is_float:
            # Blender hands float images over in the scene's linear space.
            return finite_texels(texels, f"image '{image.name}'", self.findings), False
        codes = np.round(np.clip(texels, 0, 1) * 255).astype(np.uint8)
        if space == "sRGB":
            return codes, True
        if not (image.colorspace_settings.is_data or space.startswith("Linear Rec.709")):
            from .colour_spaces import decode

            return decode(codes, space), False
        return codes, False


def _to_rgba(texels: np.ndarray) -> np.ndarray:
    height, width, channels = texels.shape
    if channels == 4:
        return texels
    out = np.ones((height, width, 4), dtype=np.float32)
    out[..., :3] = texels[..., :3] if channels == 3 else texels[..., :1]
    if channels == 2:
        out[..., 3] = texels[..., 1]
    return out


def finite_texels(texels: np.ndarray, label: str, findings: Findings) -> np.ndarray:
    """``texels`` [H, W, C] with NaN and -inf as 0 and +inf as HALF_MAX; a finding counts the texels."""
    bad = ~np.isfinite(texels).all(axis=-1)
    if not bad.any():
        return texels
    note = f"repaired: {int(bad.sum())} texels that are not finite; black stands for NaN, {HALF_MAX:.0f} for infinity"
    findings.add("approximated", label, note)
    return np.nan_to_num(texels, nan=0.0, posinf=HALF_MAX, neginf=0.0)


@dataclass
class TextureStore:
    """Writes textures of the bundle, each content once, and makes the elements that refer to them.

    made: folder of another bundle, whose files are taken where they hold the same; coding pictures takes seconds.
    """

    scene_dir: Path
    made: Path | None = None
    _written: dict[str, str] = field(default_factory=dict)

    def element(self, value: Textured, name: str, label: str, *, raw: bool = False) -> ET.Element:
        """``<texture type="bitmap">`` for ``value`` (Mitsuba plugin doc: bitmap).

        The value must be an image of its own (``placement.plain``). label: readable start of the file name. raw: the
        texels are data, not colour (no range check).
        """
        element = xmltree.plugin("texture", "bitmap", name=name)
        xmltree.text(element, "filename", self.save(value.texels, value.srgb, label))
        if value.placement.filter != "bilinear":
            xmltree.text(element, "filter_type", value.placement.filter)
        if value.placement.wrap != "repeat":
            xmltree.text(element, "wrap_mode", value.placement.wrap)
        # Only 8-bit sRGB files need Mitsuba's decoding; anything else holds the values themselves.
        xmltree.flag(element, "raw", raw or not value.srgb)
        affine = np.asarray(value.placement.to_uv, dtype=np.float64)
        if not np.allclose(affine, np.eye(3)):
            full = np.eye(4)  # Mitsuba reduces it to a planar map, whose translation is in the last column
            full[:2, :2], full[:2, 3] = affine[:2, :2], affine[:2, 2]
            xmltree.matrix(element, "to_uv", full)
        return element

    def save(self, texels: np.ndarray, srgb: bool, label: str) -> str:
        """Write texels [H, W, C] in array order and return the path relative to the bundle."""
        texels = np.ascontiguousarray(texels)
        digest = hashlib.sha256(texels.tobytes())
        digest.update(repr((texels.shape, texels.dtype.str)).encode())
        key = digest.hexdigest()
        if key not in self._written:
            suffix = ".png" if texels.dtype == np.uint8 else ".exr"
            relative = f"textures/{xmltree.safe_name(label)}-{key[:10]}{suffix}"
            path = self.scene_dir / relative
            if self.made is None or not _taken(self.made / relative, path):
                write_png(path, texels) if texels.dtype == np.uint8 else write_colour_exr(path, texels)
            self._written[key] = relative
        return self._written[key]


def _taken(made: Path, path: Path) -> bool:
    """Put a file that is there already at ``path`` too, without a copy where the disk can; False: it is not there."""
    if not made.is_file():
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    try:
        os.link(made, path)
    except OSError:
        shutil.copyfile(made, path)
    return True
