"""Contact sheets: previews side by side, each with its seed and family."""

from __future__ import annotations

from pathlib import Path

from PIL import Image, ImageDraw


def contact_sheet(tiles: list[tuple[str, Path]], path: Path, columns: int = 6) -> None:
    """One JPEG of labelled previews."""
    pictures = []
    for label, source in tiles:
        shown = Image.open(source).convert("RGBA")
        white = Image.new("RGBA", shown.size, "white")
        picture = Image.alpha_composite(white, shown).convert("RGB")
        ImageDraw.Draw(picture).text((3, 1), label, fill="white", stroke_width=1, stroke_fill="black")
        pictures.append(picture)
    wide, high = pictures[0].size
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * (wide + 2), rows * (high + 2)), "grey")
    for k, picture in enumerate(pictures):
        sheet.paste(picture, (k % columns * (wide + 2), k // columns * (high + 2)))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path, quality=90)
