"""A trained renderer as one ONNX file: network, neural textures and display transform, no torch needed to run it.

The graph computes what `model.DNR` computes, in float32, at any height and width, one view at a time. Texture
look-ups run over the whole picture instead of over the pixels inside the mask, since a graph with as many points as
the mask has pixels would have no fixed shapes; what lies outside is multiplied by zero.

Inputs are the channels of the EXR files (see `contract`), float32 [1, C, H, W], those only that the model uses:

    uv         [1, 2] atlas coordinates U, V in [0, 1), V up; 0 where mask is 0
    mask       [1, 1] 1 where the ray through the pixel's centre hits a surface
    coverage   [1, 1] fraction of the pixel that surfaces cover
    view_dir   [1, 3] unit, world space, from the surface to the camera, in every pixel
    normal     [1, 3] unit, world space, towards the camera; 0 where mask is 0
    camera_normal  [1, 3] the same along the camera's axes: right, up, backwards
    depth      [1, 1] planar depth in scene units
    base       [1, 4] base.R/G/B/A, linear Rec.709, premultiplied
    diffuse    [1, 3] diffuse.R/G/B, premultiplied
    albedo     [1, 3] albedo.R/G/B, premultiplied
    noise      [1, 1] noise, premultiplied
    rays       [1, 1] rays per pixel of the base image
    fresh      [1, 4] fresh.R/G/B, premultiplied, and fresh.rays; of files without them base.R/G/B and rays
    chain      [1, 4] chain.U, chain.V, chain.mask, chain.weight

Outputs: ``rgb`` [1, 3, H, W], display space over white, in [0, 1]; where the model works in log space also
``radiance`` [1, 3, H, W], linear Rec.709, straight.
"""

from __future__ import annotations

import functools
import io
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .atomic import atomic_path
from .contract import FRESH_CHANNELS, ContractError, SceneFrame, View
from .correction import correct, guide_maps
from .dataset import Batch, in_camera_space
from .display import ALPHA_FLOOR, DisplayTransform
from .model import DNR, compose
from .settings import ModelSettings
from .text import one_line
from .textures import SH_COUNT, SH_FIRST_CHANNEL, TexturePyramid, depth_coordinate, octahedral, spherical_harmonics

OPSET = 18
"""onnxruntime has no kernel for the GridSample of opset 20."""
CHANNELS: dict[str, list[str]] = {
    "uv": ["uv.U", "uv.V"],
    "mask": ["mask"],
    "coverage": ["coverage"],
    "normal": [f"normal.{c}" for c in "XYZ"],
    "depth": ["depth.Z"],
    "base": [f"base.{c}" for c in "RGBA"],
    "diffuse": [f"diffuse.{c}" for c in "RGB"],
    "albedo": [f"albedo.{c}" for c in "RGB"],
    "noise": ["noise"],
    "rays": ["rays"],
    "fresh": [*FRESH_CHANNELS],
    "chain": ["chain.U", "chain.V", "chain.mask", "chain.weight"],
}
"""Of the EXR files, by input."""
MADE = {"view_dir": 3, "camera_normal": 3}
"""Inputs that are in no file, and how many channels they have: they follow from the camera."""
EXAMPLE = (48, 40)
"""Height and width that the graph is traced with; the file has none."""
MERGED_VALUES = 16 * 128**2
"""Pyramids whose finest level has no more are merged where the file is loaded, as that part of the graph is constant:
four times the memory, one look-up a pixel."""


def input_names(settings: ModelSettings) -> list[str]:
    """Inputs of the graph, in order."""
    textures = settings.modalities.split("+") if settings.aggregator != "none" else []
    names = [*(["uv"] if "uv" in textures else []), "mask", "coverage"]
    if settings.guides or settings.spherical_harmonics:
        names.append("view_dir")
    if settings.guides or "normal" in textures:
        names.append("normal")
    if "depth" in textures:
        names.append("depth")
    if settings.base != "none":
        names.append("base")
    if settings.guides and settings.base in ("baked", "direct", "path"):
        names += ["diffuse", "albedo"]
    if settings.guides == "camera":
        names += ["camera_normal", "noise", "rays", "fresh"]
    return [*names, "chain"] if settings.chain else names


def output_names(settings: ModelSettings) -> list[str]:
    return ["rgb"] if settings.base == "none" or settings.output == "display" else ["rgb", "radiance"]


