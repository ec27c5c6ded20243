"""Make docs/images/demo.png from the demo's workspace: ground truth, neural rendering and error of three test views.

python tools/readme_picture.py demo-output/demo.dnr docs/images/demo.png
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

SIDE = 256
GAP = 8
LABELS = (("truth", "ray-traced"), ("prediction", "neural"), ("flip", "FLIP error"))


def main(workspace: Path, target: Path) -> None:
    """Three rows (best, median, worst held-out view by PSNR), three columns."""
    views = json.loads((workspace / "evaluation" / "metrics.json").read_text())["views"]
    ranked = sorted(views, key=lambda view: -view["psnr"])
    rows = [ranked[0], ranked[len(ranked) // 2], ranked[-1]]
    head = 28
    sheet = Image.new("RGB", (3 * SIDE + 2 * GAP, head + 3 * (SIDE + GAP)), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=16)
    for column, (_, label) in enumerate(LABELS):
        draw.text((column * (SIDE + GAP) + 6, 4), label, fill="black", font=font)
    for row, view in enumerate(rows):
        for column, (kind, _) in enumerate(LABELS):
            picture = Image.open(workspace / "evaluation" / f"{view['name']}.{kind}.png").convert("RGB")
            at = (column * (SIDE + GAP), head + row * (SIDE + GAP))
            sheet.paste(picture.resize((SIDE, SIDE), Image.Resampling.BICUBIC), at)
        text = f"{view['psnr']:.1f} dB"
        draw.text((SIDE + GAP + 6, head + row * (SIDE + GAP) + SIDE - 24), text, fill="black", font=font)
    target.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(target, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
