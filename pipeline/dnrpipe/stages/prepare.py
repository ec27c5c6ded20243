"""Stage `prepare`: scene file -> census, Mitsuba bundle, cameras, raster passes and G-buffers."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from dnrtrain.atomic import write_json
from dnrtrain.contract import SPLITS, View, write_cameras

from ..blender.findings import finding_lines
from ..blender.tasks import (
    BakeCommon,
    BakeOptions,
    BakeTask,
    InspectAnswer,
    InspectTask,
    PassesCommon,
    PassesTask,
    PendingBakes,
    PrepareAnswer,
    PrepareTask,
    ShotTask,
)
from ..core.cameras import automatic_source, depth_range, make_cameras
from ..core.console import Console
from ..core.errors import UserError
from ..core.scene_files import (
    read_census,
    read_conversion,
    read_frame,
    read_raster_choice,
    read_summary,
    scene_fingerprint,
    split_views,
)
from ..core.scene_records import Conversion, RasterChoice, SceneSummary
from ..core.settings import Settings
from ..core.shot_records import ShotFacts
from ..core.workspace import Workspace, digest, file_sha256
from ..effects.store import keep_plan
from ..workers.placement import HERE, Placement
from ..workers.task_list import Retry, run_tasks
from ..workers.view_tasks import warn_of_repairs, warn_of_retries, worker_count
from .base_images import RENDERED
from .stage import Outcome, Run

Answer = TypeVar("Answer", PrepareAnswer, InspectAnswer, ShotFacts)
MAX_BAKE_ROUNDS = 4
"""Values whose need shows only after others are baked take further rounds; two are the rule."""
BAKES = "bakes"
"""Of a workspace: baked values by content hash. They outlive ``--force`` and changes elsewhere in the file."""
PASSES_VERSION = 1
GEOMETRY_ENGINE = "cycles-direct"
"""Draws passes that have no rasterised colour."""


def prepare(run: Run) -> Outcome:
    """Do what is missing: convert the scene, place the cameras, render the passes."""
    summary, views = scene_and_views(run)
    _plan_effects(run)
    drawn = needed_passes(run.settings)
    draw_splits(run, drawn)
    chosen = read_raster_choice(run.workspace)
    placed = {split: [view.model_dump(mode="json") for view in views[split]] for split in SPLITS}
    passes = run.settings.passes.model_dump(exclude={"workers"})
    return Outcome(
        digest([PASSES_VERSION, run.scene_fingerprint, placed, passes]),
        {
            "raster_engine": chosen.engine if chosen else "",
            "raster_reason": chosen.reason if chosen else "",
            "views": {split: len(views[split]) for split in SPLITS},
            "drawn": drawn,
            "triangles": summary.triangles,
        },
    )


def needed_passes(settings: Settings) -> dict[str, bool]:
    """Splits whose passes later stages read under the settings -> whether with rasterised colour. With ``budget =
    auto`` that is not known yet: none are drawn of the candidates.

    G-buffers of candidates say what they see. Base images that are rendered bring G-buffers of their own. Rasterised
    colour is what step 1 trains on, and one kind of base image.
    """
    raster = settings.model.base == "raster"
    needed: dict[str, bool] = {}
    if settings.select.budget not in (0, "auto"):
        needed["train"] = settings.trains_step1 or raster
    if settings.trains_step1:
        needed["val"] = True
    if settings.model.base not in RENDERED:
        needed["test"] = raster
    return needed


def draw_splits(run: Run, splits: dict[str, bool]) -> None:
    """Draw the passes of the splits, those that are missing or out of date. splits: as of `needed_passes`."""
    views = split_views(run.workspace)
    wanted = [(split, view) for split in splits for view in views.get(split, [])]
    tasks = draw_passes(
        run,
        "passes",
        [view for _, view in wanted],
        [run.workspace.passes(split, view.name) for split, view in wanted],
        _raster_engine(run).engine if any(splits.values()) else GEOMETRY_ENGINE,
        raster=[splits[split] for split, _ in wanted],
    )
    warn_of_repairs(tasks, run.console)


def draw_missing(run: Run, needed: dict[str, bool]) -> None:
    """Draw what `prepare` did not, under the settings that it ran with, and book it as drawn."""
    prepared = run.workspace.manifest.prepared
    assert prepared is not None  # stages that read passes need it
    due = {split: colour for split, colour in needed.items() if colour > prepared.drawn.get(split, -1)}
    if due:
        draw_splits(run, due)
        run.workspace.manifest.stages["prepare"].detail["drawn"] = prepared.drawn | due
        run.workspace.save()


def _plan_effects(run: Run) -> None:
    """Write the effect plan, as far as it is known without its pilot, and say what is on."""
    plan = run.effect_plan
    keep_plan(run.workspace, plan)
    named = [effect.title for effect in plan.effects if effect.on and effect.part == "light"]
    run.console.say(f"effects: {', '.join(named) or 'none'} (`dnrpipe effects` says why)")


def scene_and_views(run: Run) -> tuple[SceneSummary, dict[str, list[View]]]:
    """Convert the scene and place the cameras, where that is not done: (summary, views by split). No passes."""
    summary = convert_scene(run)
    if run.settings.cameras.source == "auto":
        run.console.say(f"cameras: {automatic_source(summary)[1]} (--cameras dome or inside decides otherwise)")
    return summary, _place_cameras(run.workspace, run.settings, summary)


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(passes on disk, passes wanted)."""
    prepared = workspace.manifest.prepared
    wanted = sum(prepared.views.get(split, 0) for split in prepared.drawn) if prepared else settings.cameras.train
    present = sum(1 for split in SPLITS for _ in (workspace.root / "passes" / split).glob("[!.]*.exr"))
    return min(present, wanted), wanted


