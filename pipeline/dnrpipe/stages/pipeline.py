"""The pipeline as data: what each stage reads, writes and depends on, and how to run what is due.

fingerprint(stage) = hash of its version, its settings, the source (prepare) and the outputs of the
                     stages it needs
state              = missing | partial | stale | done
"""

from __future__ import annotations

import platform
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dnrtrain.contract import DamagedFile

from .. import __version__
from ..core.cameras import KEYWORDS
from ..core.console import clock
from ..core.effect_names import NEURAL
from ..core.errors import UserError
from ..core.ledger import StageName
from ..core.machine import cache_root
from ..core.scene_files import scene_fingerprint
from ..core.settings import Settings
from ..core.workspace import Workspace, digest
from . import evaluate, finetune, prepare, raytrace, select
from .elsewhere import make_elsewhere, trains
from .stage import Outcome, Run, Stage

State = Literal["missing", "partial", "stale", "done"]


def _cameras(settings: Settings) -> dict[str, Any]:
    """Settings that decide which views there are. A camera file counts by its content, wherever it lies: a workspace
    may be moved, and is worked in on several machines."""
    cameras = settings.cameras
    by_content = cameras.source_sha256 and cameras.source not in KEYWORDS
    return cameras.model_dump(exclude={"source"} if by_content else None)


def _light(settings: Settings) -> dict[str, Any]:
    """Effect settings that decide what is ray-traced."""
    chosen = settings.effects.model_dump()
    return chosen | {key: sorted(set(chosen[key]) - NEURAL) for key in ("enable", "disable")}


def _tracing(settings: Settings, *, test: bool) -> dict[str, Any]:
    """Settings that decide how the views of one kind are ray-traced; targets only where they are set."""
    raytrace = settings.raytrace
    names = ["evaluation_noise"] if test else ["noise", "time"]
    targets = {name: value for name in names if (value := getattr(raytrace, name)) is not None}
    if targets:
        targets["max_spp"] = raytrace.max_spp
    else:
        names = ["evaluation_spp"] if test else ["spp"]
        targets = {name: getattr(raytrace, name) for name in names}
    common = {"max_depth", "seed", *(("evaluation_denoise", "evaluation_baseline") if test else ("denoise",))}
    return raytrace.model_dump(include=common) | targets


def _base(settings: Settings) -> list[Any]:
    """Settings that decide the base images."""
    return [settings.model.base, settings.base.model_dump()]


def _selection(settings: Settings) -> list[Any]:
    """Settings that decide which views are chosen, and the coarse model where there is one."""
    if settings.select.budget == "auto":
        tried = [
            settings.model.model_dump(),
            settings.finetune.model_dump(),
            _base(settings),
            _tracing(settings, test=False),
        ]
        return [settings.select.model_dump(exclude={"step1"}), *tried]
    if not settings.trains_step1:
        return [settings.select.model_dump(include={"budget", "policy", "seed"})]
    return [settings.model.coarse().model_dump(), settings.select.model_dump(), _neural(settings)]


