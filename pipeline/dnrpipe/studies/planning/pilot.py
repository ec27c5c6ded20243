"""The pilot: every kind of work once, small, on workers; kept part by part in ``plan/pilot.json``, so that it goes on
after Ctrl-C.

    trace      a few views at few samples, the held-out ones at more
    light      the real bake, kept; a smaller one where that would take too long
    base       base images of those views
    training   two networks on the few views, by a hundred steps and by three hundred
    frames     the held-out views by the networks, by the base image alone, and by path tracing with a denoiser

Its pictures lie in ``plan/pilot/`` until the last part is done. What it takes is booked in the ledger, stage ``plan``.
"""

from __future__ import annotations

import math
import os
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from dnrtrain.atomic import write_json
from dnrtrain.contract import View

from ...core.cameras import scaled_to
from ...core.errors import UserError
from ...core.scene_files import scene_fingerprint, split_views
from ...core.settings import Settings
from ...core.workspace import Workspace, digest, file_sha256
from ...effects.plan import EffectPlan
from ...effects.store import lenses, trace_config, variant_for
from ...raytrace.tasks import BaseTask, BundleCommon, TraceTask
from ...stages.base_images import RENDERED, bake_light, base_renderer
from ...stages.effect_plan import resolve_plan
from ...stages.raytrace import view_seed
from ...stages.stage import Run
from ...stages.trainer import trained_pixels
from ...workers.task_list import run_tasks
from ...workers.view_tasks import warn_of_retries, worker_count
from ..cells.scenes import choose_by_pose
from .pilot_worker import FramesTask, PilotCommon, TrainTask
from .records import FOLDER, BasePart, FramePart, LightPart, LightPoint, Pilot, Traced, TracePart, TrainingPart

VERSION = 8
RESOLUTION = 128
VIEWS, SPP = 6, 16
HELD_OUT, REFERENCE_SPP = 6, 64
STEPS = (100, 300)
"""Two trainings: from the second on, how fast a scene's network still gains is measured, not assumed."""
SAMPLE_COUNTS = (1, 4, 16, 64)
METHODS = ("raw", "clean16-fast", "clean16")
"""Samples per pixel of path tracing, and what the denoiser is given (`frames.baselines`)."""
LIGHT_PATHS = 2048 * 2048 * 16
"""Paths of a bake of light that the pilot can afford: what ``light_spp = auto`` asks for at 2048² texels."""
TIMEOUT = 600.0
"""Seconds after which a part counts as hung: ten times what the whole pilot should take."""


Answers = list[tuple[dict[str, Any], dict[str, Any]]]
"""(task, result) of each task."""


def pilot_path(workspace: Workspace) -> Path:
    return workspace.root / FOLDER / "pilot.json"


def run_pilot(run: Run) -> Pilot:
    """The pilot of the workspace under the settings; parts that are on disk are kept.

    Raises UserError: settings that it cannot stand for, or a part that failed twice.
    """
    workspace, settings = run.workspace, run.settings
    if settings.model.base not in RENDERED:
        raise UserError(
            f"plan: model.base={settings.model.base} has no base image that can be rendered on its own; plan with"
            f" --set model.base=baked (the presets draft and standard), or one of {', '.join(RENDERED)}"
        )
    run = run.for_stage("plan")
    plan = resolve_plan(run)
    if plan.on("depth-of-field") and lenses(workspace, settings):
        raise UserError(f"plan: the cameras of {workspace.root} have depth of field, whose frames cannot be timed yet")
    piloting = Piloting(run, plan)
    fingerprint = _fingerprint(workspace, settings, plan)
    found = read_pilot(workspace)
    first = piloting.train[0]
    if found is None or found.fingerprint != fingerprint:
        shutil.rmtree(piloting.folder, ignore_errors=True)
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
        found = Pilot(fingerprint=fingerprint, size=(first.width, first.height), load=load)
    bake = found.light is None and not piloting.renderer.light_is_baked  # removed, perhaps
    if found.frames is not None and not bake:
        return found
    piloting.folder.mkdir(parents=True, exist_ok=True)
    for part in (piloting.trace, piloting.light, piloting.base, piloting.training, piloting.frames):
        name = part.__name__  # of the field that holds it, too
        if getattr(found, name) is not None:
            continue
        started = time.monotonic()
        made = part()
        seconds = time.monotonic() - started
        found = found.model_copy(update={name: made, "seconds": found.seconds + seconds})
        write_json(pilot_path(workspace), found.model_dump(mode="json"))
        booked = made.bake.seconds if isinstance(made, LightPart) and made.kept else 0.0
        run.book("training", "scene", f"pilot: {name}", seconds - booked)
    shutil.rmtree(piloting.folder, ignore_errors=True)
    return found


def read_pilot(workspace: Workspace) -> Pilot | None:
    """The pilot on disk; None where there is none that this version reads."""
    try:
        return Pilot.model_validate_json(pilot_path(workspace).read_bytes())
    except (FileNotFoundError, ValidationError):  # of another version, or truncated: it is run again
        return None


