"""Pictures of docs/shots.md from the workspaces that `tools.bench_shots` left: a contact sheet, and a shot that moves.

    python -m tools.shot_pictures FOLDER [--moving interior] [--size 640x360]

The contact sheet has a row per scene: the reference, the shot's frame, and path tracing with a denoiser that takes at
most as long a frame; below each row the same, cut out where the two differ most.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dnrpipe.core.images import eight_bit
from dnrpipe.stages.shots.render_frames import PICTURES_FOLDER

from .bench_shots import OUT, REFERENCE, TAKES, folder_of_rung, places, root_of

IMAGES = OUT.parents[1] / "images"
WIDTH, GAP, HEAD = 320, 6, 24
ZOOM = 2
"""Of what is cut out."""
HALVED = 2
"""Of the moving picture's sides and frame rate: every second frame of 24 a second."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of tools.bench_shots")
    parser.add_argument("--moving", default="interior", help="scene of the moving picture")
    parser.add_argument("--size", default="640x360")
    options = parser.parse_args()
    rows = [row for row in json.loads(OUT.read_text())["rows"] if row["size"] == options.size]
    roots = {row["scene"]: root_of(options.folder, row["scene"], options.size) for row in rows}
    found = {scene: root for scene, root in roots.items() if root.exists()}
    strips = [strip(row, found[row["scene"]]) for row in rows if row["scene"] in found]
    IMAGES.mkdir(parents=True, exist_ok=True)
    stacked(strips, 2 * GAP).save(IMAGES / "shots.jpg", quality=88, optimize=True)
    if options.moving in found:
        moving(found[options.moving] / "shots" / "arc" / PICTURES_FOLDER, IMAGES / f"shot-{options.moving}.webp")


def strip(row: dict[str, Any], root: Path) -> Image.Image:
    """A scene: three pictures with their figures, and what is cut out of them. The rival is Mitsuba's."""
    number = places(row["frames"])[0]
    rivals = [rung for rung in row["rungs"] if rung["frame"] <= row["frame"]]
    rival = max(rivals, key=lambda rung: rung["psnr"]) if rivals else min(row["rungs"], key=lambda rung: rung["frame"])
    takes = [folder_of_rung(root, REFERENCE.spp, REFERENCE.quality, take) / f"{number:05d}.png" for take in TAKES]
    truth = np.mean([_pixels(path) for path in takes], axis=0)
    ours = _pixels(root / "shots" / "arc" / PICTURES_FOLDER / f"{number + 1:05d}.png")
    theirs = _pixels(folder_of_rung(root, rival["spp"], rival["quality"], 0) / f"{number:05d}.png")
    way = row["chosen"]["way"]
    titles = (
        f"{row['scene']}: reference",
        f"{way['name']} {way['spp']} rays: {row['frame']:.2f} s, {row['ours']['psnr']:.1f} dB",
        f"path tracing {rival['spp']} spp: {rival['frame']:.2f} s, {rival['psnr']:.1f} dB",
    )
    top, left, high, wide = most_different(ours, theirs)
    cut: Callable[[np.ndarray], np.ndarray] = lambda image: image[top : top + high, left : left + wide]  # noqa: E731
    pictures = (truth, ours, theirs)
    whole = beside([_titled(_fitted(image), title) for image, title in zip(pictures, titles, strict=True)])
    return stacked([whole, beside([_fitted(cut(image), Image.Resampling.NEAREST) for image in pictures])], GAP)


def most_different(a: np.ndarray, b: np.ndarray) -> tuple[int, int, int, int]:
    """(top, left, height, width) of the window in which two pictures [H, W, 3] differ most."""
    height, width = a.shape[:2]
    wide = WIDTH // ZOOM
    high = wide * height // width
    total = np.pad(((a - b) ** 2).mean(axis=-1).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    inside = total[high:, wide:] - total[:-high, wide:] - total[high:, :-wide] + total[:-high, :-wide]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(top), int(left), high, wide


def moving(folder: Path, target: Path) -> None:
    """A shot's pictures as an animated WebP, forth and back."""
    frames = []
    for path in sorted(folder.glob("*.png"))[::HALVED]:
        image = Image.open(path).convert("RGB")
        frames.append(image.resize((image.width // HALVED, image.height // HALVED), Image.Resampling.LANCZOS))
    way = [*frames, *frames[-2:0:-1]]
    way[0].save(target, save_all=True, append_images=way[1:], duration=1000 * HALVED // 24, loop=0, quality=70)


def beside(images: Sequence[Image.Image]) -> Image.Image:
    """Pictures of one height, from left to right."""
    sheet = Image.new("RGB", (sum(i.width for i in images) + GAP * (len(images) - 1), images[0].height), "white")
    left = 0
    for image in images:
        sheet.paste(image, (left, 0))
        left += image.width + GAP
    return sheet


def stacked(images: Sequence[Image.Image], gap: int) -> Image.Image:
    """Pictures of one width, one below the other."""
    sheet = Image.new("RGB", (images[0].width, sum(i.height for i in images) + gap * (len(images) - 1)), "white")
    top = 0
    for image in images:
        sheet.paste(image, (0, top))
        top += image.height + gap
    return sheet


def _pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), np.float32) / 255


def _fitted(image: np.ndarray, way: Image.Resampling = Image.Resampling.LANCZOS) -> Image.Image:
    picture = Image.fromarray(eight_bit(image))
    return picture.resize((WIDTH, WIDTH * image.shape[0] // image.shape[1]), way)


def _titled(picture: Image.Image, title: str) -> Image.Image:
    sheet = Image.new("RGB", (picture.width, picture.height + HEAD), "white")
    sheet.paste(picture, (0, HEAD))
    ImageDraw.Draw(sheet).text((2, 4), title, fill="black", font=ImageFont.load_default(size=14))
    return sheet


if __name__ == "__main__":
    main()
