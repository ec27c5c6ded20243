"""What the workers of this package are asked, and what they answer. No bpy here.

Tasks travel as plain values: ``PrepareTask(...).data()``; the worker reads them by ``model_validate``, so that a
malformed one fails with its name. What all tasks of a worker share (``common``) is sent once, when it starts.

Seconds are wall-clock, ``cpu_seconds`` of the process. A ``fingerprint`` is a hash of all that decides a file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypedDict

from pydantic import Field

from dnrpipe.core.scene_records import Census, SceneRecord
from dnrpipe.raytrace.tasks import Task
from dnrtrain.contract import View

# -- prepare, inspection: a scene file -> scene/, or what is in it ----------------------------------------------


class BakeOptions(Task):
    """folder: cached bakes, files named by content. size: texels of the atlas' side. refused: keys not to ask for."""

    folder: Path
    size: int
    refused: tuple[str, ...] = ()


class PrepareTask(Task):
    """Convert ``source`` into the folder ``scene_dir``. strict: missing files are errors. bakes: None bakes nothing."""

    source: Path
    scene_dir: Path
    strict: bool = False
    bakes: BakeOptions | None = None


ValueKind = Literal["colour", "scalar", "normal"]


class Tap(Task):
    """A value inside a material: output ``socket`` (identifier) of ``node``, inside the group nodes ``groups``.

    kind: a colour or a normal takes a bake of its own; scalars go three to a bake. key: names the file of the result.
    """

    kind: ValueKind
    groups: tuple[str, ...]
    node: str
    socket: str
    key: str


class MaterialTaps(Task):
    """Values of a material that one bake yields: a colour, a normal, or up to three scalars."""

    material: str
    taps: tuple[Tap, ...]


class PendingBakes(Task):
    """What has to be baked before a scene can be exported.

    layers: of one bake each. frame: the scene's current one. external: other files that the scene file refers to.
    """

    layers: tuple[tuple[MaterialTaps, ...], ...]
    frame: int
    external: tuple[Path, ...] = ()


class PrepareAnswer(Task):
    """bakes: nothing was exported; bake these, and run the same task again."""

    bakes: PendingBakes | None


class InspectTask(Task):
    """Say what is in ``source``. folder: scratch for the converted bundle. bake_size: texels of the atlas' side."""

    source: Path
    folder: Path
    bake_size: int


class InspectAnswer(SceneRecord):
    """warnings: lines for the user."""

    census: Census
    warnings: list[str]


# -- shot: the frames of a shot ---------------------------------------------------------------------------------


class ShotTask(Task):
    """Say what a shot of ``source`` sees. Answers `core.shot_records.ShotFacts`.

    Args:
        frames: rising; None for the file's own range.
        camera: name of one; None for the one that Blender renders each frame with.
    """

    source: Path
    frames: tuple[int, ...] | None = None
    camera: str | None = None


# -- scene_at_frame: a converted scene, as it is at other frames ----------------------------------------------------


class SceneAtCommon(Task):
    """A scene file and its conversion.

    Args:
        scene_dir: of the conversion, whose atlas, bakes and textures the frames take over.
        bakes: without ``refused``.
        lit: whether the file brings light of its own at the frame that was converted; where it does, a dark frame
            stays dark.
    """

    source: Path
    scene_dir: Path
    bakes: BakeOptions
    lit: bool


class SceneAtTask(Task):
    """Write the bundle of the scene at ``frame`` into the folder ``output``. Answers a `PrepareAnswer`."""

    frame: int
    output: Path
    refused: tuple[str, ...] = ()


# -- baking.bake: values of sockets over the atlas --------------------------------------------------------------


class BakeCommon(Task):
    """A scene file at a frame, and its frozen geometry.

    Args:
        geometry: an npz as of `geometry.frozen`.
        folder: for results: ``KEY.npy``, float16 or float32 [N, C], a row per texel of the material's region.
        size: texels of the atlas' side.
        threads: of Cycles; 0 for all cores.
    """

    source: Path
    frame: int
    geometry: Path
    folder: Path
    size: int
    threads: int


class BakeTask(Task):
    """Bake one emission of each material. output: the folder of the results."""

    layer: tuple[MaterialTaps, ...]
    output: Path


class BakeAnswer(TypedDict):
    """repaired: texels that were not finite, by material."""

    seconds: float
    repaired: dict[str, int]


# -- passes: G-buffers and rasterised colour -------------------------------------------------------------------


class PassesCommon(Task):
    """A prepared scene.

    Args:
        raster_engine: "eevee", "workbench" or "cycles-direct"; "cycles" as the file has it.
        raster_samples, coverage_samples: per pixel.
        threads: of Cycles; 0 for all cores.
    """

    scene_dir: Path
    raster_engine: str
    raster_samples: int
    coverage_samples: int
    threads: int = 0


class PassesTask(Task):
    """Write a view's passes to ``output``, an EXR file. raster: with rasterised colour."""

    view: View
    output: Path
    raster: bool
    fingerprint: str


class PassesHeader(TypedDict):
    """Header of a view's file. repaired: pixels that were not finite or had no normal, and are 0."""

    fingerprint: str
    view: str
    raster_engine: str | None
    raster_samples: int
    repaired: int
    seconds: float
    gbuffer_seconds: float
    coverage_seconds: float
    raster_seconds: float


class PassesAnswer(PassesHeader):
    """peak_mb: memory of the processes so far."""

    cpu_seconds: float
    peak_mb: float


class RasterTrial(TypedDict):
    """Two small frames of an engine. ok: they were drawn. seconds_first: that of the first frame compiles shaders."""

    ok: bool
    seconds_first: float
    seconds_next: float


# -- passes.cycles_frames: frames of Cycles as the file has it --------------------------------------------------


class CyclesCommon(Task):
    """threads: 0 for all cores."""

    threads: int


class CyclesTask(Task):
    """Render the views at each number of samples per pixel, and a reference of ``reference_spp``, if any.

    Args:
        methods: of `cycles_frames.METHODS`; none: all.
        seed: of the views' numbers; the reference's is the next one.
        background: the world stands behind everything, else nothing.
        folder: for the pictures: ``NAME/VIEW.exr``, linear Rec.709, premultiplied RGBA.
        output: for the answer, as JSON.
    """

    scene_dir: Path
    views: tuple[View, ...]
    samples: tuple[int, ...]
    methods: tuple[str, ...] = ()
    seed: int = 1
    reference_spp: int | None = None
    background: bool = False
    folder: Path
    output: Path


class CyclesAnswer(Task):
    """By name, such as ``4 spp raw``, for each view: ``ms``, processor time over the threads in milliseconds, and
    ``seconds`` of the wall clock."""

    threads: int
    ms: dict[str, list[float]]
    seconds: dict[str, list[float]] = Field(default_factory=dict)
