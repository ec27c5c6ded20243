"""Stage `prepare`: scene file -> census, Mitsuba bundle, cameras, raster passes and G-buffers."""

from __future__ import annotations

import errno
import os
import shutil
import time
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json
from dnrtrain.contract import SPLITS, View, write_cameras

from ..blender.finding_lines import finding_lines
from ..core.cameras import depth_range, make_cameras
from ..core.console import Console
from ..core.errors import UserError
from ..core.ledger import CostRecord
from ..core.scene_files import read_frame, read_json, read_summary, scene_fingerprint
from ..core.settings import Settings
from ..core.workspace import Workspace, digest, file_sha256
from ..effects.store import keep_plan, plan_of
from ..workers.processes import Retry, run_tasks
from ..workers.view_tasks import run_view_tasks, view_record, warn_repairs, worker_count
from .baking import FOLDER, bake
from .stage import Outcome

MAX_BAKE_ROUNDS = 4
"""Values whose need shows only after others are baked take further rounds; two are the rule."""
PASSES_VERSION = 1
# Evaluation needs G-buffers of test views only; their rasterised colour would never be read.
RASTERISED = ("train", "val")


def run(workspace: Workspace, settings: Settings, console: Console, run_id: str) -> Outcome:
    """Do what is missing: convert the scene, place the cameras, render the passes."""
    summary, views = scene_and_views(workspace, settings, console, run_id)
    _plan_effects(workspace, settings, console)
    scene_print = scene_fingerprint(workspace)
    engine, reason = _raster_engine(workspace, settings, console)
    raster = settings.model.base == "raster"  # then test views need it, too
    tasks = [
        pass_task(workspace, settings, view, split, scene_print, engine, raster=split in RASTERISED or raster)
        for split in SPLITS
        for view in views[split]
    ]

    def book(task: dict[str, Any], result: dict[str, Any], workers: int) -> CostRecord:
        purpose = "evaluation" if Path(task["output"]).parent.name == "test" else "training"
        return view_record(
            run=run_id,
            stage="prepare",
            purpose=purpose,
            task=task,
            result=result,
            workers=workers,
            device="cpu",
        )

    run_view_tasks(
        "passes",
        "dnrpipe.blender.passes.worker",
        pass_common(workspace, settings, engine),
        tasks,
        workspace=workspace,
        console=console,
        stage="prepare",
        workers=worker_count(settings.passes.workers),
        book=book,
    )
    warn_repairs(tasks, console)
    return Outcome(
        # Views, scene and engine are all in the tasks' fingerprints.
        digest([[Path(task["output"]).parent.name, task["fingerprint"]] for task in tasks]),
        {
            "raster_engine": engine,
            "raster_reason": reason,
            "views": {split: len(views[split]) for split in SPLITS},
            "triangles": summary["triangles"],
        },
    )


def _plan_effects(workspace: Workspace, settings: Settings, console: Console) -> None:
    """Write the effect plan, as far as it is known without its pilot, and say what is on."""
    plan = plan_of(workspace, settings)
    keep_plan(workspace, plan)
    named = [effect.title for effect in plan.effects if effect.on and effect.part == "light"]
    console.say(f"effects: {', '.join(named) or 'none'} (`dnrpipe effects` says why)")


def scene_and_views(
    workspace: Workspace, settings: Settings, console: Console, run_id: str
) -> tuple[dict[str, Any], dict[str, list[View]]]:
    """Convert the scene and place the cameras, where that is not done: (summary, views by split). No passes."""
    summary = _convert(workspace, settings, console, run_id)
    return summary, _place_cameras(workspace, settings, summary)


def progress(workspace: Workspace, settings: Settings) -> tuple[int, int]:
    """(passes on disk, passes wanted)."""
    wanted = settings.cameras.train + settings.cameras.val + settings.cameras.test
    if "prepare" in workspace.manifest.stages:
        wanted = sum(workspace.manifest.stages["prepare"].detail["views"].values())
    present = sum(1 for split in SPLITS for _ in (workspace.root / "passes" / split).glob("[!.]*.exr"))
    return min(present, wanted), wanted


def pass_task(
    workspace: Workspace,
    settings: Settings,
    view: View,
    split: str,
    scene_print: str,
    engine: str,
    *,
    raster: bool,
    output: Path | None = None,
) -> dict[str, Any]:
    """Task of :class:`dnrpipe.blender.passes.worker.Worker` for one view; its fingerprint names all that decides it."""
    data = view.model_dump(mode="json")
    coverage = settings.passes.coverage_samples
    colour = [engine, settings.passes.raster_samples] if raster else None
    return {
        "view": data,
        "output": str(output or workspace.passes(split, view.name)),
        "raster": raster,
        "fingerprint": digest([PASSES_VERSION, scene_print, data, coverage, colour]),
    }


def pass_common(workspace: Workspace, settings: Settings, engine: str) -> dict[str, Any]:
    """What all pass workers share."""
    return {
        "scene_dir": str(workspace.scene),
        "raster_engine": engine,
        "raster_samples": settings.passes.raster_samples,
        "coverage_samples": settings.passes.coverage_samples,
    }


