"""The report's headline, its missing parts, and its notes on how far to trust the figures."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dnrtrain.contract import View

from ..core.ledger import CostSummary
from ..core.units import duration, ratio, several
from ..stages.records import equal_rung
from .data import Missing, Quality, Selection, Training
from .quality import perceptual_note


def verdict(quality: Quality | None, selection: Selection | None) -> str:
    """The result in one sentence; says what is not known yet."""
    if selection is None:
        return "The scene is prepared; no views have been chosen yet."
    chosen = f"{len(selection.views)} of {selection.candidates} candidate views"
    how = f"Trained on {chosen}" if selection.views else "Without training"
    if quality is None and not selection.views:
        return "No views are to be ray-traced: the renderer is the shipped one; it has not been measured yet."
    if quality is None:
        return f"{chosen} were chosen for ray tracing ({selection.policy}); the renderer has not been measured yet."
    psnr = next((row for row in quality.rows if row.key == "psnr"), None)
    if psnr is None:
        return f"{how}."
    views = "the one view" if len(quality.views) == 1 else f"{len(quality.views)} views"
    text = f"{how}, the renderer reaches {psnr.mean:.1f} dB on {views} that it never saw"
    if quality.neural_seconds is None or quality.frame_seconds is None:
        return text + "."
    text += f", at {duration(quality.neural_seconds)} per frame"
    if quality.gbuffer_seconds is not None:
        text += f" plus {duration(quality.gbuffer_seconds)} for its {'base image' if quality.based else 'G-buffer'}"
    return f"{text}{_beside_rival(quality)}."


def _beside_rival(quality: Quality) -> str:
    """What path tracing with a denoiser takes for the same PSNR; "" where it was not measured."""
    if not quality.rivals or quality.rival_psnr is None or quality.frame_seconds is None:
        return ""
    found, last = equal_rung(quality.rivals, quality.rival_psnr), quality.rivals[-1]
    if found is None:
        return (
            f". Path tracing with a denoiser does not reach that with {last.spp} samples a pixel, at"
            f" {duration(last.seconds)} per frame"
        )
    longer = f"{ratio(found.seconds, quality.frame_seconds)} times as long"
    if found.seconds < quality.frame_seconds:
        longer = f"quicker by {ratio(quality.frame_seconds, found.seconds)} times"
    samples = f"{found.spp} sample{'s' if found.spp > 1 else ''} a pixel"
    return f". Path tracing with a denoiser is as good with {samples}, at {duration(found.seconds)} per frame: {longer}"


def missing(
    root: Path,
    cameras: dict[str, list[View]],
    selection: Selection | None,
    quality: Quality | None,
) -> list[Missing]:
    """Parts of the report whose stages have not run, in the order of the stages."""
    due = [
        (not cameras["train"], "cameras and passes", "prepare SCENE"),
        (selection is None, "the choice of views", "select"),
        (selection is None or selection.traced < len(selection.views), "ground truth of the chosen views",
         "raytrace-selected"),
        (not (root / "checkpoints" / "step2" / "model.json").is_file(), "the fine-tuned renderer", "finetune"),
        (quality is None, "held-out quality and pictures", "evaluate"),
    ]  # fmt: skip
    where = f" -w {shlex.quote(root.name)}"
    return [Missing(what=what, command=f"dnrpipe {command}{where}") for absent, what, command in due if absent]


def notes(
    quality: Quality | None,
    selection: Selection | None,
    training: Sequence[Training],
    summary: CostSummary,
    manifest: dict[str, Any],
    upfront: float | None,
    break_even: int | None,
) -> list[str]:
    """What a reader should know before trusting the figures, one or two sentences each."""
    found = []
    if quality and (
        text := perceptual_note(quality, manifest.get("settings", {}), trained=any(t.step == 2 for t in training))
    ):
        found.append(text)
    if quality and (broken := sum(view.psnr is None for view in quality.views)):
        found.append(
            f"PSNR is not finite in {broken} of {len(quality.views)} views (a picture that is exactly right, or a "
            "broken one); they are left out of its mean."
        )
    if quality and quality.noise_share_mean is not None and quality.noise_share_mean >= 0.1:
        spp = f" ({several(quality.spp)} samples per pixel)" if quality.spp else ""
        limited = ""
        if quality.noise_limited:
            limited = f", and at least half of it in {quality.noise_limited} of {len(quality.views)} views"
        found.append(
            f"The reference images are noisy themselves{spp}: a perfect renderer would measure about "
            f"{quality.ceiling_mean:.1f} dB against them. That noise makes up "
            f"{100 * quality.noise_share_mean:.0f} % of the measured squared error{limited}. Raise "
            "raytrace.evaluation_spp, or set raytrace.evaluation_noise, before reading more into small differences."
        )
    tracing = summary.tracing_all
    if tracing and tracing.net_saved_seconds < 0:
        trained = selection is None or selection.trained
        found.append(
            f"{'Step 1' if trained else 'Choosing'} took {duration(tracing.selection_seconds)}, more than the "
            f"{duration(tracing.saved_seconds)} of ray tracing that it saved: at this resolution and sample "
            "count, tracing every candidate costs less than choosing."
            + (" (Step 1 also pre-trains the renderer.)" if trained else "")
        )
    if quality and upfront and quality.traced_seconds and quality.frame_seconds and break_even is None:
        found.append("A neural frame is not cheaper than a ray-traced one here, so the renderer never pays for itself.")
    skipped = sum(t.skipped for t in training)
    if skipped:
        steps = "1 optimiser step was" if skipped == 1 else f"{skipped} optimiser steps were"
        found.append(f"{steps} skipped because a gradient was not finite.")
    if selection and 0 < selection.traced < len(selection.views):
        found.append(f"Only {selection.traced} of the {len(selection.views)} chosen views are ray-traced so far.")
    if summary.torn_lines:
        found.append(f"{summary.torn_lines} ledger lines were cut short by a crash; their seconds are not counted.")
    return found