def _neural(settings: Settings) -> dict[str, list[str]]:
    """Effect settings that decide what the neural renderer is made of."""
    chosen = settings.effects
    return {key: sorted(set(getattr(chosen, key)) & NEURAL) for key in ("enable", "disable")}


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage(
            name="prepare",
            command="prepare",
            does="census, Mitsuba bundle, cameras, raster passes and G-buffers",
            needs=(),
            reads=("the scene file",),
            writes=("scene", "cameras", "passes"),
            settings=lambda s: [
                _cameras(s),
                s.passes.model_dump(exclude={"workers"}),
                *(["raster"] if s.model.base == "raster" else []),
            ],
            make=prepare.prepare,
            progress=prepare.progress,
        ),
        Stage(
            name="select",
            command="select",
            does="choice of the views to ray-trace; step 1 (coarse DNR) where that or step 2 needs it",
            needs=("prepare",),
            reads=("passes", "cameras"),
            writes=("selection.json", "checkpoints/step1"),
            settings=_selection,
            make=select.select_views,
            progress=select.progress,
        ),
        Stage(
            name="raytrace",
            command="raytrace-selected",
            does="path tracing of the selected views, their base images",
            needs=("prepare", "select"),
            reads=("scene", "selection.json"),
            writes=("raytraced/train", "base/train"),
            settings=lambda s: [_tracing(s, test=False), _light(s), _base(s)],
            make=raytrace.raytrace_selected,
            progress=raytrace.progress,
            version=2,
        ),
        Stage(
            name="finetune",
            command="finetune",
            does="step 2: six losses on the selected ray-traced views",
            needs=("select", "raytrace"),
            reads=("passes", "raytraced/train", "base/train", "checkpoints/step1"),
            writes=("checkpoints/step2", "preview", "raytraced/trust", "base/trust"),
            settings=lambda s: [s.model.model_dump(), s.finetune.model_dump(exclude={"preview_seconds"}), _neural(s)],
            make=finetune.finetune,
            progress=finetune.progress,
            version=4,
        ),
        Stage(
            name="evaluate",
            command="evaluate",
            does="held-out test views, ray-traced on demand",
            needs=("finetune",),
            reads=("passes/test", "checkpoints/step2"),
            writes=("raytraced/test", "base/test", "evaluation"),
            settings=lambda s: [_tracing(s, test=True), _light(s), _base(s)],
            make=evaluate.evaluate,
            progress=evaluate.progress,
            version=2,
        ),
    )
}


def fingerprint(stage: Stage, workspace: Workspace, settings: Settings) -> str | None:
    """Hash of all that the stage computes from; None while a stage it needs has never run."""
    records = workspace.manifest.stages
    if any(need not in records for need in stage.needs):
        return None
    return digest(
        {
            "stage": stage.name,
            "version": stage.version,
            "settings": stage.settings(settings),
            "source": None if stage.needs else scene_fingerprint(workspace),
            "inputs": {need: records[need].output for need in stage.needs},
        }
    )


def state(stage: Stage, workspace: Workspace, settings: Settings) -> State:
    """missing: never finished; partial: files are absent; stale: inputs or settings changed; done.

    Work done without perceptual weights is stale once they are here; the other way round it stays.
    """
    record = workspace.manifest.stages.get(stage.name)
    present, wanted = stage.progress(workspace, settings)
    if record is None:
        return "partial" if present else "missing"
    if record.fingerprint != fingerprint(stage, workspace, settings):
        return "stale"
    if any(state(STAGES[need], workspace, settings) == "stale" for need in stage.needs):
        return "stale"
    if record.detail.get("perceptual") is False and weights_cached():
        return "stale"
    return "done" if present >= wanted else "partial"


def run_stage(name: StageName, run: Run, *, force: bool = False) -> dict[str, Any]:
    """Run one stage if it is due. Returns its facts; ``"ran"`` says whether it did anything.

    Raises UserError: a stage that it needs has not run or is out of date.
    """
    stage, workspace, settings, console = STAGES[name], run.workspace, run.settings, run.console
    require_inputs(stage, workspace, settings)
    if not force and state(stage, workspace, settings) == "done":
        console.say(f"{stage.command}: up to date")
        return {"stage": name, "ran": False, **workspace.manifest.stages[name].detail}
    if force:
        if not stage.needs and not Path(workspace.manifest.source.path).is_file():
            raise UserError(
                f"{workspace.manifest.source.path}: the scene file is gone; --force would lose its conversion"
            )
        clear(stage, workspace)
    inputs = fingerprint(stage, workspace, settings)
    assert inputs is not None  # they were required above
    record = workspace.manifest.stages.get(name)
    if record is not None and record.fingerprint != inputs:
        record.fingerprint = ""  # its files are about to change: not done until this run has finished
    started = time.monotonic()
    workspace.manifest.versions = {"dnrpipe": __version__, "python": platform.python_version()}
    workspace.manifest.settings = settings.model_dump(mode="json")
    workspace.save()
    outcome = _make(stage, run, inputs)
    seconds = time.monotonic() - started
    done = fingerprint(stage, workspace, settings)  # anew: `prepare` finds out which files a scene refers to
    assert done is not None
    workspace.finish_stage(name, fingerprint=done, output=outcome.output, seconds=seconds, detail=outcome.detail)
    console.say(f"{stage.command}: done in {clock(seconds)}")
    return {"stage": name, "ran": True, "seconds": seconds, **outcome.detail}


