"""Build a training scene from a seed, or a contact sheet of many.

python blender_scenes/factory/build.py --seed 17 OUT.blend [--family room] [--preview PREVIEW.png]
python blender_scenes/factory/build.py --count 24 --sheet SHEET.jpg [--seed FIRST]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

# The builders beside this folder import each other by plain names, and this package by its own.
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import bpy
import numpy as np
from building import preview, save

from factory.recipe import FAMILIES, family_of, make
from factory.sheet import contact_sheet


def triangles() -> int:
    """Of everything that is drawn, copies counted each."""
    graph = bpy.context.evaluated_depsgraph_get()
    return sum(
        len(i.object.data.loop_triangles) or sum(len(p.vertices) - 2 for p in i.object.data.polygons)
        for i in graph.object_instances
        if i.object.type == "MESH"
    )


def shown_mean(path: Path) -> float:
    """Mean display value of a picture over white."""
    from PIL import Image

    rgba = np.asarray(Image.open(path).convert("RGBA"), dtype=float) / 255
    return float((rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description="Build a training scene from a seed")
    parser.add_argument("output", type=Path, nargs="?", help="the .blend to write")
    parser.add_argument("--seed", type=int, default=0, help="of the scene, or the first of a sheet")
    parser.add_argument("--family", choices=sorted(FAMILIES))
    parser.add_argument("--without", nargs="*", default=(), choices=sorted(FAMILIES), help="families not to draw")
    parser.add_argument("--preview", type=Path, help="render a small Cycles picture here")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--count", type=int, default=24, help="scenes on a sheet")
    parser.add_argument("--sheet", type=Path, help="write a contact sheet of --count seeds instead")
    options = parser.parse_args()
    if options.sheet is None:
        if options.output is None:
            parser.error("name an output or a --sheet")
        print(make(options.seed, options.family or family_of(options.seed, options.without)))
        save(options.output)
        if options.preview:
            preview(options.preview, options.size, options.samples)
        return
    with tempfile.TemporaryDirectory() as folder:
        tiles = []
        for seed in range(options.seed, options.seed + options.count):
            start = time.perf_counter()
            family = make(seed, options.family)
            spent, path = time.perf_counter() - start, Path(folder) / f"{seed}.png"
            count = triangles()
            preview(path, options.size, options.samples)
            base = bpy.context.scene.get("factory_base", "")
            print(f"{seed} {family} {base} {count} triangles {spent:.1f} s, mean {shown_mean(path):.2f}", flush=True)
            tiles.append((f"{seed} {family} {base}", path))
        contact_sheet(tiles, options.sheet)


if __name__ == "__main__":
    main()