def export_onnx(path: Path, model: DNR, frame: SceneFrame, folder: Path, extra: Mapping[str, Any]) -> None:
    """Write ``model`` as ONNX, atomically.

    Args:
        frame, folder: depth range and display transform, which become part of the graph (see DisplayTransform).
        extra: JSON kept in the file's metadata under ``dnrpipe``, beside the model's settings and the opset.

    Raises ContractError: torch cannot express the model (the message says what).
    """
    graph = Graph(model, frame, folder).eval()
    height, width = EXAMPLE
    names, outputs = input_names(model.settings), output_names(model.settings)
    example = tuple(_example(name, height, width) for name in names)
    axes = {name: {2: "height", 3: "width"} for name in (*names, *outputs)}
    buffer = io.BytesIO()
    torch.onnx.register_custom_op_symbolic("aten::expm1", _expm1, OPSET)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter is old, and traced shapes are meant to be traced
        try:
            torch.onnx.export(
                graph,
                example,
                buffer,  # pyright: ignore[reportArgumentType]
                dynamo=False,
                opset_version=OPSET,
                input_names=names,
                output_names=outputs,
                dynamic_axes=axes,
            )
        except torch.onnx.errors.OnnxExporterError as error:
            raise ContractError(f"{path}: torch cannot export this model ({one_line(error)[:200]})") from None
    import onnx

    proto = onnx.load_from_string(buffer.getvalue())
    record = {"model": model.settings.model_dump(mode="json"), "opset": OPSET, **extra}
    onnx.helper.set_model_props(proto, {"dnrpipe": json.dumps(record, sort_keys=True)})
    onnx.checker.check_model(proto, full_check=True)
    with atomic_path(path) as temporary:
        temporary.write_bytes(proto.SerializeToString())