def _make(stage: Stage, run: Run, inputs: str) -> Outcome:
    """Run the stage; a damaged file that it meets is named, thrown away and made again by the stage it is from.

    Raises DamagedFile: the file is of no stage, or was damaged again.
    """
    met: set[Path] = set()
    while True:
        try:
            own = run.for_stage(stage.name, inputs)
            with own.timed("everything else"):
                if trains(stage.name, run.settings) and not run.place.is_local:
                    return make_elsewhere(own)
                return stage.make(own)
        except DamagedFile as damage:
            owner = owner_of(damage.path, run.workspace)
            if owner is None or damage.path in met:
                raise
            met.add(damage.path)
            run.console.warn(f"{damage.path}: damaged ({damage.reason}); `dnrpipe {owner.command}` makes it again")
            discard(damage.path, owner, run.workspace)
            if owner.name != stage.name:
                run_stage(owner.name, run)


def owner_of(path: Path, workspace: Workspace) -> Stage | None:
    """The stage that writes ``path``, or None for files of no stage and files outside the workspace."""
    try:
        inside = path.resolve().relative_to(workspace.root.resolve())
    except ValueError:
        return None
    owners = (stage for stage in STAGES.values() if any(inside.is_relative_to(path) for path in stage.writes))
    return next(owners, None)


def discard(path: Path, owner: Stage, workspace: Workspace) -> None:
    """Remove a damaged file such that its stage is due. Without its last file a converted scene is none."""
    path.unlink(missing_ok=True)
    if path.resolve().is_relative_to(workspace.scene.resolve()):
        (workspace.scene / "prepared.json").unlink(missing_ok=True)
    record = workspace.manifest.stages.get(owner.name)
    if record is not None:
        record.fingerprint = ""
        workspace.save()


def require_inputs(stage: Stage, workspace: Workspace, settings: Settings, asking: str | None = None) -> None:
    """Raise UserError naming the first command that must run before this stage can.

    asking: what reads the same inputs, where that is not the stage itself.
    """
    for need in stage.needs:
        upstream = STAGES[need]
        require_inputs(upstream, workspace, settings, asking)
        found = state(upstream, workspace, settings)
        if found != "done":
            why = {"missing": "has not run", "partial": "is not complete", "stale": "is out of date"}[found]
            raise UserError(
                f"{asking or stage.command}: {upstream.command} {why} for {workspace.root};"
                f" run `dnrpipe {upstream.command}` first"
            )


def clear(stage: Stage, workspace: Workspace) -> None:
    """``--force``: remove what the stage wrote, so that nothing is reused."""
    workspace.manifest.stages.pop(stage.name, None)
    workspace.save()
    for relative in stage.writes:
        path = workspace.root / relative
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def weights_cached() -> bool:
    """Whether `dnrpipe weights` has been here; a look at the folder, without importing torch."""
    return (cache_root() / "weights" / "weights.json").is_file()


@dataclass(frozen=True)
class StageStatus:
    """A row of ``dnrpipe status``. seconds: wall time of its last run; None before it has finished one."""

    stage: StageName
    command: str
    does: str
    state: State
    present: int
    wanted: int
    seconds: float | None
    reads: tuple[str, ...]
    writes: tuple[str, ...]


def status(workspace: Workspace, settings: Settings) -> list[StageStatus]:
    rows = []
    for stage in STAGES.values():
        present, wanted = stage.progress(workspace, settings)
        record = workspace.manifest.stages.get(stage.name)
        rows.append(
            StageStatus(
                stage=stage.name,
                command=stage.command,
                does=stage.does,
                state=state(stage, workspace, settings),
                present=present,
                wanted=wanted,
                seconds=record.seconds if record else None,
                reads=stage.reads,
                writes=stage.writes,
            )
        )
    return rows
