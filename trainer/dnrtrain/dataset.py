"""Pass and image files -> tensors in memory, batches and augmentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from .contract import (
    BASE_CHANNELS,
    FRESH_CHANNELS,
    RASTER_CHANNELS,
    RAW_CHANNELS,
    ContractError,
    DamagedFile,
    SceneFrame,
    View,
    require_channels,
)
from .display import ALPHA_FLOOR, Display, DisplayTransform
from .exr import read_exr

INPUT_CHANNELS = ("depth.Z", "normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "mask", "coverage")
Base = Literal["none", "raster", "baked", "direct", "path"]
DIHEDRAL_ORDER = 8  # four quarter turns, each mirrored or not


@dataclass(frozen=True)
class Batch:
    """Some views, all of one size. Tensors are float32.

    uv        [N, 2, H, W] atlas coordinates mapped to grid_sample's [-1, 1]; x = U, y = V (row 0 is V = 0)
    depth     [N, 1, H, W] (planar depth − near) / (far − near), clamped to [0, 1]
    normal    [N, 3, H, W] world-space unit shading normal, 0 outside the mask
    mask      [N, 1, H, W] 1 where the pixel's centre hits a surface
    coverage  [N, 1, H, W] fraction of the pixel's area that surfaces cover
    view_dir  [N, 3, H, W] world-space unit vector from the surface towards the camera
    target    [N, 3, H, W] display RGB over white, or None
    camera_normal  [N, 3, H, W] ``normal`` along the camera's axes: right, up, backwards

    Only where a base image was loaded, else None; the base file's channels (see `dnrtrain.contract`):

    base          [N, 3, H, W] linear Rec.709 radiance, straight (un-premultiplied)
    diffuse       [N, 3, H, W] its diffuse part, straight
    albedo        [N, 3, H, W] diffuse reflectance, straight
    noise         [N, 1, H, W] standard error of the luminance of ``base``, straight
    rays          [N, 1, H, W] rays per pixel of ``base``
    chain_uv      [N, 2, H, W] atlas coordinates at the end of the specular path, as ``uv``
    chain_mask    [N, 1, H, W] 1 where the specular path ends on a surface
    chain_weight  [N, 1, H, W] its throughput in [0, 1]
    fresh         [N, 3, H, W] where ``base`` is denoised or remembers earlier frames: as the frame saw it
    fresh_rays    [N, 1, H, W] its rays per pixel
    display       the scene's display transform (linear -> display RGB)
    """

    uv: Tensor
    depth: Tensor
    normal: Tensor
    mask: Tensor
    coverage: Tensor
    view_dir: Tensor
    target: Tensor | None = None
    camera_normal: Tensor | None = None
    base: Tensor | None = None
    diffuse: Tensor | None = None
    albedo: Tensor | None = None
    noise: Tensor | None = None
    rays: Tensor | None = None
    chain_uv: Tensor | None = None
    chain_mask: Tensor | None = None
    chain_weight: Tensor | None = None
    fresh: Tensor | None = None
    fresh_rays: Tensor | None = None
    display: Display | None = None

    def to(self, device: torch.device | str) -> Batch:
        return self._map(lambda tensor: tensor.to(device))

    def crop(self, top: int, left: int, side: int) -> Batch:
        """The window of ``side`` pixels whose first pixel is (``top``, ``left``), of all maps and the target alike."""
        return self.window(slice(top, top + side), slice(left, left + side))

    def window(self, rows: slice, columns: slice) -> Batch:
        """Those rows and columns of all maps and the target alike, without a copy."""
        return self._map(lambda tensor: tensor[..., rows, columns])

    def augment(self, element: int) -> Batch:
        """Apply one of the eight symmetries of the square, inputs and target alike.

        ``element % 4`` quarter turns, mirrored when ``element >= 4``; 0 changes nothing. UVs, normals and
        view directions are *moved*, never rotated in value: they are atlas and world coordinates, which
        do not depend on how the picture lies on the screen. Only the normal in camera space turns with it. The
        renderer learns screen-space filters, and those must not depend on it; this augmentation teaches that.
        """

        def turn(tensor: Tensor) -> Tensor:
            turned = torch.rot90(tensor, element % 4, dims=(-2, -1))
            return (turned.flip(-1) if element >= 4 else turned).contiguous()

        if element == 0:
            return self
        turned = self._map(turn)
        if turned.camera_normal is None:
            return turned
        right, up, back = turned.camera_normal.unbind(dim=1)
        for _ in range(element % 4):  # anticlockwise on the screen
            right, up = -up, right
        return replace(turned, camera_normal=torch.stack([-right if element >= 4 else right, up, back], dim=1))

    def _map(self, function) -> Batch:  # type: ignore[no-untyped-def]
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{k: function(v) for k, v in values.items() if isinstance(v, Tensor)})


@dataclass(frozen=True)
class ViewSet:
    """Views of one size in memory: their names, camera-to-world matrices and tensors (see Batch)."""

    names: tuple[str, ...]
    c2w: np.ndarray
    """float64 [N, 4, 4]"""
    tensors: Batch

    def __len__(self) -> int:
        return len(self.names)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        height, width = self.tensors.mask.shape[-2:]
        return int(height), int(width)

    @property
    def camera_positions(self) -> np.ndarray:
        """Camera centres, world space, float64 [N, 3]."""
        return self.c2w[:, :3, 3]

    @property
    def camera_directions(self) -> np.ndarray:
        """Unit viewing directions (camera −Z), world space, float64 [N, 3]."""
        return -self.c2w[:, :3, 2]

    def index(self, name: str) -> int:
        """Index of a view by name. Raises ContractError for an unknown one."""
        try:
            return self.names.index(name)
        except ValueError:
            raise ContractError(f"view '{name}' is not loaded; known: {', '.join(self.names[:8])} …") from None

    def batch(self, indices: Sequence[int]) -> Batch:
        """The views at ``indices`` as one batch (a copy, or a view of memory for a single index)."""
        if len(indices) == 1:
            start = indices[0]
            return self.tensors._map(lambda tensor: tensor[start : start + 1])
        chosen = torch.as_tensor(list(indices), device=self.tensors.mask.device)
        return self.tensors._map(lambda tensor: tensor.index_select(0, chosen))

    def subset(self, indices: Sequence[int]) -> ViewSet:
        """A ViewSet of the views at ``indices``, in that order."""
        return ViewSet(tuple(self.names[i] for i in indices), self.c2w[list(indices)], self.batch(indices))

    def to(self, device: torch.device | str) -> ViewSet:
        return replace(self, tensors=self.tensors.to(device))


def load_views(
    pass_files: Sequence[Path],
    image_files: Sequence[Path] | None,
    frame: SceneFrame,
    *,
    cameras: Sequence[View],
    folder: Path,
    target: bool = True,
    raw: bool = False,
    base: Base = "none",
    base_files: Sequence[Path] | None = None,
) -> ViewSet:
    """Read views from EXR files in the contract's format.

    Args:
        pass_files: one file per view (G-buffer, coverage, perhaps raster colour).
        image_files: ray-traced files that serve as targets, or None: the raster colour of the pass files.
        frame: near/far and display transform; ``folder`` is where its LUT lies.
        cameras: the views, same order as the files; they give names and view directions.
        target: False leaves the target None (inference on novel views).
        raw: targets as they were traced, where the files hold denoised ones.
        base: the base image (``ModelSettings.base``). raster: the raster colour of the pass files plays its part,
            all of it diffuse, without albedo and specular path; the other kinds are read from ``base_files``.
        base_files: one file per view; wanted exactly when ``base`` is neither none nor raster.

    Raises:
        ContractError: counts differ, files missing or damaged, channels missing, mixed resolutions,
            not finite, near >= far, no views.
    """
    if (base in ("baked", "direct", "path")) != (base_files is not None):
        raise ContractError(f"base image '{base}' with {'no ' if base_files is None else ''}base files: must agree")

    if not pass_files:
        raise ContractError("no views to load; run `dnrpipe prepare` first")
    if len(pass_files) != len(cameras) or (image_files is not None and len(image_files) != len(pass_files)):
        count = "none" if image_files is None else len(image_files)
        raise ContractError(f"{len(cameras)} cameras, {len(pass_files)} pass files, {count} images: must agree")
    if base_files is not None and len(base_files) != len(pass_files):
        raise ContractError(f"{len(pass_files)} pass files, {len(base_files)} base files: must agree")
    if frame.near >= frame.far:
        raise ContractError(f"frame.json: near {frame.near} is not below far {frame.far}; run `dnrpipe prepare` again")
    display = DisplayTransform(frame, folder)
    size = (cameras[0].height, cameras[0].width)
    found: list[dict[str, Tensor]] = []
    for index, (pass_file, camera) in enumerate(zip(pass_files, cameras, strict=True)):
        channels, _ = read_exr(pass_file)
        raster = base == "raster" or (target and image_files is None)
        require_channels(pass_file, channels, (*INPUT_CHANNELS, *(RASTER_CHANNELS if raster else ())))
        _check_size(pass_file, channels, size, camera)
        maps = _input_maps(pass_file, channels, frame, camera, base)
        found.append(maps)
        if base_files is not None:
            base_file = base_files[index]
            base_channels, _ = read_exr(base_file)
            require_channels(base_file, base_channels, BASE_CHANNELS, "delete it and run the stage again")
            _check_size(base_file, base_channels, size, camera)
            maps |= _base_maps(base_file, base_channels)
        if not target:
            continue
        image_file, names = pass_file, RASTER_CHANNELS
        if image_files is not None:
            image_file = image_files[index]
            channels, _ = read_exr(image_file)
            names = RAW_CHANNELS if raw and RAW_CHANNELS[0] in channels else RASTER_CHANNELS
            require_channels(image_file, channels, names)
            _check_size(image_file, channels, size, camera)
        colour = _stack(image_file, channels, names)
        maps["target"] = display.over_white(colour[:3], colour[3:])
    return _view_set(found, cameras, None if base == "none" else display)


def view_in_memory(
    channels: dict[str, np.ndarray], frame: SceneFrame, camera: View, *, display: DisplayTransform, base: Base = "none"
) -> ViewSet:
    """One view for inference, from the channels that its pass file (and base file) would hold, float32 [H, W].

    display: of ``frame``; shared between calls. base: as of `load_views`; with a rendered kind ``channels`` hold
    the base image, too. Raises ContractError: channels missing, of another size than the camera, not finite.
    """
    source = Path(f"view {camera.name}")
    wanted = (*INPUT_CHANNELS, *(RASTER_CHANNELS if base == "raster" else ()))
    rendered = base in ("baked", "direct", "path")
    require_channels(source, channels, (*wanted, *(BASE_CHANNELS if rendered else ())))
    _check_size(source, channels, (camera.height, camera.width), camera)
    maps = _input_maps(source, channels, frame, camera, base)
    if rendered:
        maps |= _base_maps(source, channels)
    return _view_set([maps], [camera], None if base == "none" else display)


def _view_set(maps: Sequence[dict[str, Tensor]], cameras: Sequence[View], display: DisplayTransform | None) -> ViewSet:
    """The maps of each view, [C, H, W], as one set; ``maps`` is emptied."""
    # One map after the other: no more than the largest of them is in memory twice.
    tensors = {name: torch.stack([view.pop(name) for view in maps]) for name in list(maps[0])}
    batch = Batch(**tensors, display=display)
    return ViewSet(tuple(c.name for c in cameras), np.stack([c.matrix for c in cameras]), batch)


def _input_maps(
    path: Path, channels: dict[str, np.ndarray], frame: SceneFrame, camera: View, base: Base
) -> dict[str, Tensor]:
    """The maps of `Batch` that pass files hold, [C, H, W]; the base image where that is the raster colour."""
    inputs = _stack(path, channels, INPUT_CHANNELS)
    mask = (inputs[6:7] > 0.5).float()
    depth = ((inputs[0:1] - frame.near) / (frame.far - frame.near)).clamp(0.0, 1.0)
    normal = inputs[1:4] * mask
    maps = {
        "depth": depth * mask,
        "normal": normal,
        "camera_normal": in_camera_space(normal, camera),
        "uv": (2.0 * inputs[4:6] - 1.0) * mask,
        "mask": mask,
        "coverage": inputs[7:8].clamp(0.0, 1.0),
        "view_dir": torch.from_numpy(-camera.ray_directions()).permute(2, 0, 1).contiguous(),
    }
    if base == "raster":
        colour = _stack(path, channels, RASTER_CHANNELS)
        maps["base"] = _straight(colour[:3], colour[3:])
    return maps


def in_camera_space(vectors: Tensor, camera: View) -> Tensor:
    """World-space vectors [3, H, W] along the camera's axes: right, up, backwards."""
    rotation = torch.from_numpy(camera.matrix[:3, :3].T.astype(np.float32))
    return torch.einsum("ij,jhw->ihw", rotation, vectors).contiguous()


