"""Shots: what `dnrpipe shot` takes and gives, beside path tracing with a denoiser at equal quality.

python -m tools.bench_shots FOLDER [SCENE.blend ...] [--size 640x360] [--frames 48] [--out RESULTS.json]

The file's own camera moves on an arc about what it looks at, half a degree a frame. Seconds are wall-clock of a machine
that does nothing else; those of REEL frames are reckoned from the parts that were measured, among them the light that
so many frames would have. FOLDER keeps workspaces and references; a scene that is in the results is not measured again.
Quality is over white, against the mean of two pictures of 64 samples, each denoised, on pairs of frames one after the
other; flicker is what changes between the two of a pair beyond what the references change by
(`tools.bench_frames.motion`). Path tracing climbs the ladder until it is as good: Mitsuba's, and Blender's Cycles,
which is measured against pictures of its own. A row that lacks Cycles gets it where FOLDER still has the shot.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.blender.tasks import CyclesAnswer, CyclesTask
from dnrpipe.core.cameras import look_at_view, shot_views
from dnrpipe.core.console import Console
from dnrpipe.core.images import flip_error, picture_of
from dnrpipe.core.ledger import break_even_frames
from dnrpipe.core.machine import processor
from dnrpipe.core.scene_files import read_summary
from dnrpipe.core.settings import CameraSettings
from dnrpipe.core.workspace import Workspace
from dnrpipe.stages.session import resolve_settings
from dnrpipe.stages.shot_scene import look_at_shot
from dnrpipe.stages.shots.frame_tasks import FrameTask, Way
from dnrpipe.stages.shots.make_shot import lpips_of
from dnrpipe.stages.shots.open_shot import parse_size
from dnrpipe.stages.shots.references import compared, display_of, shown
from dnrpipe.stages.shots.render_frames import FRAMES_FOLDER, frame_outcomes, in_succession
from dnrpipe.stages.shots.renderers import path_tracer
from dnrpipe.stages.stage import Run
from dnrpipe.studies.frames.pareto_front import crossover
from dnrpipe.workers.task_list import run_tasks
from dnrpipe.workers.view_tasks import worker_count
from dnrtrain.atomic import write_json
from dnrtrain.contract import View, write_cameras
from dnrtrain.exr import read_exr

from .bench_frames.motion import Surface, flicker
from .bench_frames.moving_tables import FLICKER

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "results" / "shots.json"
REEL = 240
DEGREES = 0.5
"""That the camera moves on its arc from frame to frame."""
LADDERS = {"balanced": (1, 2, 4, 8, 16), "high": (1, 2, 4, 8, 16, 32, 64)}
"""Samples by the quality of the denoiser."""
AT_ONCE = 5
"""Rungs of a ladder that are measured before it is asked whether one of them is as good."""
CYCLES_LADDER = ((1, 2, 4, 8, 16), (32, 64))
"""Samples of Cycles, in parts: the second where nothing in the first is as good."""
CYCLES_DENOISERS = {"denoised-fast": "fast", "denoised": "high"}
"""Its denoisers (`cycles_frames.METHODS`), by what the results call them."""
CYCLES_REFERENCE = 64
REFERENCE, TAKES = Way(name="path", spp=64), (1, 2)
"""A reference's pictures, and their numbers; rungs are take 0."""
SEEDS = 1 << 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    size = parse_size(options.size)
    rows: list[dict[str, Any]] = json.loads(options.out.read_text())["rows"] if options.out.exists() else []
    for scene in options.scenes or sorted((ROOT / "blender_scenes").glob("*.blend")):
        place = (scene.stem, options.size, options.frames)
        row = next((row for row in rows if (row["scene"], row["size"], row["frames"]) == place), None)
        root = root_of(options.folder, scene.stem, options.size).resolve()
        if row is None:
            row = {
                "machine": processor(),
                "size": options.size,
                **measured(scene.resolve(), root, size, options.frames),
            }
            rows.append(row)
            save(options.out, rows)
        elif "cycles" in row or row["machine"] != processor() or not reference_of(root).exists():
            continue
        row["cycles"] = by_cycles(root, options.frames, row["ours"])
        save(options.out, rows)
    print(markdown({"rows": rows}))


