"""The network of the page: a small one, over a base image that a browser can draw. Trained, and checked there.

A browser has no ray tracer, so its base image is the diffuse outgoing light of the surfaces (`surface`), looked up once
a pixel; the network learns mirrors, glass and highlights. The workspace's own network corrects a richer base image and
would be wrong over this one, so the export trains another on the same ray-traced views.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dnrtrain.checkpoint import load_model
from dnrtrain.contract import View
from dnrtrain.dataset import Batch, ViewSet
from dnrtrain.display import DisplayTransform
from dnrtrain.events import EpochEnd, Note
from dnrtrain.metrics import psnr
from dnrtrain.model import DNR, render_views
from dnrtrain.settings import ModelSettings, Step2Settings
from dnrtrain.step2 import run_step2

from ..core.console import Console
from ..core.scene_files import read_frame
from ..core.settings import PRESETS, Settings
from ..core.workspace import Workspace, digest
from ..stages.trainer import epochs_done, load, perceptual_weights, torch_device
from .browser import open_page, wait_for
from .page_data import PageLight
from .surface import SurfaceMaps

if TYPE_CHECKING:
    from playwright.sync_api import Page

MODEL = {"base": "raster", "guides": True, "network": "mlp", "width": 12, "filter": 0, "output": "display"}
"""Of the page's network, beside the draft preset's. It sees every pixel by itself, so the page asks it for covered ones
only; a U-Net takes several times as long in WebAssembly and came out worse on the demo scene. Display space saves a
logarithm and an exponential a pixel: a page shows nothing else."""
STEPS = 1500
"""Training takes at least so many, whatever the number of views."""
SPEED_SIDE = 256
"""Pixels of the picture's width whose frames a second are measured."""
CHANNELS = {"uv": 2, "mask": 1, "coverage": 1, "view_dir": 3, "normal": 3, "base": 4, "rgb": 3}
"""What the page draws and renders of a view, and how many channels each has."""


def web_views(
    workspace: Workspace, views: Sequence[View], split: str, maps: SurfaceMaps, light: PageLight | None
) -> ViewSet:
    """The views with the base image that the page would draw, and ray-traced targets. light: None: not packed."""
    loaded = load(workspace, list(views), split, raytraced=True, base="baked")
    base = base_images(loaded.tensors, maps, light)
    display = DisplayTransform(read_frame(workspace), workspace.scene)
    return replace(loaded, tensors=replace(loaded.tensors, base=base, display=display))


def base_images(views: Batch, maps: SurfaceMaps, light: PageLight | None) -> Tensor:
    """[N, 3, H, W] linear: bilinear look-ups of the side that is seen, as the page's shader makes them: of codes."""

    def sampled(image: np.ndarray, mode: str) -> Tensor:
        texels = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
        grid = views.uv.permute(0, 2, 3, 1)
        parts = [F.grid_sample(texels, g[None], mode, padding_mode="border", align_corners=False) for g in grid]
        return torch.cat(parts)

    def radiance(side: int) -> Tensor:
        if light is None:
            return sampled(maps.radiance[side, ..., :3], "bilinear") * views.mask
        codes = sampled(light.codes[side, ..., :3], "bilinear")
        return torch.expm1(codes * (light.range / 255)) / light.curve * views.mask

    if not maps.thin:
        return radiance(0)
    # The files do not say which side of a sheet is seen: the shading normal faces the camera, the triangle's need not.
    away = (views.normal * sampled(maps.normal, "nearest")).sum(dim=1, keepdim=True) < 0
    return torch.where(away, radiance(1), radiance(0))