def graph_inputs(channels: Mapping[str, np.ndarray], view: View, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Channels of a view's EXR files, float32 [H, W] each -> the inputs.

    Raises KeyError for a channel that is not there.
    """
    found = {}
    for name in names:
        if name == "view_dir":
            image = -view.ray_directions().transpose(2, 0, 1)
        elif name == "camera_normal":
            normal = torch.from_numpy(np.stack([channels[c] for c in CHANNELS["normal"]]))
            image = in_camera_space(normal, view).numpy()
        elif name == "fresh" and FRESH_CHANNELS[0] not in channels:
            image = np.stack([channels[c] for c in (*CHANNELS["base"][:3], *CHANNELS["rays"])])
        else:
            image = np.stack([channels[c] for c in CHANNELS[name]])
        found[name] = np.ascontiguousarray(image[None], dtype=np.float32)
    return found


class Graph(nn.Module):
    """The model over its whole picture, with the inputs of `input_names`."""

    def __init__(self, model: DNR, frame: SceneFrame, folder: Path) -> None:
        super().__init__()
        self.model = model
        self.settings = model.settings
        self.near, self.range = frame.near, frame.far - frame.near
        self.display = _GatheredDisplay(frame, folder)
        self.names = input_names(model.settings)
        self.knots: dict[int, Tensor] = {}
        """Where small pyramids are bilinear in between (see `TexturePyramid.merged`): [1, height, width, 2] each."""
        for part in model.modules():
            if isinstance(part, TexturePyramid) and part.mergeable and part.levels[0].numel() <= MERGED_VALUES:
                y, x = (torch.linspace(-1.0, 1.0, 2 * side + 1) for side in part.levels[0].shape[-2:])
                self.knots[id(part)] = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)[None]

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        batch = self.batch(dict(zip(self.names, inputs, strict=True)))
        settings = self.settings
        groups = [torch.cat([batch.mask, *guide_maps(batch, settings)], dim=1)]
        if settings.aggregator != "none":
            groups.append(self._texture(batch))
        if settings.chain:
            assert batch.chain_uv is not None and batch.chain_weight is not None
            sampled = self._look_up(self.model.aggregator.texture_uv, batch.chain_uv)
            groups.append(sampled * batch.chain_weight)
        outputs = self.model.renderer(groups, bfloat16=False)
        if settings.base == "none":
            return (compose(outputs, batch.coverage).clamp(0.0, 1.0),)
        rgb, radiance = correct(batch, outputs, settings)
        shown = compose(rgb, batch.coverage).clamp(0.0, 1.0)
        return (shown,) if radiance is None else (shown, radiance)

    def batch(self, maps: dict[str, Tensor]) -> Batch:
        """The inputs as `dataset.load_views` makes them of the same channels."""
        mask = (maps["mask"] > 0.5).float()
        zero = torch.zeros_like(mask)
        parts: dict[str, Tensor] = {}
        if "base" in maps:
            alpha = maps["base"][:, 3:].clamp(ALPHA_FLOOR, 1.0)
            parts["base"] = maps["base"][:, :3] / alpha
            parts |= {name: maps[name] / alpha for name in ("diffuse", "albedo", "noise") if name in maps}
            if "fresh" in maps:
                parts |= {"fresh": maps["fresh"][:, :3] / alpha, "fresh_rays": maps["fresh"][:, 3:].clamp_min(1.0)}
        if "chain" in maps:
            ends = (maps["chain"][:, 2:3] > 0.5).float()
            parts["chain_uv"] = (2.0 * maps["chain"][:, :2] - 1.0) * ends
            parts["chain_mask"] = ends
            parts["chain_weight"] = maps["chain"][:, 3:].clamp(0.0, 1.0) * ends
        depth = ((maps["depth"] - self.near) / self.range).clamp(0.0, 1.0) * mask if "depth" in maps else zero
        return Batch(
            uv=(2.0 * maps["uv"] - 1.0) * mask if "uv" in maps else zero,
            depth=depth,
            normal=maps["normal"] * mask if "normal" in maps else zero,
            mask=mask,
            coverage=maps["coverage"].clamp(0.0, 1.0),
            view_dir=maps.get("view_dir", zero),
            camera_normal=maps["camera_normal"] * mask if "camera_normal" in maps else zero,
            rays=maps["rays"].clamp_min(1.0) if "rays" in maps else None,
            target=None,
            display=self.display,
            **parts,
        )

    def _texture(self, batch: Batch) -> Tensor:
        """What the renderer sees of T (`aggregator.Aggregator.forward`)."""
        part = self.model.aggregator
        if part.strategy == "early":
            features = [batch.depth.expand(-1, 3, -1, -1)] if "depth" in part.modalities else []
            features += [batch.normal] if "normal" in part.modalities else []
            features += [batch.uv, torch.ones_like(batch.mask)]
        else:
            features = []
            if "depth" in part.modalities:
                place = _rows(batch.depth, depth_coordinate)
                features.append(self._look_up(part.texture_depth, place))
            if "normal" in part.modalities:
                features.append(self._look_up(part.texture_normal, _rows(batch.normal, octahedral)))
            features.append(self._look_up(part.texture_uv, batch.uv))
        texture = features[-1] * batch.mask
        if part.fusion is not None:
            point = part.fusion.point
            weight = point.weight[..., None, None]
            hidden = part.fusion.activation(F.conv2d(torch.cat(features, dim=1), weight, point.bias)) * batch.mask
            fused = part.fusion.conv(hidden) * batch.mask
            texture = texture + fused if part.strategy == "residual" else fused
        if not part.harmonics:
            return texture
        last = SH_FIRST_CHANNEL + SH_COUNT
        shaded = texture[:, SH_FIRST_CHANNEL:last] * spherical_harmonics(batch.view_dir)
        return torch.cat([texture[:, :SH_FIRST_CHANNEL], shaded, texture[:, last:]], dim=1)

    def _look_up(self, pyramid: TexturePyramid, place: Tensor) -> Tensor:
        """Coordinates [1, 2, H, W] in [-1, 1] -> features [1, C, H, W]."""
        grid = place.permute(0, 2, 3, 1)
        if id(pyramid) in self.knots:
            whole = pyramid.look_up(self.knots[id(pyramid)])
            _, height, width, _ = self.knots[id(pyramid)].shape
            # The outermost knots lie on the border. Aligned by hand: onnxruntime's fast kernel aligns no corners.
            scale = torch.tensor([(width - 1) / width, (height - 1) / height])
            return F.grid_sample(whole, grid * scale, mode="bilinear", padding_mode="zeros", align_corners=False)
        return pyramid.look_up(grid)


class _GatheredDisplay(DisplayTransform):
    """The display transform with its table read by indices: runtimes have no GridSample of volumes."""

    def _look_up(self, x: Tensor) -> Tensor:
        assert self.lut is not None
        side = self.lut.shape[-1]
        table = self.lut[0].flatten(1).t().contiguous()
        t = torch.log2(1 + self.k * x.clamp(0.0, self.maximum)) / math.log2(1 + self.k * self.maximum)
        position = t * (side - 1)
        before = position.floor().clamp(0.0, side - 2)
        way = position - before
        first = before.long()
        parts: list[Tensor] = []
        for corner in range(8):
            step = [corner >> 2 & 1, corner >> 1 & 1, corner & 1]
            index, share = torch.zeros_like(first[:, 0]), torch.ones_like(way[:, 0])
            for axis in range(3):
                index = index * side + first[:, axis] + step[axis]
                share = share * (way[:, axis] if step[axis] else 1.0 - way[:, axis])
            _, height, width = index.shape
            colour = table.index_select(0, index.reshape(-1)).t().reshape(1, 3, height, width)
            parts.append(colour * share[:, None])
        return functools.reduce(torch.add, parts).clamp(0.0, 1.0)


def _expm1(graph: Any, x: Any) -> Any:
    """ONNX has no expm1; the difference is rounding, 1e-7 of display white."""
    one = graph.op("Constant", value_t=torch.tensor(1.0))
    return graph.op("Sub", graph.op("Exp", x), one)


def _rows(image: Tensor, function: Any) -> Tensor:
    """``function`` of points [P, C] -> [P, 2], over an image [1, C, H, W]."""
    _, _, height, width = image.shape
    flat = image[0].flatten(1).t()
    return function(flat).t().reshape(1, 2, height, width)


def channel_count(name: str) -> int:
    """Channels of a graph input."""
    return MADE.get(name) or len(CHANNELS[name])


def _example(name: str, height: int, width: int) -> Tensor:
    image = torch.rand(1, channel_count(name), height, width, generator=torch.Generator().manual_seed(len(name)))
    return (image > 0.3).float() if name == "mask" else image
