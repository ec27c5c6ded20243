"""The data contract between the pipeline and the trainer: views, channels, frames, units.

Notation
    world    Blender's: right-handed, Z up, scene units as in the file
    camera   OpenGL's: +X right, +Y up, -Z forward
    c2w      camera-to-world, row-major 4x4
    pixel    (0, 0) is top left; centres at half integers; (cx, cy) in pixels from the top left corner
    EXR      float32; R G B A is linear Rec.709 radiance with premultiplied alpha

Channels of a passes file (``passes/<split>/<view>.exr``)
    R G B A               rasterised colour (only where the view has one)
    depth.Z               planar depth in scene units, 0 where mask is 0
    normal.X/Y/Z          world-space shading normal, unit; 0 where mask is 0
    uv.U/V                atlas coordinates in [0, 1), V up; 0 where mask is 0
    position.X/Y/Z        world position; 0 where mask is 0
    object.Id             1-based object number (float), 0 = background
    mask                  1 where the ray through the pixel centre hits a surface, else 0
    coverage              fraction of the pixel's area that surfaces cover, in [0, 1] (box filter)
All but R G B A and coverage are sampled at the pixel centre, never filtered.

Channels of a ray-traced file (``raytraced/<split>/<view>.exr``)
    R G B A               linear Rec.709 radiance, premultiplied, box filter, transparent background

Channels of a base file (``base/<split>/<view>.exr``): a cheap image of the same view, which the network corrects
    base.R/G/B/A          linear Rec.709 radiance, premultiplied, box filter
    diffuse.R/G/B         the part of base that is diffuse reflection or emission, premultiplied
    albedo.R/G/B          diffuse reflectance, mean over the pixel, premultiplied
    noise                 standard error of the luminance of baked light and specular paths, by the spread of the
                          pixel's rays; 0 with one ray
    rays                  rays per pixel of baked light and specular paths
    chain.U/V             atlas coordinates in [0, 1), V up, of the first rough surface that the mirror and
                          refraction path through the pixel centre meets; 0 where there is none
    chain.mask            1 where there is one, else 0
    chain.weight          throughput of that path, mean over colours, in [0, 1]; 0 where there is none
    fresh.R/G/B, fresh.rays   only where base is denoised or remembers earlier frames: base, premultiplied by the same
                          base.A, and rays of this frame by itself, with its grain
"""

from __future__ import annotations

import json
import math
import re
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, field_validator

from .atomic import write_json
from .text import one_line

RASTER_CHANNELS = ("R", "G", "B", "A")
RAW_CHANNELS = ("raw.R", "raw.G", "raw.B", "A")
"""Of a ray-traced file whose colour is denoised: what was traced."""
GBUFFER_CHANNELS = (
    *("depth.Z", "normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V"),
    *("position.X", "position.Y", "position.Z", "object.Id", "mask", "coverage"),
)
BASE_CHANNELS = (
    *("base.R", "base.G", "base.B", "base.A"),
    *("diffuse.R", "diffuse.G", "diffuse.B"),
    *("albedo.R", "albedo.G", "albedo.B", "noise", "rays"),
    *("chain.U", "chain.V", "chain.mask", "chain.weight"),
)
FRESH_CHANNELS = ("fresh.R", "fresh.G", "fresh.B", "fresh.rays")
SPLITS = ("train", "val", "test")


NPZ_ERRORS = (
    *(OSError, ValueError, KeyError, TypeError, EOFError, MemoryError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
    *(SyntaxError, tokenize.TokenError, AttributeError),
)
"""What reading a damaged npz file may raise: numpy passes zip's and deflate's own errors through, and those of Python's
parser on an array's header; an array without one is bytes, which lack an array's methods."""


class ContractError(ValueError):
    """Input that breaks the data contract; the message names what, where and what to do, in one line."""

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())


class DamagedFile(ContractError):
    """A file that a stage wrote does not read, or not as it was written. ``path`` is the file.

    The pipeline makes such a file again. The message is for programs that only read it.
    """

    def __init__(self, path: Path | str, reason: str) -> None:
        self.path, self.reason = Path(path), one_line(reason)
        super().__init__(f"{path}: damaged ({self.reason}); delete it and run its stage again")


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("must be finite")
    return value


