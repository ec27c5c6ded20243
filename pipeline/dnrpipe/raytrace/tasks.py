"""What the workers of this package are asked, and what they answer.

Tasks travel as JSON: ``TraceTask(...).data()``; the worker reads them by ``model_validate``, so that a
malformed one fails with its name. What all tasks of a worker share (``common``) is sent once, when it starts.
Answers are dicts as they come, since they go into the ledger and into file headers.

Seconds are wall-clock, ``cpu_seconds`` of the process. A ``fingerprint`` is a hash of all that decides a file.
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

from pydantic import BaseModel, ConfigDict

from dnrtrain.contract import View

from ..core.scene_records import Lens


class Task(BaseModel):
    """Unknown keys are ignored."""

    model_config = ConfigDict(frozen=True)

    def data(self) -> dict[str, Any]:
        """The task as JSON-able values."""
        return self.model_dump(mode="json")


class BundleCommon(Task):
    """A bundle and the Mitsuba variant that renders it.

    bundle: path of its ``scene.xml``. threads: 1 for bits that repeat, 0 for all cores.
    """

    bundle: Path
    variant: str
    threads: int = 0


class Costs(TypedDict):
    """peak_mb: memory of the process so far."""

    seconds: float
    cpu_seconds: float
    peak_mb: float


def costs_since(wall: float, cpu: float) -> Costs:
    """wall, cpu: `time.monotonic` and `time.process_time` at the start."""
    return {
        "seconds": time.monotonic() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        / (1 << 20 if sys.platform == "darwin" else 1 << 10),
    }


# -- tracer, pass_worker: path-traced views ----------------------------------------------------------------


class TracedView(Task):
    """How a view is path-traced.

    integrator: of `visibility.camera_integrator`. denoise: R G B are denoised, and what was traced is in raw.R, raw.G,
    raw.B.
    """

    view: View
    integrator: str = "path"
    max_depth: int
    lens: Lens | None = None
    seed: int
    denoise: bool = False


class TraceTask(TracedView):
    """Trace a view with ``spp`` samples per pixel into ``output``, an EXR file."""

    spp: int
    output: Path
    fingerprint: str


class PassTask(TracedView):
    """Add a pass of samples to a view.

    samples, samples_fingerprint: file of what is traced so far, see `samples`. add: samples per pixel, a multiple of
    `noise.GROUPS`. rehearse: also make the finished picture, to say how long that takes.
    """

    samples: Path
    samples_fingerprint: str
    add: int
    rehearse: bool = False


class PassGoal(Task):
    """What was asked for and what ended it: target, limit or time (`sample_schedule.Step`)."""

    noise_target: float | None = None
    time_target: float | None = None
    max_spp: int | None = None
    ended_by: str


class WriteTask(TracedView):
    """Write a view's samples as ``output``."""

    samples: Path
    samples_fingerprint: str
    output: Path
    fingerprint: str
    goal: PassGoal


class NoiseFigures(TypedDict):
    """Noise of R G B and of what was traced (raw): see `pictures.finished`."""

    noise: float | None
    noise_error: float | None
    noise_rmse: float | None
    raw_noise: float | None
    raw_noise_error: float | None
    guides_masked: NotRequired[int]
    denoised_error: NotRequired[float | None]
    denoiser_bias: NotRequired[float | None]


class TraceAnswer(NoiseFigures, Costs):
    """Also the header of the view's file.

    integrator: as it was carried out. load_seconds: the bundle's. repaired, masked: pixels that were not finite and
    were traced again, or set to 0.
    """

    spp: int
    max_depth: int
    seed: int
    integrator: str
    variant: str
    load_seconds: float
    repaired: int
    masked: int
    denoised: bool


class WriteAnswer(TraceAnswer):
    """The header's seconds are all of the view's; the answer's are those that no earlier answer held.

    earlier_*: those that an earlier answer held.
    """

    passes: int
    noise_target: float | None
    time_target: float | None
    max_spp: int | None
    ended_by: str
    earlier_seconds: NotRequired[float]
    earlier_cpu_seconds: NotRequired[float]


class PassAnswer(TypedDict):
    """spp, noise, error: of all samples (`noise.Noise`). started: kernels were compiled in this pass."""

    spp: int
    noise: float
    error: float
    seconds: float
    started: bool
    finish_seconds: NotRequired[float]


# -- light_worker, base_worker, surface_maps: baked light and what is shown of it ---------------------------


