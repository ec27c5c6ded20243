"""A workspace opened for timing frames: Mitsuba in this process, the plan's integrator, test views, display."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.contract import SceneFrame, View
from dnrtrain.display import DisplayTransform

from ...core.console import Console
from ...core.errors import UserError
from ...core.images import over_white
from ...core.scene_files import read_frame, read_summary, scene_fingerprint, split_views
from ...core.scene_records import SceneSummary
from ...core.settings import Settings
from ...core.workspace import Workspace, digest
from ...effects.store import lenses, trace_config, variant_for
from ...stages.effect_plan import resolve_plan
from ...stages.session import resolve_settings
from ...stages.stage import Run


@dataclass
class Clock:
    """Milliseconds of calls. ``kind`` wall: as the clock on the wall; cpu: CPU time of this process over its threads,

    which is what an idle machine would show for work that keeps all threads busy: for machines that do other things.
    """

    kind: str
    threads: int

    def time(self, function: Callable[[], Any]) -> tuple[Any, float]:
        """(result, ms)"""
        wall, cpu = time.perf_counter(), time.process_time()
        result = function()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return result, 1000 * (wall if self.kind == "wall" else cpu / self.threads)


@dataclass
class BenchScene:
    """What all parts of the benchmark need of one workspace. All views have one size."""

    name: str
    workspace: Workspace
    settings: Settings
    summary: SceneSummary
    frame: SceneFrame
    display: DisplayTransform
    views: list[View]
    bundle: Path
    integrator: str
    max_depth: int
    engine: Any
    frames: Any
    fingerprint: str

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)"""
        return self.views[0].width, self.views[0].height

    def shown(self, image: np.ndarray) -> Any:
        """Premultiplied linear RGBA [H, W, 4] -> display RGB over white, torch [1, 3, H, W]."""
        return over_white(self.display, image)


def open_scene(root: Path, views: int | list[View], threads: int, settings: Settings | None = None) -> BenchScene:
    """Open a workspace that was prepared. Mitsuba must not be imported yet.

    views: so many of its test views, or views of one size. settings: instead of those that the workspace remembers.
    Raises UserError: no test views, or cameras with depth of field (their frames are not timed here).
    """
    from ...raytrace.engine import Engine
    from ...raytrace.frames import Frames

    workspace = Workspace.open(root)
    settings = settings or resolve_settings(workspace, {}, None)
    plan = resolve_plan(Run(workspace, settings, Console(quiet=True), "evaluate", "bench"))
    if plan.on("depth-of-field") and lenses(workspace, settings):
        raise UserError(f"{root}: its cameras have depth of field, which the frame benchmark cannot time")
    chosen = split_views(workspace)["test"][:views] if isinstance(views, int) else views
    if not chosen:
        raise UserError(f"{root}: has no test views; prepare again with cameras.test > 0")
    choice = variant_for(plan, settings)
    os.environ.update(choice.environment)
    config = trace_config(workspace, plan, choice.variant)
    bundle = Path(config["bundle"])
    engine = Engine(config["variant"], threads, [bundle])
    size = (chosen[0].width, chosen[0].height)
    frame = read_frame(workspace)
    return BenchScene(
        name=root.name.removesuffix(".dnr"),
        workspace=workspace,
        settings=settings,
        summary=read_summary(workspace.scene),
        frame=frame,
        display=DisplayTransform(frame, workspace.scene),
        views=chosen,
        bundle=bundle,
        integrator=config["integrator"],
        max_depth=int(config["max_depth"]),
        engine=engine,
        frames=Frames(engine, bundle, config["integrator"], int(config["max_depth"]), size),
        fingerprint=digest([scene_fingerprint(workspace), config["integrator"], config["max_depth"]]),
    )