def save(path: Path, rows: list[dict[str, Any]]) -> None:
    """By scene; after Cycles and before: it takes as long as the rest."""
    write_json(path, {"rows": sorted(rows, key=lambda row: row["scene"])})


def measured(scene: Path, root: Path, size: tuple[int, int], frames: int) -> dict[str, Any]:
    """A row of the results."""
    root.mkdir(parents=True, exist_ok=True)
    looked_at = root.with_name(f"arc-{root.name}")  # the shot converts the scene itself
    views = arc(scene, looked_at, size, frames)
    cameras = root.with_suffix(".json")
    write_cameras(cameras, views, "arc")
    named = ("--cameras", str(cameras), "-w", str(root), "--name", "arc", "--preset", "standard")
    words = ("shot", str(scene), *named, "--plan-for", str(REEL), "--json")
    started = time.monotonic()
    answer = subprocess.run([sys.executable, "-m", "dnrpipe.cli", *words], check=True, stdout=subprocess.PIPE)
    seconds = time.monotonic() - started
    shot = json.loads(answer.stdout)
    print(f"{scene.stem}: {frames} frames in {seconds:.0f} s by {shot['chosen']['way']['name']}", flush=True)
    pairs = [(i - 1, i) for i in places(frames)]
    found = beside(root, views, pairs)
    after = seconds - shot["check"]["seconds"]
    frame = float(np.median(frame_seconds(root)))
    return {
        "scene": scene.stem,
        "frames": frames,
        "seconds": seconds,
        "before": max(0.0, after - frames * frame),
        "frame": frame,
        "chosen": shot["chosen"],
        "filtered": True,
        "why": shot["why"],
        "expected": shot["expected"],
        "spent": shot["spent"],
        "check": shot["check"],
        **found,
    }


def arc(scene: Path, looked_at: Path, size: tuple[int, int], frames: int) -> list[View]:
    """The scene's own camera, moved about the point that it looks at as far away as the middle of the scene.

    looked_at: a workspace of the scene, which this prepares.
    """
    words = ("prepare", str(scene), "-w", str(looked_at), "-q", "--set", "select.budget=0")
    subprocess.run([sys.executable, "-m", "dnrpipe.cli", *words], check=True)
    own = shot_views(look_at_shot(scene, (1,), None, looked_at / "logs" / "arc.log"), *size)[0]
    summary = read_summary(looked_at / "scene")
    matrix = own.matrix
    forward = -matrix[:3, 2]
    away = max(float((np.asarray(summary.bounds.center) - own.position) @ forward), 0.2 * summary.bounds.radius)
    target = own.position + away * forward
    settings = CameraSettings(width=size[0], height=size[1])
    views = []
    for number in range(frames):
        turn = math.radians(DEGREES * (number - frames / 2))
        rotation = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        eye = target + rotation @ (own.position - target)
        views.append(look_at_view(f"{number + 1:05d}", eye, target, own.fl_x, settings))
    return views


