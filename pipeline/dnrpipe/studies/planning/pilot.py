"""The pilot: every kind of work once, small; kept part by part in ``plan/pilot.json``, so that it goes on after Ctrl-C.

    trace      a few views at few samples, the held-out ones at more
    light      the real bake, kept; a smaller one where that would take too long
    base       base images of those views
    training   two networks on the few views, by a hundred steps and by three hundred
    frames     the held-out views by the networks, by the base image alone, and by path tracing with a denoiser

Its pictures lie in ``plan/pilot/`` until the last part is done. What it takes is booked in the ledger, stage ``plan``.
"""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

from pydantic import ValidationError

from dnrtrain.atomic import write_json

from ...core.errors import UserError
from ...core.scene_files import scene_fingerprint
from ...core.settings import Settings
from ...core.workspace import Workspace, digest
from ...effects.plan import EffectPlan
from ...effects.store import lenses
from ...stages.base_images import RENDERED, base_renderer
from ...stages.effect_plan import resolve_plan
from ...stages.stage import Run
from .pilot_parts import HELD_OUT, REFERENCE_SPP, RESOLUTION, SPP, STEPS, VIEWS, Piloting
from .records import FOLDER, LightPart, Pilot

VERSION = 6
FILE = "pilot.json"


def pilot_path(workspace: Workspace) -> Path:
    """``plan/pilot.json``."""
    return workspace.root / FOLDER / FILE


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
    bake = found.light is None and not base_renderer(workspace, settings, plan).light_is_baked  # removed, perhaps
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
    step2 = settings.finetune.step2.model_dump(mode="json", exclude={"epochs"})
    return digest(
        [
            *(VERSION, RESOLUTION, VIEWS, SPP, HELD_OUT, REFERENCE_SPP, STEPS, scene_fingerprint(workspace)),
            workspace.manifest.stages["prepare"].output,
            *(plan.integrator, plan.max_depth, sorted(plan.left_out), plan.model(settings.model).model_dump()),
            *(settings.base.model_dump(), step2, settings.raytrace.denoise, settings.device, os.cpu_count()),
        ]
    )
