"""The shipped corrector beside trained renderers, scene by scene: quality, and seconds before the first frame.

python -m tools.bench_untrained FOLDER [SCENE.blend ...] [--variants untrained,fresh] [--seed 1] [--out RESULTS.json]

FOLDER keeps the workspaces; rows that are in the results are not measured again. Without scenes: the example scenes.
`--seed` is of the trainings; PSNR in the table are means over the seeds, seconds those of the first where they are of
one run, and a renderer is paired with the one of its seed.
Variants, at the draft preset with 8 test views:

    untrained   --budget 0
    6 views     --budget 6, 180 steps on from the shipped corrector
    25 views    the preset: 25 views, 1000 steps on from the shipped corrector
    fresh       25 views, 1000 steps of a fresh network with guides in world space, grainy base images: the default
                before; its light is baked anew and counted

With `untrained` goes what `--budget auto` says of the scene: what its trial gained, and how many views it would take.

Seconds are processor time over two cores of the commands from `prepare` to the first frame: other work on the machine
does not stretch them much. Light and path depth pilot are made once, by `untrained`, and G-buffers of the candidates by
`6 views`; all that need them count them. Views are traced anew.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.cameras import spread
from dnrpipe.core.ledger import break_even_frames
from dnrpipe.core.scene_files import split_views
from dnrpipe.core.workspace import Workspace
from dnrpipe.stages.evaluate import BASELINE_VIEWS
from dnrpipe.studies.cells.intervals import difference, summarise
from dnrpipe.studies.frames.pareto_front import crossover, frontier
from dnrtrain.atomic import write_json

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "results" / "untrained.json"
TESTS = ("--set", "cameras.test=8", "--set", "cameras.val=0")
FRESH = (
    *("--set", "finetune.step2.start=fresh", "--set", "model.guides=true"),
    *("--set", "base.denoise=false", "--set", "base.light=traced"),
    *("--set", "base.light_size=512", "--set", "base.light_spp=64"),
)
VARIANTS: dict[str, tuple[str, ...]] = {
    "untrained": ("--budget", "0"),
    "6 views": ("--budget", "6", "--set", "finetune.step2.epochs=30"),
    "25 views": ("--budget", "25", "--set", "finetune.step2.epochs=40"),
    "fresh": ("--budget", "25", "--set", "finetune.step2.epochs=40", *FRESH),
}
TRAINED = ("6 views", "25 views", "fresh")
"""Variants that have seeds."""
BASES = {"base image": "untrained", "grainy base image": "fresh"}
"""What is corrected, by the variant whose it is."""
CORES = 2
FIGURES = ("psnr", "ssim", "lpips_alex", "flip")
RUNG_FIGURES = {"psnr": "psnr", "lpips": "lpips_alex"}
"""Of path tracing's ladder, and what a view's row calls them."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--variants", default=",".join(VARIANTS), help="in their order; untrained is always among them")
    parser.add_argument("--seed", type=int, default=0, help="of the trainings")
    parser.add_argument("--evaluation-spp", type=int, default=256, help="of the test views (before denoising)")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    chosen = [name for name in VARIANTS if name in ("untrained", *options.variants.split(","))]
    rows: list[dict[str, Any]] = json.loads(options.out.read_text())["rows"] if options.out.exists() else []
    for scene in options.scenes or sorted((ROOT / "blender_scenes").glob("*.blend")):
        own = [row for row in rows if (row["scene"], row["seed"]) == (scene.stem, options.seed)]
        if {row["variant"] for row in own} >= set(chosen):
            continue
        rows = [row for row in rows if row not in own]  # its seconds belong together
        rows += measured(scene.resolve(), options.folder / f"{scene.stem}.dnr", chosen, options)
        write_json(options.out, {"machine": f"{os.cpu_count()} cores", "rows": rows})
    print(markdown({"rows": rows}))