def draw_passes(
    run: Run,
    label: str,
    views: Sequence[View],
    paths: Sequence[Path],
    engine: str,
    *,
    raster: Sequence[bool],
) -> list[dict[str, Any]]:
    """G-buffers of the views, those that are missing or out of date, by Blender. Returns all tasks.

    Args:
        raster: for each view, whether it gets rasterised colour.
    """
    passes = run.settings.passes
    common = PassesCommon(
        scene_dir=run.workspace.scene,
        raster_engine=engine,
        raster_samples=passes.raster_samples,
        coverage_samples=passes.coverage_samples,
    )
    tasks = []
    for view, path, coloured in zip(views, paths, raster, strict=True):
        colour = [engine, passes.raster_samples] if coloured else None
        view_data = view.model_dump(mode="json")
        fingerprint = digest([PASSES_VERSION, run.scene_fingerprint, view_data, passes.coverage_samples, colour])
        tasks.append(PassesTask(view=view, output=path, raster=coloured, fingerprint=fingerprint).data())
    run.view_tasks(
        label,
        "dnrpipe.blender.passes.worker",
        common.data(),
        tasks,
        workers=worker_count(passes.workers),
        book=run.book_views("cpu"),
    )
    return tasks


def convert_scene(run: Run) -> SceneSummary:
    """Open the scene in a worker and write ``scene/``, whole or not at all."""
    workspace, settings, console = run.workspace, run.settings, run.console
    marker = workspace.scene / "prepared.json"
    if marker.exists() and read_conversion(workspace.scene).fingerprint == scene_fingerprint(workspace):
        summary = read_summary(workspace.scene)
        if summary.bake_size in (None, settings.passes.bake_size):
            _refuse_if_strict(Path(workspace.manifest.source.path), workspace.scene, settings)
            return summary
    source = Path(workspace.manifest.source.path)
    if not source.is_file():
        raise UserError(f"{source}: the scene file is gone; run `dnrpipe prepare SCENE` with its new place")
    console.say(f"converting {source.name}")
    started = time.monotonic()
    fresh = workspace.root / "scene.new"
    if fresh.exists():
        shutil.rmtree(fresh)
    _run_conversion(run, source, fresh)
    _refuse_if_strict(source, fresh, settings)
    # The old scene stays until the new one is whole; killed in between, the next run converts again.
    if workspace.scene.exists():
        shutil.rmtree(workspace.scene)
    fresh.rename(workspace.scene)
    summary = read_summary(workspace.scene)
    for warning in summary.warnings:
        console.warn(warning)
    _show_findings(workspace, console)
    run.book("training", "scene", "convert", time.monotonic() - started)
    # frame.json is not among them: near and far follow the cameras.
    files = {
        str(path.relative_to(workspace.scene)): file_sha256(path)
        for path in sorted(workspace.scene.rglob("[!.]*"))
        if path.is_file() and path.name != "frame.json"
    }
    write_json(marker, Conversion(fingerprint=scene_fingerprint(workspace), files=files).data())
    return summary


