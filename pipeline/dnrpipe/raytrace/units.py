"""Cameras in a bundle's own units (see `dnrpipe.blender.bundle.units`)."""

from __future__ import annotations

import re
from pathlib import Path

from dnrtrain.contract import View

_HEAD = re.compile(r'<default name="unit_scale" value="([^"]+)"')


def unit_scale(bundle: Path) -> float:
    """What the bundle's lengths are multiples of the scene's by; 1 for scenes of usual size."""
    with bundle.open(encoding="utf-8") as file:
        found = _HEAD.search(file.read(512))
    return float(found[1]) if found else 1.0


def scaled_view(view: View, factor: float) -> View:
    """The view from the same place of a scene ``factor`` times as large."""
    if factor == 1.0:
        return view
    rows = [(*row[:3], row[3] * factor) for row in view.c2w[:3]]
    return view.model_copy(update={"c2w": (*rows, view.c2w[3])})


def scaled_lens(lens: dict[str, float] | None, factor: float) -> dict[str, float] | None:
    """Aperture and focus distance, both lengths."""
    return lens and {name: length * factor for name, length in lens.items()}
