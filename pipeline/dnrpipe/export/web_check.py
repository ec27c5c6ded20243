"""Compares the page in a browser with torch: same cameras, same inputs."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dnrtrain.contract import View
from dnrtrain.dataset import Batch, ViewSet
from dnrtrain.metrics import psnr
from dnrtrain.model import DNR, render_views

from ..core.console import Console
from .browser import open_page, wait_for

if TYPE_CHECKING:
    from playwright.sync_api import Page

CHANNELS = {"uv": 2, "mask": 1, "coverage": 1, "view_dir": 3, "normal": 3, "base": 4, "rgb": 3}


def check_page(out: Path, views: Sequence[View], data: ViewSet, model: DNR, console: Console) -> dict[str, Any]:
    """Open ``out/index.html`` from disk in a headless Chromium (software GL) and render the views.

    Args:
        out: the exported folder.
        views: their cameras.
        data: the same views by their files (`web_model.web_views`), with ray-traced targets.
        model: the page's network.
        console: for progress.

    Returns:
        Means over the views, dB: `psnr_torch`, the page's picture against torch on the inputs that the page drew;
        `psnr_files`, against torch on Blender's G-buffers; `psnr_truth`, against the ray-traced view; also
        `mask_agrees`, the share of pixels whose mask agrees with Blender's, and milliseconds by stage.

    Raises:
        UserError: no Chromium, or the page failed in it.
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
        figures = wait_for(page, "window.dnr.then(page => page.figures())")
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return {**means, "views": len(rows), **{k: v for k, v in figures.items() if k not in ("fps", "frames")}}


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