def _run_conversion(run: Run, source: Path, folder: Path) -> None:
    """Convert; where the worker asks for bakes, bake them and convert again."""
    workspace, settings = run.workspace, run.settings
    size, refused = settings.passes.bake_size, list[str]()
    for _ in range(MAX_BAKE_ROUNDS):
        bakes = BakeOptions(folder=workspace.root / BAKES, size=size, refused=tuple(refused))
        task = PrepareTask(source=source, scene_dir=folder, strict=settings.strict, bakes=bakes)
        with run.console.bar("scene", 1) as bar:
            answer, first_failure = open_scene("dnrpipe.blender.prepare", task, PrepareAnswer, run.log)
            bar.advance()
        if first_failure:
            run.console.warn(f"scene: {first_failure}; opening it once more went well")
        if answer.bakes is None:
            return
        refused += bake(run, source, folder / "geometry.npz", answer.bakes)
    raise RuntimeError(f"{source}: the same textures are to be baked again and again")


def open_scene(
    module: str, task: PrepareTask | InspectTask | ShotTask, answer: type[Answer], log: Path
) -> tuple[Answer, str]:
    """Run the task on a worker of ``module``: (its answer, why the first try failed or "").

    Raises UserError: both tries failed; says whether Blender itself died of the file. Raises OSError: a full disk.
    """
    failed: list[Retry] = []
    # All of it is taken: a Ctrl-C while the iterator of a loop that was left is thrown away would be lost.
    (outcome,) = run_tasks(module, {}, [task.data()], workers=1, log=log, retried=failed.append)
    if outcome.died:
        raise UserError(f"{task.source}: Blender could not open it ({outcome.error}): damaged or truncated?")
    if outcome.result is None:
        raise UserError(str(outcome.error))
    return answer.model_validate(outcome.result), failed[0].reason if failed else ""


