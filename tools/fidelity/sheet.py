"""Contact sheets: Cycles, ours, difference, a cell per scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dnrpipe.core.images import eight_bit, read_rgba
from dnrtrain.atomic import atomic_path

from .measure import display, mean

COLUMNS = 3
SIDE = 96
GAP = 6
HEAD = 16
GAIN = 5.0
"""Differences in display space are shown this many times larger."""
JPEG_QUALITY = 82
Font: TypeAlias = ImageFont.ImageFont | ImageFont.FreeTypeFont


def write_sheet(records: Sequence[dict[str, Any]], target: Path) -> None:
    """One sheet (JPEG) of the records that have pictures."""
    shown = [record for record in records if record.get("pictures")]
    if not shown:
        return
    cell = (3 * SIDE + 2 * GAP, SIDE + HEAD + 2 * GAP)
    rows = -(-len(shown) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * (cell[0] + 2 * GAP), rows * cell[1] + HEAD), "white")
    draw = ImageDraw.Draw(sheet)
    font: Font = ImageFont.load_default(size=11)
    for column in range(COLUMNS):
        for index, label in enumerate(("Cycles", "ours", f"difference x{GAIN:g}")):
            at = (GAP + column * (cell[0] + 2 * GAP) + index * (SIDE + GAP), 2)
            draw.text(at, label, fill=(90, 90, 90), font=font)
    for number, record in enumerate(shown):
        left = GAP + (number % COLUMNS) * (cell[0] + 2 * GAP)
        top = HEAD + number // COLUMNS * cell[1]
        draw.text((left, top + 1), _label(draw, record, font, cell[0]), fill="black", font=font)
        for index, image in enumerate(triptych(record)):
            image.thumbnail((SIDE, SIDE))
            sheet.paste(image, (left + index * (SIDE + GAP), top + HEAD))
    with atomic_path(target) as temporary:
        sheet.save(temporary, "JPEG", quality=JPEG_QUALITY, optimize=True)


def triptych(record: dict[str, Any]) -> tuple[Image.Image, Image.Image, Image.Image]:
    """Cycles, ours and their absolute difference times GAIN, display space over white."""
    cycles, ours = (
        display(mean([read_rgba(Path(path)) for path in record["pictures"][who]])) for who in ("cycles", "ours")
    )
    return to_image(cycles), to_image(ours), to_image(np.abs(cycles - ours) * GAIN)


def to_image(values: np.ndarray) -> Image.Image:
    """Display values [H, W, 3] in [0, 1] as an 8-bit picture."""
    return Image.fromarray(eight_bit(values))


def _label(draw: ImageDraw.ImageDraw, record: dict[str, Any], font: Font, width: int) -> str:
    tail = f"  {record['measured']['psnr']:.1f} dB"
    title = record["title"]
    while draw.textlength(title + tail, font=font) > width and len(title) > 4:
        title = title[:-2].rstrip() + "…" if not title.endswith("…") else title[:-2].rstrip("… ") + "…"
    return title + tail