def beside(root: Path, views: Sequence[View], pairs: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """Quality of the shot's frames, and of path tracing with seconds per frame, on pairs of frames."""
    run = opened(root)
    lpips, display = lpips_of(run), display_of(run)
    tracer = path_tracer(run, background=True)
    numbers = sorted({number for pair in pairs for number in pair})

    def traced(ways: Sequence[tuple[Way, int]]) -> list[float]:
        """Path trace the frames by each way, in one process -> median seconds a frame, by way. The number beside a way
        tells several pictures of one frame apart."""
        tasks = [
            FrameTask(
                view=views[number],
                way=way,
                seed=SEEDS * take + number,
                output=path_of(way, take, number),
                picture=path_of(way, take, number).with_suffix(".png"),
                fingerprint="",
            )
            for way, take in ways
            for number in numbers
        ]
        spent = []
        tasks = in_succession(tasks)  # as a shot's own
        for task, outcome in zip(tasks, frame_outcomes(run, tracer, tasks, "beside"), strict=True):
            if outcome.result is None:
                raise SystemExit(f"{task.output}: {outcome.error}")
            spent.append(outcome.result["seconds"] + outcome.result["write_seconds"])
        return [float(np.median(each)) for each in np.reshape(spent, (len(ways), len(numbers)))]

    def path_of(way: Way, take: int, number: int) -> Path:
        return folder_of_rung(root, way.spp, way.quality, take) / f"{number:05d}.exr"

    traced([(REFERENCE, take) for take in TAKES])
    takes = [{n: shown(display, path_of(REFERENCE, take, n)) for n in numbers} for take in TAKES]
    surfaces = {n: surface_of(views[n], path_of(REFERENCE, TAKES[0], n)) for n in numbers}

    def figures(file_of: Any) -> dict[str, float]:
        return quality({n: shown(display, file_of(n)) for n in numbers}, takes, surfaces, pairs, lpips)

    ours = figures(lambda n: root / "shots" / "arc" / FRAMES_FOLDER / f"{n + 1:05d}.exr")
    rungs: list[dict[str, Any]] = []
    for denoiser, ladder in LADDERS.items():
        ways = [Way.model_validate({"name": "path", "spp": spp, "quality": denoiser}) for spp in ladder]
        for part in filter(None, (ways[:AT_ONCE], ways[AT_ONCE:])):
            for way, seconds in zip(part, traced([(way, 0) for way in part]), strict=True):
                found = figures(lambda n, way=way: path_of(way, 0, n))
                rungs.append({"spp": way.spp, "quality": denoiser, "frame": seconds, **found})
            if any(as_good(rung, ours, ("psnr", "lpips")) for rung in rungs if rung["quality"] == denoiser):
                break
    return {"ours": ours, "rungs": rungs, "pairs": len(pairs)}


def by_cycles(root: Path, frames: int, ours: dict[str, float]) -> list[dict[str, Any]]:
    """Rungs of Cycles on the compared frames, as those of `beside`: of what lies in the shot's workspace."""
    run = opened(root)
    lpips, display = lpips_of(run), display_of(run)
    pairs = [(i - 1, i) for i in places(frames)]
    numbers = sorted({number for pair in pairs for number in pair})
    files = {n: reference_of(root) / f"{n:05d}.exr" for n in numbers}
    views = {n: View.model_validate(read_exr(path)[1]["view"]) for n, path in files.items()}
    surfaces = {n: surface_of(views[n], path) for n, path in files.items()}
    folder = root / "beside" / "cycles"

    def rendered(samples: Sequence[int], methods: Sequence[str], seed: int) -> CyclesAnswer:
        task = CyclesTask(
            scene_dir=run.workspace.scene,
            views=tuple(views.values()),
            samples=tuple(samples),
            methods=tuple(methods),
            seed=seed,
            background=True,
            folder=folder / str(seed),
            output=folder / str(seed) / "frames.json",
        )
        task.folder.mkdir(parents=True, exist_ok=True)
        worker = "dnrpipe.blender.passes.cycles_frames"
        (outcome,) = run_tasks(worker, {"threads": worker_count(0)}, [task.data()], workers=1, log=run.log)
        if outcome.result is None:
            raise SystemExit(f"Cycles: {outcome.error}")
        return CyclesAnswer.model_validate(outcome.result)

    def pictures(name: str, seed: int) -> dict[int, Any]:
        return {n: shown(display, folder / str(seed) / name / f"{view.name}.exr") for n, view in views.items()}

    for take in TAKES:
        rendered([CYCLES_REFERENCE], ["denoised"], take)
    takes = [pictures(f"{CYCLES_REFERENCE} spp denoised", take) for take in TAKES]
    rungs: list[dict[str, Any]] = []
    for ladder in CYCLES_LADDER:
        answer = rendered(ladder, list(CYCLES_DENOISERS), 0)
        for spp in ladder:
            for method, denoiser in CYCLES_DENOISERS.items():
                name = f"{spp} spp {method}"
                found = quality(pictures(name, 0), takes, surfaces, pairs, lpips)
                rungs.append(
                    {"spp": spp, "quality": denoiser, "frame": float(np.median(answer.seconds[name])), **found}
                )
        if any(as_good(rung, ours, ("psnr", "lpips")) for rung in rungs):
            break
    return rungs


def opened(root: Path) -> Run:
    """The shot's workspace, to render more of its frames in."""
    workspace = Workspace.open(root)
    return Run(workspace, resolve_settings(workspace, {}, None), Console(quiet=True), "render", "bench")


def places(frames: int) -> tuple[int, int]:
    """Of the frames that are compared; with each of them goes the one before. Not the last, which has none after it."""
    return frames // 3, frames - 2


def root_of(folder: Path, scene: str, size: str) -> Path:
    """A shot's workspace."""
    return folder / f"{scene}-{size}.dnr"


def reference_of(root: Path) -> Path:
    """A reference's first picture of each frame that is compared."""
    return folder_of_rung(root, REFERENCE.spp, REFERENCE.quality, TAKES[0])


def folder_of_rung(root: Path, spp: int, denoiser: str, take: int) -> Path:
    """Path-traced frames. take: of several pictures of one frame."""
    return root / "beside" / f"{spp}-{denoiser}-{take}"


def quality(
    pictures: dict[int, Any],
    takes: Sequence[dict[int, Any]],
    surfaces: dict[int, Surface],
    pairs: Sequence[tuple[int, int]],
    lpips: Any,
) -> dict[str, float]:
    """psnr, ssim, lpips and flip, means over the frames; flicker and flicker_rms over the pairs.

    takes: two references whose noise is independent. Their mean is the truth.
    """
    truth: dict[int, Any] = {n: sum(take[n] for take in takes) / len(takes) for n in pictures}
    rows = [
        {
            **compared(picture, truth[n], lpips),
            "flip": flip_error(picture_of(truth[n][0]), picture_of(picture[0]))[0],
        }
        for n, picture in pictures.items()
    ]
    found = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    planes, true, first, second = (
        {n: picture_of(picture[0]).astype(np.float64) for n, picture in kind.items()}
        for kind in (pictures, truth, *takes)
    )
    changes = []
    for pair in pairs:
        ours, theirs, one, other = ([kind[n] for n in pair] for kind in (planes, true, first, second))
        changes.append(flicker(ours, theirs, [surfaces[n] for n in pair], (one, other)))
    return found | {name: float(np.mean([change[name] for change in changes])) for name in FLICKER}


def surface_of(view: View, path: Path) -> Surface:
    """What a frame's file says of what its camera sees."""
    channels, _ = read_exr(path)
    depth = channels["depth.Z"].astype(np.float64)
    directions = view.ray_directions().astype(np.float64)
    along = directions @ -view.matrix[:3, 2]
    position = view.position + directions * (depth / along)[..., None]
    return Surface(view, position, depth, channels["object.Id"] > 0.5)


def frame_seconds(root: Path) -> list[float]:
    """Of the shot's frames, files included, by the ledger."""
    rows = [json.loads(line) for line in (root / "costs.jsonl").read_text().splitlines()]
    return [row["seconds"] for row in rows if row["name"].startswith(f"{FRAMES_FOLDER}/")]


def equal_rung(row: dict[str, Any], names: Sequence[str]) -> dict[str, Any] | None:
    """The cheapest path tracing that is as good as ours by each of the figures, Mitsuba's or Cycles'; None: not by the
    last rung of either.

    A shot that is path-traced and not filtered, as older ones, is as good as the rung that it is, whose frames take
    what the shot's do: there are more of those, and seconds of few frames vary by up to a fifth.
    """
    own = Way.model_validate(row["chosen"]["way"])  # in records, defaults are left out
    plain = own.name == "path" and not row.get("filtered")
    same = [plain and (rung["spp"], rung["quality"]) == (own.spp, own.quality) for rung in row["rungs"]]
    enough = [
        rung | {"frame": row["frame"]} if it_is else rung
        for rung, it_is in zip(row["rungs"], same, strict=True)
        if it_is or as_good(rung, row["ours"], names)
    ]
    enough += [rung for rung in of_cycles(row) if as_good(rung, row["ours"], names)]
    return min(enough, key=lambda rung: rung["frame"], default=None)


def seconds_as_good(row: dict[str, Any], names: Sequence[str]) -> float | None:
    """Of a frame of path tracing that is as good as ours by each of the figures and no better, its samples between the
    rungs'; None: not by the last rung.

    By the logarithm of the samples, dB and the logarithms of other figures are reckoned to be straight between rungs;
    seconds by the samples.
    """

    def height(rung: dict[str, float], name: str) -> float:
        return rung[name] if name == "psnr" else -math.log(rung[name])

    ladders: dict[tuple[bool, str], list[dict[str, Any]]] = {}
    for rung in (*row["rungs"], *of_cycles(row)):
        ladders.setdefault(("cycles" in rung, rung["quality"]), []).append(rung)
    found = []
    for rungs in ladders.values():
        rungs.sort(key=lambda rung: rung["spp"])
        needed = [
            crossover([(rung["spp"], height(rung, name)) for rung in rungs], height(row["ours"], name))
            for name in names
        ]
        enough = [count for count in needed if count is not None]
        if len(enough) == len(needed):
            samples, seconds = ([rung[key] for rung in rungs] for key in ("spp", "frame"))
            found.append(np.interp(max(enough), samples, seconds))
    return float(min(found)) if found else None


def last_rung(row: dict[str, Any]) -> dict[str, Any]:
    """Of the most samples, denoised best; of both tracers' the quicker: what is as good takes longer than that."""
    return min((rungs[-1] for rungs in (row["rungs"], of_cycles(row)) if rungs), key=lambda rung: rung["frame"])


def of_cycles(row: dict[str, Any]) -> list[dict[str, Any]]:
    """The row's rungs of Cycles, which know it."""
    return [{**rung, "cycles": True} for rung in row.get("cycles", [])]


def named(rung: dict[str, Any]) -> str:
    """As ``8 spp, high`` or ``Cycles, 8 spp, high``."""
    return f"{'Cycles, ' if 'cycles' in rung else ''}{rung['spp']} spp, {rung['quality']}"


def as_good(rung: dict[str, Any], own: dict[str, Any], names: Sequence[str]) -> bool:
    """Whether path tracing is at least as good as ours by each of the figures."""
    return all(rung[name] >= own[name] if name in ("psnr", "ssim") else rung[name] <= own[name] for name in names)


def markdown(results: dict[str, Any]) -> str:
    """Two tables for each machine: each scene's part of path tracing's time and flicker; and what that is made of."""
    by_machine: dict[str, list[dict[str, Any]]] = {}
    for row in results["rows"]:
        by_machine.setdefault(row["machine"], []).append(row)
    parts = [f"Measured on {machine}.\n\n{_ratios(rows)}\n\n{_table(rows)}" for machine, rows in by_machine.items()]
    return "\n\n".join(parts) or "Not measured yet."


def _ratios(rows: Sequence[dict[str, Any]]) -> str:
    """A line a scene: the shot's part of path tracing's time and flicker, at each size."""
    sizes = sorted({row["size"] for row in rows}, key=parse_size, reverse=True)
    of_place = {(row["scene"], row["size"]): row for row in rows}
    found = [[of_place.get((scene, size)) for size in sizes] for scene in {row["scene"]: None for row in rows}]
    found.sort(key=lambda each: [time_ratios(row)[0] if row else math.inf for row in each])
    heads = [f"{size}: time | between rungs | flicker | without noise" for size in sizes]
    lines = [f"| scene | {' | '.join(heads)} |", f"|{'---|' * (1 + 4 * len(sizes))}"]
    for each in found:
        cells = [next(row["scene"] for row in each if row)]
        for row in each:
            numbers = (*time_ratios(row), *flicker_ratios(row)) if row else (math.nan,) * 4
            texts = ["" if math.isnan(number) else f"{number:.2f}" for number in numbers]
            bound = "< " if row and not equal_rung(row, ("psnr", "lpips")) else ""
            cells += [bound + texts[0], *texts[1:]]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def time_ratios(row: dict[str, Any]) -> tuple[float, float]:
    """Of REEL frames, by the rung that is as good and by the line between rungs; where none is as good, the last one
    bounds the former, and the latter is not known."""
    rung = equal_rung(row, ("psnr", "lpips")) or last_rung(row)
    exact = seconds_as_good(row, ("psnr", "lpips"))
    ours = row["before"] / REEL + row["frame"]
    return ours / rung["frame"], math.nan if exact is None else ours / exact


def flicker_ratios(row: dict[str, Any]) -> tuple[float, ...]:
    """Of the mean change, and of its root mean square without the reference's noise (older rows lack that)."""
    rung = equal_rung(row, ("psnr", "lpips")) or last_rung(row)
    return tuple(row["ours"][name] / rung[name] if name in row["ours"] else math.nan for name in FLICKER)


def _table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| scene | size | way, rays | before the first frame, s | a frame, s | dB | LPIPS | FLIP | flicker"
        " | path tracing as good (dB and LPIPS) | its frame, s | its flicker"
        " | 240 frames, s | path tracing, s | ratio | between rungs | N* at equal PSNR | at equal LPIPS |",
        "|---" * 18 + "|",
    ]
    for row in rows:
        own, rung = row["ours"], equal_rung(row, ("psnr", "lpips"))
        ours = row["before"] + REEL * row["frame"]
        chosen = row["chosen"]["way"]
        way = f"{chosen['name']}{', smoothed,' if chosen.get('smooth') else ''} {chosen['spp']}"
        cells = [row["scene"], row["size"], way, f"{row['before']:.0f}", f"{row['frame']:.2f}"]
        cells += [f"{own['psnr']:.2f}", f"{own['lpips']:.4f}", f"{own['flip']:.4f}", flicker_of(own)]
        last = rung or last_rung(row)
        over, under = ("", "") if rung else ("> ", "< ")
        cells += [named(last) if rung else f"not by {named(last)}", f"{over}{last['frame']:.2f}", flicker_of(last)]
        by_rungs, between = time_ratios(row)
        cells += [f"{ours:.0f}", f"{over}{REEL * last['frame']:.0f}", f"{under}{by_rungs:.2f}"]
        cells.append("" if math.isnan(between) else f"{between:.2f}")
        cells += [break_even(row, name) for name in ("psnr", "lpips")]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def flicker_of(figures: dict[str, float]) -> str:
    """x 1000; rows of before the second was known lack it."""
    return " / ".join(f"{1000 * figures[name]:.1f}" for name in FLICKER if name in figures)


def break_even(row: dict[str, Any], name: str) -> str:
    """N*: from how many frames on the shot is cheaper than path tracing as good by the figure."""
    rung = equal_rung(row, (name,))
    traced = (rung or last_rung(row))["frame"]
    fewest = break_even_frames(row["before"], traced, row["frame"])
    return "never" if fewest is None else f"{fewest}" if rung else f"< {fewest}"


if __name__ == "__main__":
    main()