def train(
    workspace: Workspace,
    settings: Settings,
    console: Console,
    views: Sequence[View],
    maps: SurfaceMaps,
    light: PageLight,
    folder: Path,
    epochs: int | None,
) -> DNR:
    """Train the page's network in `folder`, or resume an interrupted training; float32 for inference."""
    draft, size = PRESETS["draft"], min(settings.model.texture_size, 256)
    model = ModelSettings.model_validate({**draft["model"], **MODEL, "texture_size": size})
    step2 = Step2Settings.model_validate({**draft["finetune"]["step2"], "start": "fresh", "patch": 192})
    step2 = step2.model_copy(update={"epochs": epochs or max(step2.epochs, -(-STEPS // len(views)))})
    data = web_views(workspace, views, "train", maps, light)
    weights = perceptual_weights(console)
    fingerprint = training_fingerprint(workspace, views, light)
    events = run_step2(
        data, None, folder, model, step2,
        seed=settings.finetune.seed, device=torch_device(settings), checkpoints=folder, fingerprint=fingerprint,
        weights=weights,
    )  # fmt: skip
    done, _ = epochs_done(folder, step2.epochs, False)
    with console.bar("training for the page", step2.epochs, done) as bar:
        for event in events:
            if isinstance(event, Note):
                console.say(event.text)
            elif isinstance(event, EpochEnd):
                bar.advance(event.epoch - bar.done, note=f"loss {event.losses['total']:.4f}")
    found = load_model(folder)
    found.use_bfloat16 = False
    return found


def training_fingerprint(workspace: Workspace, views: Sequence[View], light: PageLight) -> str:
    """Hash of what the page's network is trained on: the packed light, the views and their ray-traced pictures."""
    traced = workspace.manifest.stages.get("raytrace")
    placed = [view.model_dump(mode="json") for view in views]
    return digest([sha256(light.codes.tobytes()).hexdigest(), placed, traced.output if traced else None])


def check_page(out: Path, views: Sequence[View], data: ViewSet, model: DNR, console: Console) -> dict[str, Any]:
    """Open ``out/index.html`` from disk in a headless Chromium (software GL) and render the views.

    data: the same views by their files (`web_views`), with ray-traced targets. Returns means over the views, dB:
    `psnr_torch`, the page's picture against torch on the inputs that the page drew; `psnr_files`, against torch on
    Blender's G-buffers; `psnr_truth`, against the ray-traced view; also `mask_agrees`, the share of pixels whose mask
    agrees with Blender's; `figures` of viewer.js, of a turntable of SPEED_SIDE pixels a side. Raises UserError: no
    Chromium, or the page failed in it.
    """
    assert data.tensors.target is not None
    expected = render_views(model, data)
    rows: list[dict[str, float]] = []
    address = (out.resolve() / "index.html").as_uri()
    with open_page(address) as (page, _), console.bar("views in Chromium", len(views)) as bar:
        wait_for(page, "window.dnr.then(() => true)")
        for index, view in enumerate(views):
            drawn = probe(page, view)
            batch = page_batch(data.batch([index]), drawn)
            with torch.no_grad():
                same = model(batch).rgb.clamp(0.0, 1.0)
            shown = torch.from_numpy(drawn["rgb"])[None]
            rows.append(
                {
                    "psnr_torch": float(psnr(shown, same)),
                    "psnr_files": float(psnr(shown, expected[index : index + 1])),
                    "psnr_truth": float(psnr(shown, data.tensors.target[index : index + 1])),
                    "mask_agrees": float((batch.mask == data.tensors.mask[index : index + 1]).float().mean()),
                }
            )
            bar.advance(note=f"{rows[-1]['psnr_torch']:.1f} dB")
        figures = wait_for(page, f"window.dnr.then(page => page.measure({SPEED_SIDE}))")
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return {**means, "views": len(rows), "side": SPEED_SIDE, **figures}


def probe(page: Page, view: View) -> dict[str, np.ndarray]:
    """What the page draws and renders of a view: its inputs and `rgb`, float32 [C, H, W] each."""
    answer = wait_for(page, f"window.dnr.then(page => page.probe({json.dumps(view.model_dump(mode='json'))}))")
    return {
        name: np.frombuffer(base64.b64decode(answer[name]), "<f4").reshape(count, view.height, view.width).copy()
        for name, count in CHANNELS.items()
    }


def page_batch(batch: Batch, drawn: dict[str, np.ndarray]) -> Batch:
    """`batch` (one view) with the page's inputs instead of those from files."""
    maps = {name: torch.from_numpy(image)[None] for name, image in drawn.items()}
    mask = (maps["mask"] > 0.5).float()
    return replace(
        batch,
        uv=(2.0 * maps["uv"] - 1.0) * mask,
        mask=mask,
        coverage=maps["coverage"],
        view_dir=maps["view_dir"],
        normal=maps["normal"] * mask,
        base=maps["base"][:, :3] * mask,
    )