def _base_maps(path: Path, channels: dict[str, np.ndarray]) -> dict[str, Tensor]:
    """The maps of `Batch` that base files hold, [C, H, W]."""
    values = _stack(path, channels, BASE_CHANNELS)
    alpha, mask = values[3:4], (values[14:15] > 0.5).float()
    fresh = {}
    if FRESH_CHANNELS[0] in channels:
        own = _stack(path, channels, FRESH_CHANNELS)
        fresh = {"fresh": _straight(own[:3], alpha), "fresh_rays": own[3:].clamp_min(1.0)}
    return {
        **fresh,
        "base": _straight(values[0:3], alpha),
        "diffuse": _straight(values[4:7], alpha),
        "albedo": _straight(values[7:10], alpha),
        "noise": _straight(values[10:11], alpha),
        "rays": values[11:12].clamp_min(1.0),
        "chain_uv": (2.0 * values[12:14] - 1.0) * mask,
        "chain_mask": mask,
        "chain_weight": values[15:16].clamp(0.0, 1.0) * mask,
    }


def _straight(premultiplied: Tensor, alpha: Tensor) -> Tensor:
    return premultiplied / alpha.clamp(ALPHA_FLOOR, 1.0)


def _stack(path: Path, channels: dict[str, np.ndarray], names: Sequence[str]) -> Tensor:
    values = np.stack([channels[name] for name in names]).astype(np.float32, copy=False)
    if not np.isfinite(values).all():
        raise DamagedFile(path, "has non-finite values")
    return torch.from_numpy(values)


def _check_size(path: Path, channels: dict[str, np.ndarray], size: tuple[int, int], camera: View) -> None:
    found = next(iter(channels.values())).shape
    wanted = (camera.height, camera.width)
    if found != wanted:
        raise ContractError(
            f"{path}: is {found[1]}x{found[0]}, its camera {wanted[1]}x{wanted[0]}; delete it and run the stage again"
        )
    if wanted != size:
        raise ContractError(
            f"{path}: is {found[1]}x{found[0]}, the first view {size[1]}x{size[0]}; all views need one resolution"
        )