Finite = Annotated[float, AfterValidator(_finite)]


class View(BaseModel, extra="forbid", frozen=True):
    """One pinhole camera. Lengths in pixels (intrinsics) and scene units (c2w).

    ``name`` is unique within its split and is the stem of its files.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    width: int = Field(ge=1, le=16384)
    height: int = Field(ge=1, le=16384)
    fl_x: Finite = Field(gt=0)
    fl_y: Finite = Field(gt=0)
    cx: Finite
    cy: Finite
    c2w: tuple[tuple[float, ...], ...]

    @field_validator("c2w")
    @classmethod
    def _rigid(cls, value: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        matrix = np.asarray(value, dtype=np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"transform must be 4x4, is {matrix.shape}")
        if not np.isfinite(matrix).all():
            raise ValueError("transform contains NaN or infinity")
        rotation = matrix[:3, :3]
        large = np.abs(rotation).max() > 2  # their products may overflow
        if large or not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
            raise ValueError("transform is not a rotation and a translation (scaled, sheared or mirrored)")
        return value

    @property
    def matrix(self) -> np.ndarray:
        """Camera-to-world as float64 [4, 4]."""
        return np.asarray(self.c2w, dtype=np.float64)

    @property
    def position(self) -> np.ndarray:
        """Camera centre in world space, float64 [3]."""
        return self.matrix[:3, 3]

    @property
    def intrinsics(self) -> dict[str, float]:
        """Width, height, focal lengths and principal point in pixels, by the names of a ``transforms`` file."""
        return {"w": self.width, "h": self.height, **self.model_dump(include={"fl_x", "fl_y", "cx", "cy"})}

    def ray_directions(self) -> np.ndarray:
        """Unit world-space directions from the camera through pixel centres, float32 [H, W, 3]."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fl_x
        y = -(np.arange(self.height) + 0.5 - self.cy) / self.fl_y
        grid_x, grid_y = np.meshgrid(x, y)
        camera = np.stack([grid_x, grid_y, -np.ones_like(grid_x)], axis=-1)
        world = camera @ self.matrix[:3, :3].T
        return (world / np.linalg.norm(world, axis=-1, keepdims=True)).astype(np.float32)


def write_cameras(path: Path, views: Sequence[View], split: str) -> None:
    """Write views as a NeRF ``transforms`` file with per-frame intrinsics, atomically."""
    frames = [
        {"file_path": f"{split}/{view.name}", **view.intrinsics, "transform_matrix": [list(row) for row in view.c2w]}
        for view in views
    ]
    write_json(path, {"camera_model": "OPENCV", "frames": frames})


def read_cameras(path: Path) -> list[View]:
    """Read a ``transforms`` file that `write_cameras` wrote; it may hold no view.

    Raises ContractError when it is missing, DamagedFile when it does not read.
    """
    try:
        return parse_transforms(path, may_be_empty=True)
    except ContractError as error:
        if not Path(path).is_file():
            raise
        raise DamagedFile(path, str(error).removeprefix(f"{path}: ")) from None


def parse_transforms(
    path: Path, default_size: tuple[int, int] | None = None, *, may_be_empty: bool = False
) -> list[View]:
    """Read views from any NeRF / nerfstudio / instant-ngp ``transforms.json``.

    Intrinsics may stand per frame or once per file: ``fl_x``/``fl_y``, or ``camera_angle_x``/``_y``
    (radians); ``cx``/``cy`` default to the image centre; ``w``/``h`` default to ``default_size``
    (width, height). When the file gives a size and ``default_size`` differs, the file wins.

    Raises:
        ContractError: not JSON, no frames, NaN, missing intrinsics, lens distortion, not a rigid pose.
    """
    try:
        data: Any = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ContractError(f"{path}: no such camera file") from None
    except (ValueError, RecursionError) as error:  # also: not UTF-8, numbers of thousands of digits
        raise ContractError(f"{path}: not a JSON camera file ({error})") from None
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not (frames or may_be_empty):
        raise ContractError(f"{path}: has no 'frames'; expected a NeRF transforms.json")
    views: list[View] = []
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise ContractError(f"{path}: frame {index}: has no 'transform_matrix'")
        try:
            views.append(_parse_frame(frame, data, index, default_size))
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            reason = str(error).replace("\n", " ")
            if hasattr(error, "errors"):
                reason = "; ".join(e["msg"].removeprefix("Value error, ") for e in error.errors())  # type: ignore[attr-defined]
            raise ContractError(f"{path}: frame {index}: {reason}") from None
    return unique_names(views)


