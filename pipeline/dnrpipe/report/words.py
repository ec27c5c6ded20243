"""The report's headline."""

from __future__ import annotations

from ..core.units import duration, ratio
from .data import Quality, Selection


def verdict(quality: Quality | None, selection: Selection | None) -> str:
    """The result in one sentence; says what is not known yet."""
    if selection is None:
        return "The scene is prepared; no views have been chosen yet."
    chosen = f"{len(selection.views)} of {selection.candidates} candidate views"
    if quality is None:
        return f"{chosen} were chosen for ray tracing ({selection.policy}); the renderer has not been measured yet."
    psnr = next((row for row in quality.rows if row.key == "psnr"), None)
    if psnr is None:
        return f"Trained on {chosen}."
    views = "the one view" if len(quality.views) == 1 else f"{len(quality.views)} views"
    text = f"Trained on {chosen}, the renderer reaches {psnr.mean:.1f} dB on {views} that it never saw"
    if quality.neural_seconds is None or quality.frame_seconds is None:
        return text + "."
    text += f", at {duration(quality.neural_seconds)} per frame"
    if quality.gbuffer_seconds is not None:
        text += f" plus {duration(quality.gbuffer_seconds)} for its {'base image' if quality.based else 'G-buffer'}"
    if quality.traced_seconds is None:
        return text + "."
    if quality.traced_seconds <= quality.frame_seconds:
        return f"{text}; a ray-traced frame takes {duration(quality.traced_seconds)}."
    faster = ratio(quality.traced_seconds, quality.frame_seconds)
    return f"{text}: {faster} times faster than the {duration(quality.traced_seconds)} of a ray-traced one."