def _fingerprint(workspace: Workspace, settings: Settings, plan: EffectPlan) -> str:
    """Hash of all that decides what the pilot measures."""
    from dnrtrain.shipped import WEIGHTS

    step2 = settings.finetune.step2.model_dump(mode="json", exclude={"epochs"})
    return digest(
        [
            *(VERSION, RESOLUTION, VIEWS, SPP, HELD_OUT, REFERENCE_SPP, STEPS, scene_fingerprint(workspace)),
            workspace.manifest.stages["prepare"].output,
            *(plan.integrator, plan.max_depth, sorted(plan.left_out), plan.model(settings.model).model_dump()),
            *(settings.base.model_dump(), step2, settings.raytrace.denoise, settings.device, os.cpu_count()),
            *(worker_count(settings.raytrace.workers), settings.raytrace.variant, plan.on("spectral")),
            file_sha256(WEIGHTS),
        ]
    )


@dataclass
class Piloting:
    """One run of the pilot: the workspace with its settings, effect plan and views, and where pictures go."""

    run: Run
    plan: EffectPlan

    def __post_init__(self) -> None:
        self.workspace, self.settings, self.console = self.run.workspace, self.run.settings, self.run.console
        self.folder = self.workspace.root / FOLDER / "pilot"
        self.train, self.held_out = _views(self.workspace)
        self.renderer = base_renderer(self.workspace, self.settings, self.plan)

    def trace(self) -> TracePart:
        """Views at two numbers of samples. Each worker's first view compiles its kernels, which are of one size."""
        choice = variant_for(self.plan, self.settings)
        config = trace_config(self.workspace, self.plan, choice.variant)
        workers = 1 if choice.variant.startswith("cuda") else worker_count(self.settings.raytrace.workers)
        warm = [self._task(self.train[0], f"warm{i}", 1) for i in range(workers)]
        tasks = [self._task(view, f"train-{view.name}", SPP) for view in self.train]
        tasks += [self._task(view, f"held-{view.name}", REFERENCE_SPP) for view in self.held_out]
        common = BundleCommon(bundle=config["bundle"], variant=choice.variant, threads=1).model_dump(mode="json")
        found, took = self._timed(
            "pilot: ray tracing", "dnrpipe.raytrace.tracer", common, [*warm, *tasks], workers, choice.environment
        )
        points = [
            Traced(
                pixels=task["view"]["width"] * task["view"]["height"],
                **{name: result[name] for name in ("spp", "seconds", "cpu_seconds")},
                noise_rmse=result.get("noise_rmse"),
                raw_rmse=_raw_rmse(result),
            )
            for task, result in found
            if not Path(task["output"]).name.startswith("warm")
        ]
        startup = max(0.0, took - sum(point.seconds for point in points) / workers)
        return TracePart(points=points, workers=workers, startup=startup)

    def light(self) -> LightPart | None:
        """The real light, kept, for the quality of base images hangs on its paths; fewer paths where that is too dear.

        None where there is no light to bake or it is on disk.
        """
        renderer, task = self.renderer, self.renderer.light
        if task is None or renderer.light_is_baked:
            return None
        size, spp = task["size"], max(1, min(task["spp"], LIGHT_PATHS // task["size"] ** 2))
        started = time.monotonic()
        if kept := spp == task["spp"]:
            result = bake_light(replace(self.run, stage="raytrace"), renderer)
            assert result is not None  # it is not on disk
        else:
            shared = {name: renderer.common[name] for name in ("bundle", "variant")}
            small = task | {"spp": spp, "output": str(self.folder / "light.npz")}
            ((_, result),) = self._run(
                "pilot: baking light", "dnrpipe.raytrace.light_worker", shared, [small], 1, renderer.environment
            )
        took = time.monotonic() - started
        bake = LightPoint(size=size, spp=spp, seconds=result["seconds"], cpu_seconds=result["cpu_seconds"])
        return LightPart(bake=bake, startup=max(0.0, took - bake.seconds), kept=kept)

    def base(self) -> BasePart:
        common, light = self.renderer.common, self._light()
        if light is not None:
            common = common | {"light": str(light)}
        tasks = [
            BaseTask(view=view, output=self._base_file(kind, view), fingerprint=self.run.id).model_dump(mode="json")
            for kind, views in (("train", self.train), ("held", self.held_out))
            for view in views
        ]
        found, took = self._timed(
            "pilot: base images", "dnrpipe.raytrace.base_worker", common, tasks, 1, self.renderer.environment
        )
        seconds = [result["seconds"] for _, result in found]
        return BasePart(
            pixels=self.train[0].width * self.train[0].height,
            seconds=float(np.median(seconds)),
            cpu_seconds=float(np.median([result["cpu_seconds"] for _, result in found])),
            startup=max(0.0, took - sum(seconds)),
        )

    def training(self) -> TrainingPart:
        result = self._ask("pilot: training", self._train_task(), {})
        pixels = trained_pixels(self.settings, self.train[0].width, self.train[0].height)
        return TrainingPart(views=len(self.train), spp=SPP, pixels=pixels, **result)

    def _train_task(self) -> TrainTask:
        per_epoch = math.ceil(len(self.train) / self.settings.finetune.step2.batch)
        return TrainTask(
            views=self.train,
            base_files=[self._base_file("train", view) for view in self.train],
            images=[self._image(f"train-{view.name}") for view in self.train],
            folders=self._models(),
            epochs=[max(2, round(steps / per_epoch)) for steps in STEPS],
            fingerprint=self.run.id,
        )

    def frames(self) -> FramePart:
        task = FramesTask(
            views=self.held_out,
            train=self._train_task(),
            folders=self._models(),
            light=self._light(),
            samples=list(SAMPLE_COUNTS),
            methods=list(METHODS),
        )
        result = self._ask("pilot: frames", task, self.renderer.environment)
        if lost := result.pop("unknown"):
            self.console.warn(f"pilot: {lost} pixels of the held-out views were not finite; they take no part")
        return FramePart(views=len(self.held_out), **result)

    # -- what the parts share --------------------------------------------------------------------------

    def _timed(
        self, label: str, module: str, common: dict[str, Any], tasks: list[dict[str, Any]], *more: Any
    ) -> tuple[Answers, float]:
        """(what `_run` gives, wall seconds), after the first task on a worker of its own: its kernels are then in
        Dr.Jit's cache on disk, as they are when the plan is carried out. Compiling them takes 2 to 7 s, which would
        count as the start of every later stage."""
        self._run("pilot: compiling kernels", module, common, tasks[:1], 1, more[-1])
        started = time.monotonic()
        return self._run(label, module, common, tasks, *more), time.monotonic() - started

    def _run(
        self,
        label: str,
        module: str,
        common: dict[str, Any],
        tasks: list[dict[str, Any]],
        workers: int,
        environment: dict[str, str],
    ) -> Answers:
        """Raises UserError where a task failed twice."""
        found = []
        with self.console.bar(label, len(tasks)) as bar:
            for outcome in run_tasks(
                module,
                common,
                tasks,
                workers=workers,
                log=self.run.log,
                timeout=TIMEOUT,
                retried=warn_of_retries(label, self.console),
                environment=environment,
            ):
                if outcome.result is None:
                    raise UserError(f"{label}: {outcome.error}; see {self.run.log}")
                found.append((outcome.task, outcome.result))
                bar.advance()
        return found

    def _ask(self, label: str, task: TrainTask | FramesTask, environment: dict[str, str]) -> dict[str, Any]:
        """The answer of `pilot_worker`."""
        settings = self.settings.model_copy(update={"model": self.plan.model(self.settings.model)})
        common = PilotCommon(workspace=self.workspace.root, settings=settings).model_dump(mode="json")
        tasks = [task.model_dump(mode="json")]
        ((_, result),) = self._run(label, "dnrpipe.studies.planning.pilot_worker", common, tasks, 1, environment)
        return result

    def _task(self, view: View, name: str, spp: int) -> dict[str, Any]:
        """Trace a view into a picture of the pilot."""
        assert self.plan.max_depth is not None  # the plan is resolved
        task = TraceTask(
            view=view,
            output=self._image(name),
            spp=spp,
            integrator=self.plan.integrator,
            max_depth=self.plan.max_depth,
            seed=view_seed(self.settings.raytrace.seed, "pilot", name),
            denoise=self.settings.raytrace.denoise,
            fingerprint=self.run.id,
        )
        return task.model_dump(mode="json")

    def _models(self) -> list[Path]:
        return [self.folder / f"model-{steps}" for steps in STEPS]

    def _image(self, name: str) -> Path:
        return self.folder / f"{name}.exr"

    def _base_file(self, kind: str, view: View) -> Path:
        return self.folder / f"base-{kind}-{view.name}.exr"

    def _light(self) -> Path | None:
        """The real light where it is on disk, else the pilot's; None where none is needed."""
        if (light := self.renderer.light) is None:
            return None
        return Path(light["output"]) if self.renderer.light_is_baked else self.folder / "light.npz"


def _raw_rmse(result: dict[str, Any]) -> float | None:
    """RMSE of a view as it was traced; the tracer tells that of the picture as it is used, and both over its level."""
    used, raw, relative = (result.get(name) for name in ("noise_rmse", "raw_noise", "noise"))
    return used if not (used and raw and relative) else used * raw / relative


def _views(workspace: Workspace) -> tuple[list[View], list[View]]:
    """(a few candidates, the farthest from each other; a few others) at the pilot's size.

    Others: test views, for their PSNR is what is predicted (by poses alone; nothing is trained on them or chosen among
    them), else validation views, else candidates that were not taken.
    """
    splits = split_views(workspace)
    views = splits["train"]
    chosen = choose_by_pose(views, "farthest", min(VIEWS, len(views)), 0)
    left = splits.get("test") or splits.get("val") or [view for view in views if view not in chosen] or views
    others = left[:: max(1, len(left) // HELD_OUT)][:HELD_OUT]
    return [scaled_to(view, RESOLUTION) for view in chosen], [scaled_to(view, RESOLUTION) for view in others]
