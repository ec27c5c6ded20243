"""The shipped corrector beside trained renderers, scene by scene: quality, and seconds before the first frame.

python -m tools.bench_untrained FOLDER [SCENE.blend ...] [--out docs/results/untrained.json]

FOLDER keeps the workspaces; rows that are in the results are not measured again. Without scenes: the example scenes.
Variants, at the draft preset with 8 test views of 256 samples:

    untrained   --budget 0
    6 views     --budget 6, 180 steps on from the shipped corrector
    25 views    the preset: 25 views, 1000 steps on from the shipped corrector
    fresh       25 views, 1000 steps of a fresh network with guides in world space: the default before

Seconds are wall time of the commands from `prepare` to the first frame. Light and path depth pilot are made once, by
`untrained`, and G-buffers of the candidates by `6 views`; all that need them count them. Views are traced anew.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.studies.selectbench.figures import summarise
from dnrtrain.atomic import write_json

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "results" / "untrained.json"
TESTS = ("--set", "cameras.test=8", "--set", "cameras.val=0", "--set", "raytrace.evaluation_spp=256")
FRESH = ("--set", "finetune.step2.start=fresh", "--set", "model.guides=true")
VARIANTS: dict[str, tuple[str, ...]] = {
    "untrained": ("--budget", "0"),
    "6 views": ("--budget", "6", "--set", "finetune.step2.epochs=30"),
    "25 views": ("--budget", "25", "--set", "finetune.step2.epochs=40"),
    "fresh": ("--budget", "25", "--set", "finetune.step2.epochs=40", *FRESH),
}
FIGURES = ("psnr", "ssim", "lpips_alex", "flip")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = json.loads(options.out.read_text())["rows"] if options.out.exists() else []
    for scene in options.scenes or sorted((ROOT / "blender_scenes").glob("*.blend")):
        if {row["variant"] for row in rows if row["scene"] == scene.stem} >= set(VARIANTS):
            continue
        rows = [row for row in rows if row["scene"] != scene.stem]  # its seconds belong together
        rows += measured(scene.resolve(), options.folder / f"{scene.stem}.dnr")
        write_json(options.out, {"machine": f"{os.cpu_count()} cores", "rows": rows})
    print(markdown({"rows": rows}))


def measured(scene: Path, root: Path) -> list[dict[str, Any]]:
    """A row per variant."""
    rows = []
    shutil.rmtree(root, ignore_errors=True)
    prepared = run(root, "prepare", str(scene), "--set", "select.budget=0", *TESTS)
    shared = 0.0
    for variant, options in VARIANTS.items():
        chosen = run(root, "select", *options)
        spent = chosen + run(root, "raytrace-selected", "--force") + run(root, "finetune")
        run(root, "evaluate")
        mean = json.loads((root / "evaluation" / "metrics.json").read_text())["mean"]
        figures = {name: mean[name] for name in FIGURES}
        seconds = round(prepared + shared + spent, 1)
        rows.append({"scene": scene.stem, "variant": variant, "base": mean["psnr_base"], **figures, "seconds": seconds})
        if variant == "6 views":
            shared += chosen
        elif variant == "untrained":
            ledger = [json.loads(line) for line in (root / "costs.jsonl").read_text().splitlines()]
            shared = sum(record["seconds"] for record in ledger if record["name"] in ("light", "path depth pilot"))
        print(f"{scene.stem}, {variant}: {mean['psnr']:.2f} dB, {seconds:.0f} s", flush=True)
    return rows


def run(root: Path, command: str, *options: str) -> float:
    """Wall seconds of a command on the workspace."""
    started = time.monotonic()
    words = [sys.executable, "-m", "dnrpipe.cli", command, *options, "-w", str(root), "-q"]
    subprocess.run(words, check=True, cwd=root.parent)
    return time.monotonic() - started


def markdown(results: dict[str, Any]) -> str:
    """PSNR and seconds of every scene, and the mean differences over scenes with their 95% intervals."""
    rows = {(row["scene"], row["variant"]): row for row in results["rows"]}
    scenes = sorted({scene for scene, _ in rows})
    lines = [
        f"| scene | base image | {' | '.join(VARIANTS)} | {' | '.join(f'{name}, s' for name in VARIANTS)} |",
        "|---" * (2 + 2 * len(VARIANTS)) + "|",
    ]
    for scene in scenes:
        own = [rows[scene, variant] for variant in VARIANTS]
        figures = [own[0]["base"], *(row["psnr"] for row in own)]
        shown = [f"{figure:.2f}" for figure in figures] + [f"{row['seconds']:.0f}" for row in own]
        lines.append(f"| {scene} | {' | '.join(shown)} |")
    lines.append("")
    psnr = {variant: {scene: rows[scene, variant]["psnr"] for scene in scenes} for variant in VARIANTS}
    base = {scene: rows[scene, "untrained"]["base"] for scene in scenes}
    pairs = {"untrained to base image": {scene: psnr["untrained"][scene] - base[scene] for scene in scenes}}
    for name in ("untrained", "6 views", "25 views"):
        pairs[f"{name} to fresh"] = {scene: psnr[name][scene] - psnr["fresh"][scene] for scene in scenes}
    lines += [f"- {name}: {interval(values)} dB over {len(scenes)} scenes" for name, values in pairs.items()]
    shares = [rows[s, "untrained"]["seconds"] / rows[s, "fresh"]["seconds"] for s in scenes]
    return "\n".join([*lines, f"- untrained, of fresh's seconds before the first frame: {np.mean(shares):.0%}"])


def interval(differences: dict[str, float]) -> str:
    """Mean over scenes and its 95% interval (Student)."""
    found = summarise({(scene, 0): value for scene, value in differences.items()})
    assert found is not None
    if found.half is None:
        return f"{found.mean:+.2f}"
    return f"{found.mean:+.2f} [{found.mean - found.half:+.2f}, {found.mean + found.half:+.2f}]"


if __name__ == "__main__":
    main()