def measured(scene: Path, root: Path, variants: list[str], options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row per variant."""
    seed, evaluation_spp = options.seed, options.evaluation_spp
    rows: list[dict[str, Any]] = []
    shutil.rmtree(root, ignore_errors=True)
    chosen = (*TESTS, "--set", f"raytrace.evaluation_spp={evaluation_spp}", "--set", f"finetune.seed={seed}")
    prepared = run(root, "prepare", str(scene), "--set", "select.budget=0", *chosen)
    shared = light = 0.0
    for variant in variants:
        selecting = run(root, "select", *VARIANTS[variant])
        spent = selecting + run(root, "raytrace-selected", "--force") + run(root, "finetune")
        spent += 0 if variant in ("untrained", "fresh") else light
        run(root, "evaluate")
        metrics = json.loads((root / "evaluation" / "metrics.json").read_text())
        mean = metrics["mean"]
        figures: dict[str, Any] = {name: mean[name] for name in FIGURES}
        figures["frame"] = mean["seconds_base"] + mean["seconds_neural"]
        figures["rival"], figures["rival_views"] = metrics["baseline"], beside_rival(root, metrics["views"])
        seconds = round(prepared + shared + spent, 1)
        facts = {"scene": scene.stem, "variant": variant, "seed": seed, "evaluation_spp": evaluation_spp}
        rows.append({**facts, "base": mean["psnr_base"], **figures, "seconds": seconds})
        if variant == "6 views":
            shared += selecting
        elif variant == "untrained":
            ledger = [json.loads(line) for line in (root / "costs.jsonl").read_text().splitlines()]
            cpu = {r["name"]: r["cpu_seconds"] for r in ledger if r["name"] in ("light", "path depth pilot")}
            light, shared = cpu["light"] / CORES, cpu.get("path depth pilot", 0.0) / CORES
            run(root, "select", "--budget", "auto", "--set", "finetune.step2.epochs=40")
            rows[-1]["worth"] = json.loads((root / "selection.json").read_text())["details"]["worth"]
        print(f"{scene.stem}, {variant}: {mean['psnr']:.2f} dB, {seconds:.0f} s", flush=True)
    return rows


def beside_rival(root: Path, rows: list[dict[str, Any]]) -> dict[str, float]:
    """The renderer's mean PSNR and LPIPS on the test views that path tracing was measured on."""
    names = {view.name for view in spread(split_views(Workspace.open(root))["test"], BASELINE_VIEWS)}
    own = [row for row in rows if row["name"] in names]
    return {rung: float(np.mean([row[figure] for row in own])) for rung, figure in RUNG_FIGURES.items()}


def run(root: Path, command: str, *options: str) -> float:
    """Seconds of a command on the workspace: processor time of all its processes over CORES."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [sys.executable, "-m", "dnrpipe.cli", command, *options, "-w", str(root), "-q"]
    subprocess.run(words, check=True, cwd=root.parent)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / CORES


def markdown(results: dict[str, Any]) -> str:
    """PSNR and seconds of every scene, the mean differences over scenes with their 95% intervals, and N*."""
    rows = {(row["scene"], row["variant"], row["seed"]): row for row in results["rows"]}
    scenes = sorted({scene for scene, _, _ in rows})
    seeds = sorted({seed for _, _, seed in rows})
    variants = [name for name in VARIANTS if any(variant == name for _, variant, _ in rows)]

    def value(scene: str, variant: str, seed: int, figure: str) -> float | None:
        if variant in BASES:
            variant, figure = BASES[variant], "base"
        if variant not in TRAINED or figure == "base":
            seed = seeds[0]  # nothing in it depends on a seed
        return rows.get((scene, variant, seed), {}).get(figure)

    def mean(scene: str, variant: str, figure: str) -> float | None:
        counted = seeds[:1] if figure == "seconds" else seeds  # seconds are of one machine, and of one run
        own = [found for seed in counted if (found := value(scene, variant, seed, figure)) is not None]
        return float(np.mean(own)) if own else None

    heads = [*BASES, *variants, *(f"{name}, s" for name in variants), "trial", "auto"]
    lines = [f"| scene | {' | '.join(heads)} |", "|---" * (1 + len(heads)) + "|"]
    for scene in scenes:
        shown = []
        for names, figure, digits in (((*BASES, *variants), "psnr", 2), (variants, "seconds", 0)):
            values = [mean(scene, name, figure) for name in names]
            shown += ["-" if value is None else f"{value:.{digits}f}" for value in values]
        worth = rows[scene, "untrained", seeds[0]].get("worth")
        shown += ["-", "-"] if worth is None else [f"{worth['gain']:+.2f} dB", f"{worth['views']} views"]
        lines.append(f"| {scene} | {' | '.join(shown)} |")
    lines.append("")
    pairs = [("untrained", base) for base in BASES]
    pairs += [(name, "fresh") for name in ("untrained", *TRAINED) if name in variants and name != "fresh"]
    for name, other in pairs:
        both = {
            (scene, seed): own - compared
            for scene in scenes
            for seed in (seeds if {name, other} & set(TRAINED) else seeds[:1])
            if (own := value(scene, name, seed, "psnr")) is not None
            and (compared := value(scene, other, seed, "psnr")) is not None
        }
        found = summarise(both)
        if found is not None:
            worst, least = min(found.scenes.items(), key=lambda item: item[1])
            told = f"over {len(found.scenes)} scenes, {len(both)} pairs, worst {least:+.2f} ({worst})"
            lines.append(f"- {name} to {other}: {difference(found)} dB {told}")
    both = [(mean(scene, "untrained", "seconds"), mean(scene, "fresh", "seconds")) for scene in scenes]
    shares = [ours / fresh for ours, fresh in both if ours and fresh]
    if shares:
        told = f"{np.mean(shares):.0%} ({len(shares)} scenes)"
        lines.append(f"- untrained, of fresh's seconds before the first frame: {told}")
    return "\n".join(lines + break_evens(results["rows"]))


def break_evens(rows: list[dict[str, Any]]) -> list[str]:
    """A table of N*, the number of frames from which a renderer is cheaper than path tracing with a denoiser that is as
    good. Of rows that have a rival, the first seed's."""
    timed = {(row["scene"], row["variant"]): row for row in reversed(rows) if row.get("rival")}
    if not timed:
        return []
    names = ("untrained", "6 views")
    heads = [f"{name}, {what}" for name in names for what in ("ms a frame", "N* at equal PSNR", "N* at equal LPIPS")]
    lines = ["", f"| scene | {' | '.join(heads)} |", "|---" * (1 + len(heads)) + "|"]
    for scene in sorted({scene for scene, _ in timed}):
        shown = [cell for name in names for cell in break_even_cells(timed.get((scene, name)))]
        lines.append(f"| {scene} | {' | '.join(shown)} |")
    return lines


def break_even_cells(row: dict[str, Any] | None) -> list[str]:
    """Milliseconds of a frame, N* at equal PSNR and at equal LPIPS."""
    if row is None:
        return ["-"] * 3
    cells = [f"{1000 * row['frame']:.0f}"]
    for figure, own in row["rival_views"].items():
        fewest = break_even_frames(row["seconds"], rival_seconds(row["rival"], figure, own), row["frame"])
        cells.append("never" if fewest is None else str(fewest))
    return cells


def rival_seconds(rungs: list[dict[str, float]], figure: str, own: float) -> float:
    """Of a frame of path tracing with that PSNR or LPIPS, between its rungs; beyond its best, the best's, which is less
    than it would take."""
    sign = -1 if figure == "lpips" else 1
    points = {str(rung["spp"]): (rung["seconds"], sign * rung[figure]) for rung in rungs}
    line = [points[name] for name in frontier(points)]
    found = crossover(line, sign * own)
    return line[-1][0] if found is None else found


if __name__ == "__main__":
    main()
