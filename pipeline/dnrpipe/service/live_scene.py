"""What the live viewer needs of a workspace, and its orbit cameras."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from dnrtrain.contract import View, read_cameras
from dnrtrain.settings import Strict

from ..core.cameras import framing, look_at_view
from ..core.errors import UserError
from ..core.scene_files import read_frame, read_selection, read_summary
from ..core.settings import Settings
from ..core.workspace import Workspace
from ..effects.store import plan_of, trace_config, variant_for
from ..stages.base_images import RENDERED, ready_renderer
from ..stages.session import resolve_settings

SIZES = (64, 1024)
STEEPEST = math.radians(89.0)
Mode = Literal["neural", "base", "reference", "error", "normal", "depth", "uv", "albedo", "coverage", "nearest"]


Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]


class Orbit(Strict):
    """A camera that looks at ``target``, upright. Angles in radians, lengths in scene units, Z up."""

    azimuth: float = Field(ge=-1e3, le=1e3)
    elevation: float = Field(ge=-STEEPEST, le=STEEPEST)
    distance: float = Field(ge=1e-9, le=1e9)
    target: tuple[Coordinate, Coordinate, Coordinate]


class LiveRequest(Strict):
    """A viewer's request. size: pixels of the side at rest; moving: quick is better than fine."""

    camera: Orbit
    size: int = Field(ge=SIZES[0], le=SIZES[1])
    mode: Mode = "neural"
    moving: bool = False


@dataclass(frozen=True)
class LiveScene:
    """common, environment: of the frame process. fingerprint: changes when the model does. hello: the first message."""

    root: Path
    fingerprint: str
    common: dict[str, Any]
    environment: dict[str, str]
    hello: dict[str, Any]
    settings: Settings
    focal: float
    """Focal length in units of the image's side."""
    training: tuple[View, ...]

    def view(self, camera: Orbit, size: int) -> View:
        """The view of ``camera``, ``size``² pixels. Raises UserError: it stands in its own target, as numbers go."""
        ce = math.cos(camera.elevation)
        direction = np.array([ce * math.cos(camera.azimuth), ce * math.sin(camera.azimuth), math.sin(camera.elevation)])
        target = np.asarray(camera.target, np.float64)
        if camera.distance < 1e-6 * float(np.abs(target).max()):
            raise UserError("camera.distance: too small beside its target; move away, or nearer to the origin")
        settings = self.settings.cameras.model_copy(update={"width": size, "height": size})
        return look_at_view("live", target + camera.distance * direction, target, self.focal * size, settings)

    def nearest(self, view: View) -> View | None:
        """The ray-traced training view that is most like ``view``: by position (in scene radii) and direction."""
        if not self.training:
            return None
        radius = self.hello["radius"]

        def difference(other: View) -> float:
            distance = np.linalg.norm(other.position - view.position) / radius
            return float(distance + 1 - other.matrix[:3, 2] @ view.matrix[:3, 2])

        return min(self.training, key=difference)


def open_scene(root: Path) -> LiveScene:
    """Read a workspace for viewing. Raises UserError: it cannot be viewed yet; names the stage to run first."""
    workspace = Workspace.open(root)
    record = workspace.manifest.stages.get("finetune")
    if record is None:
        raise UserError(f"{root.name}: has no renderer yet; submit a job run, finetune or render")
    settings = resolve_settings(workspace, {}, None)
    kind = settings.model.base
    if kind == "raster":
        raise UserError(f"{root.name}: its base images are rasterised by Blender, which is too slow to look around in")
    plan = plan_of(workspace, settings)
    choice = variant_for(plan, settings)
    config = trace_config(workspace, plan, choice.variant)
    base, environment = None, choice.environment
    if kind in RENDERED:
        renderer = ready_renderer(workspace, settings)
        base, environment = renderer.common, renderer.environment
    frame, summary = read_frame(workspace), read_summary(workspace.scene)
    pixels, distance = framing(summary, settings.cameras)
    names = set(read_selection(workspace).views)
    views = [view for view in read_cameras(workspace.cameras("train")) if view.name in names]
    return LiveScene(
        root=root,
        fingerprint=json.dumps([record.output, base, config], sort_keys=True),
        common={
            "scene": str(workspace.scene),
            "frame": frame.model_dump(mode="json"),
            "checkpoint": str(workspace.checkpoints("step2")),
            "device": settings.device,
            "kind": kind,
            "base": base,
            **{key: config[key] for key in ("bundle", "variant", "integrator", "max_depth")},
        },
        environment=environment,
        hello={
            "center": list(summary.bounds.center),
            "radius": summary.bounds.radius,
            "distance": float(distance),
            "size": min(max(settings.cameras.width, SIZES[0]), SIZES[1]),
            "modes": [m for m in Mode.__args__ if kind != "none" or m not in ("base", "albedo")],
        },
        settings=settings,
        focal=pixels / min(settings.cameras.width, settings.cameras.height),
        training=tuple(views),
    )
