"""What the process that renders a shot's frames is asked, and what it answers.

Ways of rendering a frame (`Way`):

    path     path tracing and Open Image Denoise, with albedo and normals of clean primary rays
    base     the base image, baked light and mirror-like paths, denoised or smoothed (`raytrace.smoothing`)
    neural   the same, denoised and corrected by the network

Seconds are wall-clock, ``cpu_seconds`` of the process.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NotRequired

from pydantic import BaseModel, ConfigDict

from dnrtrain.contract import SceneFrame, View

from ...core.scene_records import Lens
from ...raytrace.tasks import Costs, Task

LAYERS = (*"RGBA", "depth.Z", "normal.X", "normal.Y", "normal.Z", "albedo.R", "albedo.G", "albedo.B", "object.Id")
"""Channels of a frame. Normals are of world space; all but colour and albedo are of the ray through the pixel's
centre. Albedo, a mean over the pixel, is of two kinds: of base images and the neural renderer the first surface's
diffuse reflectance, 0 on what has none (metal, glass); of path tracing the denoiser's guide (`raytrace.auxiliary`), of
what mirrors and glass show, and 1 where that has none."""
HALF = ("R", "G", "B", "A", "normal.X", "normal.Y", "normal.Z", "albedo.R", "albedo.G", "albedo.B")
"""Of them, those that are written in 16 bits."""
NETWORK = "network"
"""Name of the network's part of a frame's milliseconds."""
WayName = Literal["path", "base", "neural"]


class Way(BaseModel):
    """How a frame is rendered. spp: samples per pixel of ``path``, rays per pixel of a base image. quality: of the
    denoiser, of ``path``. smooth: ``base`` is smoothed, not denoised."""

    model_config = ConfigDict(frozen=True)

    name: WayName
    spp: int
    quality: Literal["balanced", "high"] = "high"
    smooth: bool = False

    @property
    def told(self) -> str:
        """In words, for tables."""
        if self.name == "path":
            quickly = " quickly" if self.quality == "balanced" else ""
            return f"path tracing, {self.spp} samples, denoised{quickly}"
        if self.name == "neural":
            return f"neural renderer, {self.spp} rays"
        return f"base images, {'smoothed' if self.smooth else 'denoised'}, {self.spp} rays"


class FrameCommon(Task):
    """A scene, and what renders it.

    Args:
        bundle, variant, integrator, max_depth: of path tracing (`effects.store.trace_config`).
        base: common of the base image worker (`raytrace.tasks.BakedCommon`), or None: frames are path-traced only.
        checkpoint: folder of the model; None: the shipped corrector.
        scene, frame: folder and facts of the converted scene, for the display transform.
        device: setting of torch.
        background: the camera sees the world behind everything.
    """

    bundle: Path
    variant: str
    integrator: str
    max_depth: int
    base: dict[str, Any] | None = None
    checkpoint: Path | None = None
    scene: Path
    frame: SceneFrame
    device: str = "auto"
    background: bool = False


class FrameTask(Task):
    """Render a frame into ``output``, an EXR file, and as it is displayed into ``picture``, a PNG.

    Args:
        lens: thin lens of the camera, for ``path``; other ways have pinholes.
        trust: share of the shipped corrector's correction that is applied.
        plain: where the base image alone goes, too; of ``neural``. For comparison: it has no picture.
        earlier: the frames of the camera's way that this one remembers (`raytrace.history`), in their order; None: it
            stands alone. number: of the first of them in the camera's way.
        before, after: what renders the frames next to it, with which it is filtered (`raytrace.temporal_filter`); they
            stand `alone`.
        following: the task that will come next. What it takes is rendered while this frame is written, which keeps all
            cores busy.
    """

    view: View
    way: Way
    lens: Lens | None = None
    earlier: tuple[View, ...] | None = None
    number: int = 0
    trust: float = 1.0
    seed: int
    output: Path
    picture: Path
    plain: Path | None = None
    fingerprint: str
    before: FrameTask | None = None
    after: FrameTask | None = None
    following: FrameTask | None = None

    @property
    def alone(self) -> FrameTask:
        """Renders the frame, not filtered. The same for the same frame, whichever asks for it."""
        return self.model_copy(update={"before": None, "after": None, "following": None, "fingerprint": ""})

    @property
    def takes(self) -> list[FrameTask]:
        """Renders what the frame is made of, in the camera's order."""
        return [each for each in (self.before, self.alone, self.after) if each is not None]


class FrameAnswer(Costs):
    """Also in the header of the file, but for the seconds that writing it took longer than rendering what follows.

    masked: pixels that were not finite and are 0. ms: milliseconds of the parts. The seconds, not the milliseconds,
    leave out what recording kernels took. Rendered while the frame before is written, a frame's have that one's
    processor seconds of writing.
    """

    way: str
    spp: int
    masked: int
    ms: dict[str, float]
    write_seconds: NotRequired[float]
