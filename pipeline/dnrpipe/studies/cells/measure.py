"""Pictures of the test views, their metrics and the milliseconds of a frame."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dnrtrain.exr import read_metadata

from ...core.errors import UserError
from ...core.images import flip_error, mean_known, picture_of, write_png
from ...core.workspace import Workspace

if TYPE_CHECKING:
    from torch import Tensor

    from dnrtrain.dataset import ViewSet

TIMED_VIEWS, REPEATS = 4, 3


def network_pictures(folder: Path, views: ViewSet, device: str) -> tuple[Tensor, float]:
    """(display RGB over white in [0, 1], [N, 3, H, W] on the CPU; median milliseconds of the network's frame).

    On one thread of a CPU the milliseconds are the processor's, which other work on the machine does not stretch.
    """
    import torch

    from dnrtrain.checkpoint import load_model
    from dnrtrain.model import render_views

    model, views = load_model(folder, device), views.to(device)
    pictures = render_views(model, views)  # warms up, too
    alone = device == "cpu" and torch.get_num_threads() == 1
    clock = time.process_time if alone else time.perf_counter
    seconds = []
    for index in range(min(TIMED_VIEWS, len(views))):
        one = views.subset([index])
        for _ in range(REPEATS):
            if device.startswith("cuda"):
                torch.cuda.synchronize()
            started = clock()
            render_views(model, one)  # ends on the CPU, so it waits for the device
            seconds.append(clock() - started)
    return pictures, 1000 * float(np.median(seconds))


def training_psnr(folder: Path, views: ViewSet, device: str) -> float:
    """Mean PSNR of the network on the views that it was trained on, dB: how far it has learned them by heart."""
    from dnrtrain.checkpoint import load_model
    from dnrtrain.metrics import psnr
    from dnrtrain.model import render_views

    target = views.tensors.target
    assert target is not None  # it was trained on them
    return float(psnr(render_views(load_model(folder, device), views), target.cpu()).mean())


def base_pictures(views: ViewSet) -> Tensor:
    """The base images themselves as display RGB over white in [0, 1], [N, 3, H, W], composed as the network's are."""
    from dnrtrain.model import base_picture

    return base_picture(views.tensors).clamp(0.0, 1.0)


def rendered_ms(files: list[Path]) -> float | None:
    """Median milliseconds that base images took, by their files; None where they do not say."""
    seconds = [(read_metadata(path) or {}).get("seconds") for path in files]
    known = [value for value in seconds if value is not None]
    return 1000 * float(np.median(known)) if known else None


def written_seconds(file: Path, clock: Literal["seconds", "cpu_seconds"] = "cpu_seconds") -> float:
    """Seconds that rendering the file took, by its header. Raises UserError: it is missing or damaged."""
    metadata = read_metadata(file)
    if metadata is None:
        raise UserError(f"{file}: is missing or damaged; run the same command again")
    return float(metadata[clock])


def measure(
    pictures: Tensor, views: ViewSet, workspace: Workspace, weights: Any, keep: Path | None
) -> list[dict[str, Any]]:
    """One row of metrics per test view, JSON-ready; writes the middle view's picture to ``keep``.

    ``ceiling``: the PSNR that a perfect renderer would measure against the view's noisy reference, dB.
    """
    from dnrtrain.perceptual import build_lpips

    target = views.tensors.target
    assert target is not None  # loaded with ray-traced targets
    lpips = build_lpips(weights) if weights is not None else None
    rows = []
    for index, name in enumerate(views.names):
        one = slice(index, index + 1)
        row = view_metrics(pictures[one], target[one].cpu(), views.tensors.mask[one].cpu(), lpips)
        noise = (read_metadata(workspace.raytraced("test", name)) or {}).get("noise_rmse")
        row["ceiling"] = -20 * math.log10(noise) if noise else None
        rows.append({"name": name, **row})
    if keep is not None:
        middle = views.index(pictured(rows)["name"])
        write_png(keep, picture_of(pictures[middle]))
        write_png(keep.parent / "truth.png", picture_of(target[middle]))
    return rows


def view_metrics(picture: Tensor, target: Tensor, mask: Tensor, lpips: Any) -> dict[str, Any]:
    """Metrics of one view by name. picture, target: display RGB [1, 3, H, W]; mask: [1, 1, H, W]; lpips: or None."""
    from dnrtrain.metrics import image_metrics

    metrics = image_metrics(picture, target, mask, lpips)
    return {**metrics, "flip": flip_error(picture_of(target[0]), picture_of(picture[0]))[0]}


def pictured(tests: list[dict[str, Any]]) -> dict[str, Any]:
    """The test view whose picture is kept: the middle one, the same for every row."""
    return tests[len(tests) // 2]


METRICS = ("psnr", "psnr_mask", "ssim", "ssim_mask", "lpips_vgg", "lpips_alex", "flip", "ceiling")


def mean_of(tests: list[dict[str, Any]], name: str) -> float | None:
    """Mean of a metric over the test views that have it."""
    mean = mean_known(test[name] for test in tests)
    return None if mean is None else round(mean, 5)
