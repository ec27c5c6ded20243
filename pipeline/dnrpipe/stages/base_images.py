"""Base images: what the network corrects. Bakes the scene's light once, then renders views from it, on demand.

``model.base`` says which: ``none``; ``raster``, the rasterised colour of the passes; ``baked``, baked light and
specular paths; ``direct`` or ``path``, a few path-traced samples, denoised (direct light alone, or the plan's depth).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import NPZ_ERRORS, View

from ..core.cameras import spread
from ..core.errors import UserError
from ..core.ledger import Purpose
from ..core.scene_files import read_summary, scene_fingerprint, split_views
from ..core.settings import Settings
from ..core.workspace import Workspace, digest
from ..effects.plan import DIRECT_DEPTH, EffectPlan
from ..effects.store import plan_of, trace_config
from ..raytrace.gathering import COARSE_PATHS
from ..raytrace.tasks import remembers_from
from ..raytrace.variants import choose_variant
from ..workers.placement import HERE
from ..workers.view_tasks import only_answer, warn_of_repairs
from .effect_plan import resolve_plan
from .stage import Run

LIGHT_VERSION, BASE_VERSION, DENOISE_VERSION = 12, 27, 4
RENDERED = ("baked", "direct", "path")
"""Kinds of base images that are rendered into files of their own."""
TEXELS, MANY, MOST = 8, 1024, 4096
"""Texels of the light map per pixel of an image's longer side as far as MANY, and the most that there are."""
TEXELS_BEYOND = {"traced": 4, "gathered": 2}
"""The same from MANY on. Four are about one a pixel where the atlas shows a part of itself; gathered light is better of
half as many with more rays, where charts are large."""
SPP = {"traced": 16, "gathered": 32}
"""Paths or gathered rays per texel: few, for the denoiser averages over texels."""
GATHER_FROM = 0.4
"""Share of the light that direct light alone would miss, from which on it is gathered: it pays at 0.49 (`interior`) and
does not at 0.21 (`materials`)."""
MOST_AT_ONCE = 1 << 22
"""Pixels of a frame beside which others are kept in memory."""
LOOKED_FROM = 16
"""Views of the workspace that say what is seen, where light is baked for that."""
RAY = 0.6
"""Seconds of a gathered ray, with its samples of emitters, over those of a path of E and one of S."""


@dataclass(frozen=True)
class BaseRenderer:
    """How base images of a workspace are rendered.

    Args:
        common: what the workers share. environment: theirs.
        light: the task that bakes the light they need, or None.
        fingerprint: of all that decides the images but for the view.
    """

    common: dict[str, Any]
    environment: dict[str, str]
    light: dict[str, Any] | None
    fingerprint: str

    @property
    def light_is_baked(self) -> bool:
        """Whether the light is on disk, baked from the same inputs; True where none is needed."""
        if self.light is None:
            return True
        try:
            with np.load(self.light["output"], allow_pickle=False) as data:
                return str(data["fingerprint"]) == self.light["fingerprint"]
        except NPZ_ERRORS:
            return False


def base_path(workspace: Workspace, split: str, name: str) -> Path:
    return workspace.root / "base" / split / f"{name}.exr"


def light_path(workspace: Workspace) -> Path:
    return workspace.root / "base" / "light.npz"


@dataclass(frozen=True)
class LightPlan:
    """How light is baked.

    Args:
        gathered: by rays that end at a coarse map after one bounce; else by paths.
        size: texels of the map's side. spp: paths or gathered rays per texel.
    """

    gathered: bool
    size: int
    spp: int

    @property
    def paths(self) -> float:
        """Of a full atlas; gathered light: as many as take its seconds."""
        rays = self.size**2 * self.spp
        return COARSE_PATHS + RAY * rays if self.gathered else rays


