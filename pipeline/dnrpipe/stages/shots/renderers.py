"""What renders the frames of a shot: the path tracer, and the neural renderer on baked light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...core.scene_files import read_frame
from ...effects.bundle import write_without
from ...effects.store import trace_config, variant_for
from ..base_images import bake_light, base_renderer
from ..effect_plan import resolve_plan
from ..shot_scene import scene_at
from ..stage import Run
from .frame_tasks import FrameCommon


@dataclass(frozen=True)
class Renderer:
    """A process that renders frames: what it is told when it starts, and its environment. trust: see `FrameTask`."""

    common: FrameCommon
    environment: dict[str, str]
    trust: float = 1.0

    def decides(self, run: Run) -> list[Any]:
        """What of it decides pictures, JSON-able, for fingerprints: no paths, which are as they were typed. What lies
        there is hashed as the scene (`scene_fingerprint`), the light and the weights."""
        common = self.common.model_dump(mode="json", exclude={"bundle", "scene", "checkpoint"})
        if common["base"] is not None:
            common["base"] = {name: value for name, value in common["base"].items() if name not in ("bundle", "light")}
        return [common, sorted(run.effect_plan.left_out)]  # these make the bundle another one

    def at_frame(self, run: Run, frame: int) -> Renderer:
        """Path traces the scene as it is at a frame, for which `convert_frames` has made a bundle."""
        bundle = scene_at(run.workspace, frame) / "scene.xml"
        left_out = run.effect_plan.left_out
        if left_out:
            edited = bundle.with_name("scene-edited.xml")
            write_without(bundle, left_out, edited)
            bundle = edited
        update = {"bundle": bundle, "base": None, "checkpoint": None}
        return Renderer(self.common.model_copy(update=update), self.environment)


def path_tracer(run: Run, background: bool) -> Renderer:
    """Path traces frames of the workspace's scene. background: the camera sees the world behind everything."""
    plan = resolve_plan(run)
    choice = variant_for(plan, run.settings)
    config = trace_config(run.workspace, plan, choice.variant)
    common = FrameCommon(
        bundle=Path(config["bundle"]),
        variant=config["variant"],
        integrator=config["integrator"],
        max_depth=int(config["max_depth"]),
        scene=run.workspace.scene,
        frame=read_frame(run.workspace),
        device=run.settings.device,
        background=background,
    )
    return Renderer(common, choice.environment)


def shipped_renderer(run: Run, background: bool, trust: float) -> Renderer:
    """The shipped corrector, ``trust`` of it, on baked light: bakes that where it is missing."""
    return replace(_neural(run, background, checkpoint=None), trust=trust)


def trained_renderer(run: Run, background: bool) -> Renderer:
    """The renderer that stage `finetune` trained on frames of the shot."""
    return _neural(run, background, checkpoint=run.workspace.checkpoints("step2"))


def _neural(run: Run, background: bool, *, checkpoint: Path | None) -> Renderer:
    tracer = path_tracer(run, background)
    base = base_renderer(run.workspace, run.settings, run.effect_plan)
    with run.timed("baking light: process"):
        bake_light(run, base)
    # A shot looks closely, where faint paths are dear: following few of them saves more than it costs.
    update = {"base": base.common | {"thin": True}, "checkpoint": checkpoint}
    return Renderer(tracer.common.model_copy(update=update), tracer.environment | base.environment)