class LightTask(Task):
    """Bake a light map of size² texels with ``spp`` paths each into ``output``, an ``npz``: see `light_worker`.

    gather: rays instead of paths, as far as the scene allows (`gathering`). gloss: what rough lobes see is baked, too.
    views: what they see gets most of the paths, as many in all; empty: all texels get as many.
    """

    output: Path
    size: int
    spp: int
    gather: bool
    gloss: bool = True
    integrator: str
    max_depth: int
    seed: int
    views: tuple[View, ...] = ()
    fingerprint: str


class LightAnswer(Costs):
    """texels: those that are lit. gathered: whether rays were gathered. lost: samples that were not finite."""

    texels: int
    spp: int
    gathered: bool
    lost: int


class BakedCommon(BundleCommon):
    """Base images by baked light. samples: rays per pixel. light: file of the light map.

    denoise: rough lobes are followed instead of looked up, and Open Image Denoise takes the grain. thin: before it few
    samples follow faint paths (`BaseRenderer.frame`).
    """

    kind: Literal["baked"]
    samples: int
    light: Path
    denoise: bool
    thin: bool = False


class SampledCommon(BundleCommon):
    """Base images by ``spp`` path-traced samples per pixel, denoised. samples: rays per pixel of the G-buffer."""

    kind: Literal["direct", "path"]
    samples: int
    integrator: str
    max_depth: int
    spp: int
    seed: int


CHUNK, WARM_UP = 64, 8
"""Frames of a sequence that remember one another; those before a chunk's first that count for it once more, so that no
seam is seen. A chunk is what an interrupted run does again at most."""


def remembers_from(number: int) -> int:
    """The first frame of a sequence that frame ``number`` remembers."""
    return max(0, number - number % CHUNK - WARM_UP)


class BaseTask(Task):
    """Render a view's base image into ``output``, an EXR file. earlier: the frames of a moving camera that it remembers
    (see `history`), in their order; None: it stands alone. number: of the first of them in the camera's way. after: the
    next frame. filtered: with that and the one before it (see `temporal_filter`)."""

    view: View
    earlier: tuple[View, ...] | None = None
    number: int = 0
    after: View | None = None
    filtered: bool = False
    output: Path
    fingerprint: str


class BaseAnswer(Costs):
    """Also the header of the file. repaired, masked: pixels with samples left out, and pixels set to 0."""

    kind: str
    samples: int
    repaired: int
    masked: int


class SurfaceTask(Task):
    """Evaluate the surfaces at ``samples`` points of each of size² texels into ``output``: see `surface_maps`."""

    output: Path
    size: int
    samples: int
    seed: int


class SurfaceAnswer(TypedDict):
    """lost: samples that were not finite."""

    texels: int
    lost: int


# -- pilot: how deep paths must be, what effects cost --------------------------------------------------------


class PilotConfig(BundleCommon):
    """A way of tracing. lenses: views have theirs. passes: Mitsuba's auxiliary channels are computed, too."""

    integrator: str
    max_depth: int
    lenses: bool = True
    passes: bool = False


class PilotCommon(Task):
    """configs: all of the tasks to come."""

    configs: list[PilotConfig]


class PilotView(Task):
    """A view and its lens."""

    view: View
    lens: Lens | None = None


class DepthTask(Task):
    """Find the smallest path depth within the tolerances (shares of the mean radiance), from ``spp`` samples on."""

    kind: Literal["depth"] = "depth"
    config: PilotConfig
    views: list[PilotView]
    spp: int
    tolerance: float
    pixel_tolerance: float


class DepthAnswer(TypedDict):
    """steps: rows of `statistics.DepthStep`. masked: pixels of all pictures that were not finite and count as black."""

    max_depth: int
    spp: int
    steps: list[dict[str, Any]]
    seconds: float
    cpu_seconds: float
    masked: int


class CompareTask(Task):
    """Compare two configurations on the same views, with the same seeds."""

    kind: Literal["compare"] = "compare"
    with_effect: PilotConfig
    without_effect: PilotConfig
    views: list[PilotView]
    spp: int


class CompareAnswer(TypedDict):
    """cost, error: `statistics.Measured`. noise_*: RMSE in display space. seconds_*: CPU seconds. masked: as above."""

    cost: dict[str, float]
    error: dict[str, float]
    significance: float
    noise_with: float
    noise_without: float
    seconds_with: float
    seconds_without: float
    seconds: float
    masked: int