def light_plan(settings: Settings, plan: EffectPlan, *, fine: bool = False) -> LightPlan:
    """As the settings say; where they say auto, what suits the images and how much of the light has bounced.

    fine: twice the texels a side of what suits the images (`AtlasFacts.loses_most`).
    """
    chosen, way = settings.base, settings.base.light
    if way == "auto":
        bounced = plan.pilot.beyond(DIRECT_DEPTH) if plan.pilot else 0.0
        way = "gathered" if bounced >= GATHER_FROM else "traced"
    side = max(settings.cameras.width, settings.cameras.height)
    wanted = max(min(TEXELS * side, MANY), TEXELS_BEYOND[way] * side) * (2 if fine else 1)
    return LightPlan(
        gathered=way == "gathered",
        size=min(2 ** round(np.log2(wanted)), MOST) if chosen.light_size == "auto" else chosen.light_size,
        spp=SPP[way] if chosen.light_spp == "auto" else chosen.light_spp,
    )


def base_views(
    run: Run,
    views: Sequence[View],
    split: str,
    *,
    paths: Sequence[Path] | None = None,
    purpose: Purpose | None = None,
    sequence: bool = False,
) -> list[dict[str, Any]]:
    """Render the base images of the views that are missing or out of date -> all tasks, [] where none is rendered.

    Args:
        split: that they are of; the ledger names them by it.
        paths: where they go instead of ``base/<split>``.
        purpose: they are booked under, instead of the stage's.
        sequence: they are the frames of a moving camera, remember those before them and are filtered with those next
            to them (baked light; other kinds cannot).

    Raises UserError where this machine has no jit variant of Mitsuba.
    """
    if run.settings.model.base not in RENDERED or not views:
        return []
    renderer = base_renderer(run.workspace, run.settings, resolve_plan(run))
    with run.timed("baking light: process"):
        bake_light(run, renderer)
    paths = paths or [base_path(run.workspace, split, view.name) for view in views]
    chosen, tasks = run.settings, []
    remembers = sequence and chosen.model.base == "baked"
    cameras = [view.model_dump(mode="json") for view in views]
    for number, (data, path) in enumerate(zip(cameras, paths, strict=True)):
        begin = remembers_from(number)
        task = {"view": data, "output": str(path)}
        if remembers:
            task |= {"earlier": cameras[begin:number], "number": begin}
            if is_small(views[number]):
                task |= {"after": (cameras[number + 1 :] or [None])[0], "filtered": True}
        known = [task[key] for key in ("earlier", "number", "after", "filtered") if key in task]
        tasks.append(task | {"fingerprint": digest([BASE_VERSION, renderer.fingerprint, data, *known])})
    run.view_tasks(
        "base images",
        "dnrpipe.raytrace.base_worker",
        renderer.common,
        tasks,
        workers=1,  # a kernel to compile; its threads fill the machine
        book=run.book_views(f"mitsuba {renderer.common['variant']}", folder=f"base/{split}", purpose=purpose),
        environment=renderer.environment,
        place=HERE if remembers else None,  # one frame after the other, by one worker that knows the last
    )
    warn_of_repairs(tasks, run.console)
    return tasks


def is_small(view: View) -> bool:
    """Whether other frames are kept in memory beside one of that size."""
    return view.width * view.height <= MOST_AT_ONCE


def ready_renderer(workspace: Workspace, settings: Settings) -> BaseRenderer:
    """The renderer of a workspace whose light is baked; writes no results.

    Raises UserError: ``model.base`` is not rendered, or the light is not baked or out of date.
    """
    if settings.model.base not in RENDERED:
        raise UserError(f"base images of kind {settings.model.base} are not rendered")
    renderer = base_renderer(workspace, settings, plan_of(workspace, settings))
    if not renderer.light_is_baked:
        raise UserError(f"{workspace.root}: the baked light is out of date; run `dnrpipe raytrace-selected` first")
    return renderer