def _convert(workspace: Workspace, settings: Settings, console: Console, run_id: str) -> dict[str, Any]:
    """Open the scene in a worker and write ``scene/``, whole or not at all."""
    marker = workspace.scene / "prepared.json"
    if marker.exists() and read_json(marker)["fingerprint"] == scene_fingerprint(workspace):
        summary = read_summary(workspace)
        if summary["bake_size"] in (None, settings.passes.bake_size):
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
    _run_conversion(source, fresh, workspace, settings, console)
    _refuse_if_strict(source, fresh, settings)
    # The old scene stays until the new one is whole; killed in between, the next run converts again.
    if workspace.scene.exists():
        shutil.rmtree(workspace.scene)
    fresh.rename(workspace.scene)
    summary = read_summary(workspace)
    for warning in summary["warnings"]:
        console.warn(warning)
    _show_findings(workspace, console)
    workspace.ledger.append(
        CostRecord(
            time=time.time(),
            run=run_id,
            stage="prepare",
            purpose="training",
            unit="scene",
            name="convert",
            seconds=time.monotonic() - started,
        )
    )
    # frame.json is not among them: near and far follow the cameras.
    files = {
        str(path.relative_to(workspace.scene)): file_sha256(path)
        for path in sorted(workspace.scene.rglob("[!.]*"))
        if path.is_file() and path.name != "frame.json"
    }
    write_json(marker, {"fingerprint": scene_fingerprint(workspace), "files": files})
    return summary


def _run_conversion(source: Path, folder: Path, workspace: Workspace, settings: Settings, console: Console) -> None:
    """Convert; where the worker asks for bakes, bake them and convert again."""
    size, refused = settings.passes.bake_size, list[str]()
    for _ in range(MAX_BAKE_ROUNDS):
        options = {"folder": str(workspace.root / FOLDER), "size": size, "refused": refused}
        task = {"source": str(source), "scene_dir": str(folder), "strict": settings.strict, "bakes": options}
        pending = _attempt(source, task, workspace, console).get("bakes")
        if pending is None:
            return
        refused += bake(workspace, console, source, folder / "geometry.npz", pending, size, settings.passes.workers)
    raise RuntimeError(f"{source}: the same textures are to be baked again and again")


def _attempt(source: Path, task: dict[str, Any], workspace: Workspace, console: Console) -> dict[str, Any]:
    """The worker's result, or what went wrong as a UserError; a second try is told of where it helped."""
    result: dict[str, Any] = {}
    first = ""
    with console.bar("scene", 1) as bar:
        for outcome in run_tasks("dnrpipe.blender.prepare", {}, [task], workers=1, log=workspace.log("prepare")):
            if isinstance(outcome, Retry):
                first = outcome.reason
                continue
            if outcome.errno == errno.ENOSPC:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), task["scene_dir"])
            if outcome.died:
                raise UserError(f"{source}: Blender could not open it ({outcome.error}): damaged or truncated?")
            if outcome.result is None:
                raise UserError(str(outcome.error))
            result = outcome.result
            bar.advance()
    if first:
        console.warn(f"scene: {first}; opening it once more went well")
    return result


def _refuse_if_strict(source: Path, scene_dir: Path, settings: Settings) -> None:
    """With ``--strict``: raise UserError that names all that is missing or was left out."""
    if not settings.strict:
        return
    found = [f for f in read_json(scene_dir / "census.json")["findings"] if f["kind"] in ("missing", "ignored")]
    if found:
        names = [
            f"{f['kind']} {f['feature']} ('{f['object'] or f['material']}')"
            if f["object"] or f["material"]
            else f"{f['kind']} {f['feature']}"
            for f in found
        ]
        raise UserError(f"{source}: {', '.join(names)}; mend the scene, or leave out --strict (--set strict=false)")


def _show_findings(workspace: Workspace, console: Console) -> None:
    """Whatever was not converted exactly is said by name, once, in the terminal; all of it is in census.json."""
    census = read_json(workspace.scene / "census.json")
    baked = [finding for finding in census["findings"] if finding["kind"] == "baked" and finding["material"]]
    if baked:
        count = len({finding["material"] for finding in baked})
        console.say(f"  baked: {len(baked)} procedural value(s) of {count} material(s); census.json names them")
    for kind in ("approximated", "ignored", "missing"):
        for line in finding_lines(finding for finding in census["findings"] if finding["kind"] == kind):
            console.say(f"  {kind}: {line}")


def _place_cameras(workspace: Workspace, settings: Settings, summary: dict[str, Any]) -> dict[str, list[View]]:
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


def _raster_engine(workspace: Workspace, settings: Settings, console: Console) -> tuple[str, str]:
    """The engine for rasterised colour, probed once per workspace: a busy machine must not change it midway."""
    from ..blender.passes.choice import choose_raster

    record = workspace.root / "passes" / "raster.json"
    if record.exists():
        chosen = read_json(record)
        if chosen["requested"] == settings.passes.raster:
            return chosen["engine"], chosen["reason"]
    engine, reason = choose_raster(settings.passes.raster)
    console.say(f"raster colour by {engine}: {reason}")
    write_json(record, {"requested": settings.passes.raster, "engine": engine, "reason": reason})
    return engine, reason
