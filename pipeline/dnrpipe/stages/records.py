"""JSON files that stages write, as typed records. `dnrtrain.records` writes and reads them.

evaluation/metrics.json   Metrics
preview/preview.json      PreviewState
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from dnrtrain.records import Record

METRICS = "metrics.json"
PREVIEW = "preview.json"


class ViewMetrics(Record, allow_inf_nan=False):
    """One held-out view; None where a figure could not be computed.

    Args:
        psnr, ssim, lpips_alex, lpips_vgg, flip: over white, display space; PSNR in dB.
        psnr_mask, ssim_mask: inside the mask.
        ceiling_psnr: what a perfect renderer would measure against this noisy reference, dB.
        reference_noise, reference_noise_error: relative noise of the reference, and its standard error.
        seconds_traced, seconds_base: of the reference and the base image, on one worker.
        seconds_neural: of the network alone.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    psnr: float | None = None
    ssim: float | None = None
    psnr_mask: float | None = None
    ssim_mask: float | None = None
    lpips_alex: float | None = None
    lpips_vgg: float | None = None
    flip: float | None = None
    ceiling_psnr: float | None = None
    reference_noise: float | None = None
    reference_noise_error: float | None = None
    seconds_traced: float | None = None
    seconds_neural: float | None = None
    seconds_base: float | None = None
    spp: int | None = None
    psnr_base: float | None = None
    psnr_shipped: float | None = None


class BaselineRung(Record, allow_inf_nan=False):
    """Path tracing with so many samples, denoised, on a few of the test views: means.

    seconds: of a frame, with the whole machine. psnr in dB; lpips with AlexNet, None where there are no weights.
    """

    spp: int
    seconds: float
    psnr: float
    lpips: float | None = None


class Metrics(Record, allow_inf_nan=False):
    """The evaluation.

    Args:
        mean: of each figure, over the views that have it; None where none has.
        perceptual: LPIPS was measured.
        trained_with_perceptual: the perceptual loss was among the losses; None: not known.
        reference_noise_target: the relative noise that references were traced to; None: a number of samples was set.
        neural_ms: median of the network's milliseconds.
        baseline: path tracing with a denoiser, by rising samples; empty where it was not measured.
        baseline_psnr: the renderer's mean PSNR on the views of the baseline.
    """

    views: list[ViewMetrics] = Field(min_length=1)
    mean: dict[str, float | None] = Field(default_factory=dict)
    perceptual: bool = True
    trained_with_perceptual: bool | None = None
    device: str = "cpu"
    raster_engine: str = ""
    reference_noise_target: float | None = None
    neural_ms: float | None = None
    baseline: list[BaselineRung] = Field(default_factory=list)
    baseline_psnr: float | None = None


def equal_rung(rungs: Sequence[BaselineRung], psnr: float) -> BaselineRung | None:
    """The cheapest path tracing that has the PSNR; None: not with the most samples that were measured."""
    return min((rung for rung in rungs if rung.psnr >= psnr), key=lambda rung: rung.seconds, default=None)


class PreviewState(Record, allow_inf_nan=False):
    """The picture of a fine-tuning under way.

    Args:
        split: test (held out), or train where nothing is.
        view: its name.
        epoch, epochs: done, and wanted.
        psnr: dB; None without a reference.
        truth: whether there is a reference.
        time: unix seconds.
    """

    split: Literal["test", "train"]
    view: str
    epoch: int
    epochs: int
    psnr: float | None
    truth: bool
    time: float