def bake(run: Run, source: Path, geometry: Path, pending: PendingBakes) -> list[str]:
    """Bake in worker processes; returns the keys of values that could not be baked.

    Every value appears on disk whole: after Ctrl-C only what is missing is baked again.

    Args:
        geometry: ``geometry.npz`` of the conversion that asked for the bakes.
    """
    passes, console = run.settings.passes, run.console
    count = min(worker_count(passes.workers), len(pending.layers))
    folder = run.workspace.root / BAKES
    folder.mkdir(parents=True, exist_ok=True)
    common = BakeCommon(
        source=source.resolve(),
        frame=pending.frame,
        geometry=geometry,
        folder=folder,
        size=passes.bake_size,
        threads=max(1, worker_count(0) // count),
    )
    refused: list[str] = []
    tasks = [BakeTask(layer=layer, output=folder).data() for layer in pending.layers]
    with console.bar("bakes", len(tasks)) as bar:
        for outcome in run_tasks(
            "dnrpipe.blender.baking.bake",
            common.data(),
            tasks,
            workers=count,
            log=run.log,
            retried=warn_of_retries("bake", console),
            place=_place_of_bakes(run, source, pending.external),
        ):
            if outcome.result is None:
                layer = BakeTask.model_validate(outcome.task).layer
                names = ", ".join(f"'{entry.material}'" for entry in layer[:5])
                console.warn(f"could not bake textures of {names}: {outcome.error}; averages stand for them")
                refused += [tap.key for entry in layer for tap in entry.taps]
            else:
                for name, lost in outcome.result["repaired"].items():
                    console.warn(
                        f"repaired: {lost} baked texels of '{name}' were not finite; neighbours stand for them"
                    )
            bar.advance()
    return refused


def _place_of_bakes(run: Run, source: Path, external: Sequence[Path]) -> Placement:
    """Where textures are baked: here where the scene file refers to others, which a node would have to find."""
    place = run.place
    if place.is_local or place.executor.shared:
        return place
    if external:
        run.console.say(
            f"  textures are baked here: the scene refers to {external[0].name}, which is not packed into it"
        )
        return HERE
    return replace(place, roots=(*place.roots, source.resolve()))


def _refuse_if_strict(source: Path, scene_dir: Path, settings: Settings) -> None:
    """With ``--strict``: raise UserError that names all that is missing or was left out."""
    if not settings.strict:
        return
    found = [f for f in read_census(scene_dir).findings if f.kind in ("missing", "ignored")]
    if found:
        names = [
            f"{f.kind} {f.feature}" + (f" ('{f.object or f.material}')" if f.object or f.material else "")
            for f in found
        ]
        raise UserError(f"{source}: {', '.join(names)}; repair the scene, or leave out --strict (--set strict=false)")


def _show_findings(workspace: Workspace, console: Console) -> None:
    """Name whatever was not converted exactly, once, in the terminal; census.json has all of it."""
    findings = read_census(workspace.scene).findings
    baked = [finding for finding in findings if finding.kind == "baked" and finding.material]
    if baked:
        count = len({finding.material for finding in baked})
        console.say(f"  baked: {len(baked)} procedural value(s) of {count} material(s); census.json names them")
    for kind in ("approximated", "ignored", "missing"):
        for line in finding_lines(finding for finding in findings if finding.kind == kind):
            console.say(f"  {kind}: {line}")


def _place_cameras(workspace: Workspace, settings: Settings, summary: SceneSummary) -> dict[str, list[View]]:
    views = make_cameras(summary, settings.cameras)
    if not views["train"]:
        raise UserError("no candidate views: give more cameras or set cameras.train")
    near, far = depth_range([v for split in SPLITS for v in views[split]], summary)
    frame_path = workspace.scene / "frame.json"
    frame = read_frame(workspace)
    write_json(frame_path, frame.model_copy(update={"near": near, "far": far}).model_dump(mode="json"))
    for split in SPLITS:
        write_cameras(workspace.cameras(split), views[split], split)
        wanted = {view.name for view in views[split]}
        for path in (workspace.root / "passes" / split).glob("[!.]*.exr"):
            if path.stem not in wanted:  # left by a larger or other set of cameras
                path.unlink()
    return views


def _raster_engine(run: Run) -> RasterChoice:
    """The engine for rasterised colour, probed once per workspace: a busy machine must not change it midway."""
    from ..blender.passes.choice import choose_raster

    requested = run.settings.passes.raster
    chosen = read_raster_choice(run.workspace)
    if chosen is None or chosen.requested != requested:
        with run.timed("raster trial"):
            engine, reason = choose_raster(requested)
        run.console.say(f"raster colour by {engine}: {reason}")
        chosen = RasterChoice(requested=requested, engine=engine, reason=reason)
        write_json(run.workspace.root / "passes" / "raster.json", chosen.data())
    return chosen