def base_renderer(workspace: Workspace, settings: Settings, plan: EffectPlan) -> BaseRenderer:
    """How base images are rendered under the settings and the effect plan.

    Raises UserError where this machine has no jit variant of Mitsuba.
    """
    chosen, kind = settings.base, settings.model.base
    choice = choose_variant(settings.raytrace.variant)
    if choice.variant.startswith("scalar"):
        raise UserError(
            f"model.base={kind} needs a jit variant of Mitsuba (LLVM or CUDA; see `dnrpipe doctor`);"
            " or choose --set model.base=raster"
        )
    config = trace_config(workspace, plan, choice.variant)
    inputs = [config["integrator"], config["max_depth"], sorted(plan.left_out), scene_fingerprint(workspace)]
    common: dict[str, Any] = {
        "bundle": config["bundle"],
        "variant": choice.variant,
        "kind": kind,
        "samples": chosen.samples,
    }
    if kind == "baked":
        baked = light_plan(settings, plan, fine=read_summary(workspace.scene).atlas.loses_most)
        common |= {"light": str(light_path(workspace)), "denoise": chosen.denoise}
        light = {
            "output": common["light"],
            "size": baked.size,
            "spp": baked.spp,
            "gather": baked.gathered,
            "gloss": not chosen.denoise,
            "integrator": config["integrator"],
            "max_depth": config["max_depth"],
            "seed": settings.raytrace.seed,
            "views": _looked_from(workspace) if chosen.light_where == "seen" else [],
        }
        # Without what was the only choice once: light that was baked then stays.
        usual = {"gather": False, "gloss": True, "views": []}
        decides = {k: v for k, v in light.items() if k != "output" and usual.get(k) != v}
        light["fingerprint"] = digest([LIGHT_VERSION, inputs, decides])
        fingerprint = digest([light["fingerprint"], chosen.samples, DENOISE_VERSION if chosen.denoise else False])
        return BaseRenderer(common, choice.environment, light, fingerprint)
    direct = kind == "direct"
    common |= {
        "integrator": "path" if direct else config["integrator"],
        "max_depth": 2 if direct else config["max_depth"],
        "spp": chosen.spp,
        "seed": settings.raytrace.seed,
    }
    fingerprint = digest([kind, inputs, chosen.spp, chosen.samples, settings.raytrace.seed])
    return BaseRenderer(common, choice.environment, None, fingerprint)


def _looked_from(workspace: Workspace) -> list[dict[str, Any]]:
    """Views that say what is seen, JSON-able."""
    views = split_views(workspace)
    chosen = (*spread(views.get("train", []), LOOKED_FROM), *views.get("test", []))
    return [view.model_dump(mode="json") for view in chosen]


def bake_light(run: Run, renderer: BaseRenderer) -> dict[str, Any] | None:
    """Bake the light where it is missing or of other inputs -> the worker's answer; None where nothing was due.

    Raises UserError: it failed twice.
    """
    task = renderer.light
    if task is None or renderer.light_is_baked:
        return None
    variant = renderer.common["variant"]
    with run.console.bar("baking light", 1) as bar:
        result = only_answer(
            "baking light",
            "dnrpipe.raytrace.light_worker",
            {"bundle": renderer.common["bundle"], "variant": variant},
            task,
            log=run.log,
            console=run.console,
            environment=renderer.environment,
            place=run.place,
        )
        each = "gathered rays" if result["gathered"] else "paths"
        bar.advance(note=f"{task['size']}² texels, {task['spp']} {each}")
    if task["gather"] and not result["gathered"]:
        run.console.say("baked light: paths were traced: rays are gathered where light bounces and nothing has volume")
    if result["lost"]:
        run.console.warn(f"repaired: {result['lost']} samples of the baked light were not finite and are left out")
    run.book(
        "training",
        "scene",
        "light",
        result["seconds"],
        cpu_seconds=result["cpu_seconds"],
        device=f"mitsuba {variant}",
        spp=task["spp"],
        peak_mb=result["peak_mb"],
        detail={"texels": result["texels"], "lost": result["lost"]},
    )
    return result
