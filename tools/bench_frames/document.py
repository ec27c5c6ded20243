"""Results as JSON (what was run, where, on what) and Markdown."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from dnrpipe.core.machine import processor
from dnrpipe.studies.cells.results import number
from dnrpipe.studies.frames.ours import BASE, NEURAL, SMOOTH, is_own
from dnrpipe.studies.frames.pareto_front import frontier
from dnrtrain.atomic import write_json, write_text

from . import equal_time, moving_tables

PACKAGES = ("mitsuba", "drjit", "mitsuba-oidn", "torch", "numpy")


def write(results: list[dict[str, Any]], path: Path) -> None:
    """``path`` (.json) and its Markdown beside it, atomically."""
    made = _made()
    for scene in results:
        scene.setdefault("made", made)  # scenes that were measured before keep theirs
    record = {"made": made, "scenes": results}
    write_json(path, record)
    write_text(path.with_suffix(".md"), markdown(record))


def _made() -> dict[str, Any]:
    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    return {
        "command": shlex.join(["python", "-m", "tools.bench_frames", *sys.argv[1:]]),
        "date": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "commit": git("rev-parse", "--short", "HEAD"),
        "changed_files": len(git("status", "--porcelain").splitlines()),
        "machine": f"{processor()}, {os.cpu_count()} cores, {platform.system()}",
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
    }


def markdown(record: dict[str, Any]) -> str:
    """The tables of a record of `write`."""
    lines = ["# Our frames against path tracing + Open Image Denoise at equal time", "", *overview(record)]
    for scene in record["scenes"]:
        lines += ["", *_scene(scene)]
    return "\n".join(lines) + "\n"


def overview(record: dict[str, Any]) -> list[str]:
    """Lines of what was run, and of the tables over all scenes."""
    made, scenes = record["made"], record["scenes"]
    first = scenes[0]["options"]
    lines = [
        f"`{made['command']}` on {made['machine']}, {made['date']}, commit {made['commit']}"
        f" ({made['changed_files']} files changed), load {made['load']:.1f} at the end.",
        "",
        f"Milliseconds by the {first['clock']} clock"
        + (f" (CPU time over {first['threads']} threads)" if first["clock"] == "cpu" else "")
        + ", median over the views, everything counted. PSNR in dB, display space over white.",
        "",
        *_overview(scenes),
    ]
    counted = equal_time.lines(scenes)
    if counted:
        lines += [
            "",
            "Everything counted, for so many frames: what came before the first one (passes, tracing, light, base"
            " images, training) is spread over them, and the rival gets that time for each of its frames.",
            "",
            *counted,
        ]
    moving = moving_tables.lines(scenes)
    return [*lines, "", *moving] if moving else lines


def _overview(scenes: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| scene | renderer | ms | dB | SSIM | LPIPS (VGG) | rival at that time | lead | rival draws level at |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for scene in scenes:
        for name, standing in scene["standing"].items():
            row = scene["rows"][name]
            at = f"{standing['rival_db']:.2f}" + (" (its cheapest)" if standing["cheapest"] else "")
            level = standing["crossover_ms"]
            end = f"{level:.0f} ms" if level is not None else f"not by {standing['ladder_end_ms']:.0f} ms"
            lines.append(
                f"| {scene['scene']} | {name} | {row['ms']:.1f} | {row['psnr']:.2f} | {row['ssim']:.4f} |"
                f" {number(row.get('lpips_vgg'), 4)} | {at} | {standing['lead_db']:+.2f} | {end} |"
            )
    return lines


def _scene(scene: dict[str, Any]) -> list[str]:
    width, height = scene["size"]
    reference = scene["reference"]
    lines = [
        f"## {scene['scene']}",
        "",
        f"{width}x{height}, {len(scene['views'])} test views, {scene['integrator']}, depth {scene['max_depth']}."
        f" Reference: {reference['spp']} spp, {reference['kind']}; its own noise caps PSNR at"
        f" {reference['ceiling_psnr']:.1f} dB.",
        "",
        "| renderer | ms | of which | dB | in the mask | SSIM | LPIPS (VGG) |",
        "|---|---|---|---|---|---|---|",
    ]
    shown = [*scene["standing"], *scene["frontier"]]
    for name in sorted(shown, key=lambda name: scene["rows"][name]["ms"]):
        row = scene["rows"][name]
        parts = ", ".join(f"{part} {ms:.1f}" for part, ms in row["parts"].items() if ms > 0)
        label = f"**{name}**" if is_own(name) else name
        lines.append(
            f"| {label} | {row['ms']:.1f} | {parts} | {row['psnr']:.2f} | {number(row.get('psnr_mask'), 2)} |"
            f" {row['ssim']:.4f} | {number(row.get('lpips_vgg'), 4)} |"
        )
    lines += [
        "",
        "| at most | best rival | dB | neural | base image alone | smoothed |",
        "|---|---|---|---|---|---|",
    ]
    per = {name: standing["classes"] for name, standing in scene["standing"].items()}
    for index, row in enumerate(next(iter(per.values()))):
        mine = [_best(per, index, kind) for kind in (NEURAL, BASE, SMOOTH)]
        lines.append(
            f"| {row['limit_ms']:.0f} ms | {row['rival'] or 'none'} | {number(row['rival_db'], 2)} |"
            f" {' | '.join(number(best, 2) for best in mine)} |"
        )
    for move, found in scene.get("moving", {}).items():
        lines += ["", *_moving(move, found)]
    return lines


def _moving(move: str, found: dict[str, Any]) -> list[str]:
    """A move's renderers, by their milliseconds; of the rivals those alone that nothing beats at their time."""
    rows = found["rows"]
    points = {name: (row["ms"], row["psnr"]) for name, row in rows.items() if not is_own(name)}
    shown = [*(name for name in rows if is_own(name)), *frontier(points)]
    lines = [
        f"{move.capitalize()} of {found['frames']} frames: means over six of them, against {found['reference_spp']}"
        f" samples ({found['reference']}). Flicker: mean absolute difference of the change from frame to frame, after"
        " reprojection, from the reference's, x 1000.",
        "",
        "| renderer | ms | dB | LPIPS | flicker |",
        "|---|---|---|---|---|",
    ]
    for name in sorted(shown, key=lambda name: rows[name]["ms"]):
        row = rows[name]
        label = f"**{name}**" if is_own(name) else name
        lines.append(
            f"| {label} | {row['ms']:.1f} | {row['psnr']:.2f} | {number(row.get('lpips_alex'), 4)} |"
            f" {1000 * row['flicker']:.2f} |"
        )
    return lines


def _best(per: dict[str, list[dict[str, Any]]], index: int, kind: str) -> float | None:
    """Our best within a class, among all numbers of rays."""
    found = [rows[index]["ours_db"] for name, rows in per.items() if name.startswith(kind)]
    return max((value for value in found if value is not None), default=None)