def unique_names(views: Sequence[View]) -> list[View]:
    """Add a number to names that occur more than once: ``a``, ``a-2``, ``a-3``. Files are named after views."""
    taken: set[str] = set()
    result = []
    for view in views:
        name, number = view.name, 1
        while name in taken:
            number += 1
            name = f"{view.name}-{number}"
        taken.add(name)
        result.append(view if name == view.name else view.model_copy(update={"name": name}))
    return result


def file_name(text: str) -> str:
    """``text`` as a view's name: at most 80 ASCII letters, digits, dots, dashes, underscores; others become "_".

    A dot at the start becomes "_", too: a file of that name would be hidden.
    """
    return re.sub(r"^\.|[^A-Za-z0-9_.-]", "_", text)[:80] or "_"


def _parse_frame(frame: Any, shared: dict[str, Any], index: int, size: tuple[int, int] | None) -> View:
    def value(key: str) -> float | None:
        found = frame.get(key, shared.get(key))
        return None if found is None else float(found)

    for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
        if value(key):
            raise ValueError(f"lens distortion ({key}) is not supported; undistort the cameras first")
    width, height = value("w"), value("h")
    if width is None or height is None:
        if size is None:
            raise ValueError("has no image size ('w', 'h')")
        width, height = size
    if not (math.isfinite(width) and math.isfinite(height)):
        raise ValueError("image size is not finite")
    angle_x, angle_y = value("camera_angle_x"), value("camera_angle_y")
    fl_x = value("fl_x")
    if fl_x is None:
        if angle_x is None:
            raise ValueError("has no focal length ('fl_x' or 'camera_angle_x')")
        fl_x = _focal(width, angle_x)
    fl_y = value("fl_y")
    if fl_y is None:
        fl_y = _focal(height, angle_y) if angle_y is not None else fl_x
    cx, cy = value("cx"), value("cy")
    name = Path(str(frame.get("file_path") or f"{index:04d}")).name
    stem = name.rsplit(".", 1)[0] if name.lower().endswith((".png", ".jpg", ".jpeg", ".exr")) else name
    matrix = np.asarray(frame["transform_matrix"], dtype=np.float64)
    return View(
        name=file_name(stem),
        width=int(width),
        height=int(height),
        fl_x=fl_x,
        fl_y=fl_y,
        cx=width / 2 if cx is None else cx,
        cy=height / 2 if cy is None else cy,
        c2w=tuple(tuple(float(x) for x in row) for row in matrix),
    )


def _focal(length: float, angle: float) -> float:
    """Focal length in pixels from the image's side and its angle of view in radians."""
    if not 0 < angle < math.pi:
        raise ValueError(f"camera angle {angle:g} is not between 0 and pi (radians)")
    return 0.5 * length / math.tan(0.5 * angle)


class SceneFrame(BaseModel, extra="forbid"):
    """What the trainer must know of the scene beside pixels (``scene/frame.json``).

    near, far: planar depth range, scene units, that normalises depth to [0, 1].
    center, radius: bounding sphere, scene units.
    exposure: stops, applied in linear space before the display transform.
    view_transform: name of the scene's view transform ("Standard", "AgX", ...).
    display_lut: file beside this one with the baked display transform, or None for plain sRGB.
    """

    near: Finite = Field(gt=0)
    far: Finite = Field(gt=0)
    center: tuple[float, float, float]
    radius: Finite = Field(gt=0)
    exposure: Finite = 0.0
    gamma: Finite = 1.0
    view_transform: str = "Standard"
    display_lut: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")


def require_channels(
    path: Path, present: Iterable[str], wanted: Iterable[str], remedy: str = "run `dnrpipe prepare` again"
) -> None:
    """Raise ContractError naming the channels of ``path`` that are missing, and the ``remedy``."""
    missing = sorted(set(wanted) - set(present))
    if missing:
        raise ContractError(f"{path}: channels {', '.join(missing)} are missing; {remedy}")
