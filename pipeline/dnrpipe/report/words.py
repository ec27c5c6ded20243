"""Numbers as people read them, and the one sentence at the top."""

from __future__ import annotations

from collections.abc import Sequence

from .data import Quality, Selection


def duration(seconds: float) -> str:
    """``13 ms``, ``2.41 s``, ``48 s``, ``3 min 05 s``, ``2 h 10 min``; a minus sign where negative."""
    if seconds < 0:
        return "−" + duration(-seconds)
    if seconds == 0:
        return "0 s"
    if seconds < 0.9995:
        return f"{seconds * 1000:.3g} ms" if seconds < 0.01 else f"{seconds * 1000:.0f} ms"
    if seconds < 9.995:
        return f"{seconds:.2f} s"
    if seconds < 99.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min"


def count(number: int) -> str:
    """Thousands set apart by thin spaces."""
    return f"{number:,}".replace(",", "\u2009")


def several(numbers: Sequence[int]) -> str:
    """``64``, ``64, 128``, or from least to most where views have each their own number: ``80 to 664``."""
    return ", ".join(map(str, numbers)) if len(numbers) <= 3 else f"{min(numbers)} to {max(numbers)}"


def ratio(slow: float, fast: float) -> str:
    """How many times faster, with two significant digits."""
    value = slow / fast
    return f"{value:.1f}" if value < 10 else f"{float(f'{value:.2g}'):.0f}"


def verdict(quality: Quality | None, selection: Selection | None) -> str:
    """What came out, in plain words. Says what is not known yet."""
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
