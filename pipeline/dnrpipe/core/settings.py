"""Settings: one nested model per stage; presets; dnrpipe.toml < environment < flags.

Flags are remembered in the workspace, so `dnrpipe select --budget 25` still holds when
`dnrpipe report` runs. Unknown keys are errors that name the key and its neighbours.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from dnrtrain.selector.names import TRAINED_NAMES, PolicyName
from dnrtrain.settings import ModelSettings, Step1Settings, Step2Settings, Strict

from .effect_names import EffectName
from .errors import UserError
from .presets import PRESETS, merge
from .units import parse_seconds, parse_share

ENVIRONMENT_PREFIX = "DNRPIPE_"
ENVIRONMENT_OTHER = {
    *("DNRPIPE_WORKSPACE", "DNRPIPE_CACHE", "DNRPIPE_EVENTS"),
    *("DNRPIPE_SERVER", "DNRPIPE_TOKEN_FILE", "DNRPIPE_TASK_TIMEOUT"),
}
"""Variables that are no settings."""


class CameraSettings(Strict):
    """Which views exist."""

    source: str = Field(
        default="auto",
        description="auto (inside where the scene's own camera stands inside or is animated, else dome), dome, sphere,"
        " inside, scene, animation, or a transforms.json",
    )
    source_sha256: str = Field(default="", description="set where source is a file, so that a changed one is noticed")
    train: int = Field(default=100, ge=1, le=100_000, description="candidate views")
    val: int = Field(default=100, ge=0, le=100_000)
    test: int = Field(default=200, ge=0, le=100_000)
    width: int = Field(default=800, ge=8, le=16384)
    height: int = Field(default=800, ge=8, le=16384)
    distance: float = Field(default=1.0, gt=0, description="1 = the bounding sphere just fits the frame")
    seed: int = Field(default=0, ge=0)


class PassSettings(Strict):
    """Rasterised colour and G-buffers."""

    raster: Literal["auto", "eevee", "workbench", "cycles-direct"] = "auto"
    raster_samples: int = Field(default=4, ge=1, le=4096)
    coverage_samples: int = Field(default=64, ge=1, le=4096, description="samples of the coverage pass")
    bake_size: int = Field(
        default=2048, ge=64, le=16384, description="texels of the side of the atlas that procedural textures bake into"
    )
    workers: int = Field(default=0, ge=0, description="0 = one per core")


class RaytraceSettings(Strict):
    """Path tracing with Mitsuba."""

    spp: int = Field(
        default=256, ge=1, le=1_000_000, description="samples per pixel, where neither noise nor time is set"
    )
    noise: float | None = Field(
        default=None, gt=0, lt=1, description="trace each view until its relative RMSE in display space is this: 1%"
    )
    time: float | None = Field(
        default=None, gt=0, description="seconds (90s, 10m) for all views together; shared so that noise is least"
    )
    max_spp: int = Field(
        default=16384, ge=8, le=1_000_000, description="samples per pixel at most, where noise or time is the target"
    )
    evaluation_spp: int = Field(
        default=512, ge=1, le=1_000_000, description="samples of held-out references, without evaluation_noise"
    )
    evaluation_noise: float | None = Field(
        default=None, gt=0, lt=1, description="trace held-out references until their noise is this"
    )
    max_depth: Annotated[int, Field(ge=1, le=10_000)] | Literal["auto"] = Field(
        default="auto", description="path vertices, 2 = direct light; auto: as deep as the scene needs, by a pilot"
    )
    variant: Literal["auto", "cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb"] = "auto"
    denoise: bool = Field(default=False, description="denoise the views that are trained on (Open Image Denoise)")
    evaluation_denoise: bool = Field(default=False, description="denoise the held-out references")
    evaluation_baseline: bool = Field(
        default=True, description="time path tracing at a few samples with the denoiser on two test views, too"
    )
    seed: int = Field(default=0, ge=0)
    workers: int = Field(default=0, ge=0, description="0 = one per core")

    @field_validator("noise", "evaluation_noise", mode="before")
    @classmethod
    def _share(cls, value: Any) -> Any:
        return parse_share(value) if isinstance(value, str) else value

    @field_validator("time", mode="before")
    @classmethod
    def _seconds(cls, value: Any) -> Any:
        return parse_seconds(value) if isinstance(value, str) else value


class BaseSettings(Strict):
    """The image that the network corrects, where `model.base` is rendered (baked, direct, path)."""

    light: Literal["auto", "traced", "gathered"] = Field(
        default="auto",
        description="how light is baked: by paths, or by rays that end at a coarse map after one bounce;"
        " auto: the latter where much of the light has bounced",
    )
    light_size: Annotated[int, Field(ge=16, le=16384)] | Literal["auto"] = Field(
        default="auto",
        description="texels of the baked light's side; auto: 1024 at 128 to 256 pixels,"
        " twice that where most triangles hold no texel",
    )
    light_spp: Annotated[int, Field(ge=1, le=1_000_000)] | Literal["auto"] = Field(
        default="auto",
        description="paths or rays per texel of the baked light; auto: 16 paths, 32 gathered rays",
    )
    light_where: Literal["auto", "everywhere", "seen"] = Field(
        default="auto",
        description="where texels count: all alike, or by the pixels that see them; auto: the latter in shots",
    )
    samples: int = Field(default=8, ge=1, le=64, description="rays per pixel of a base image")
    denoise: bool = Field(
        default=True, description="take the grain off base images of kind baked, before the network sees them"
    )
    spp: int = Field(default=4, ge=1, le=1_000_000, description="path-traced samples of the kinds direct and path")


class EffectSettings(Strict):
    """Which effects are simulated where the plan (`dnrpipe effects`) decides otherwise, and how deep paths go."""

    enable: tuple[EffectName, ...] = Field(
        default=(), description="effects to simulate although nothing calls for them"
    )
    disable: tuple[EffectName, ...] = Field(default=(), description="effects to leave out; wins over enable")
    tolerance: float = Field(
        default=0.005, gt=0, le=1, description="light that the path depth may miss, as a share of the mean radiance"
    )
    pixel_tolerance: float = Field(default=0.02, gt=0, le=1, description="the same at the 99th percentile pixel")


MOST_VIEWS = 25
"""The usual number of traced views, and the most that ``auto`` takes."""


class SelectSettings(Strict):
    """Which of the candidates are ray-traced."""

    budget: Annotated[int, Field(ge=0)] | Literal["auto"] = Field(
        default=MOST_VIEWS,
        description="views to ray-trace; 0: none, and no training: the shipped corrector as it is; auto: as many as are"
        " worth their seconds",
    )
    worth: float = Field(default=0.3, ge=0, le=1e6, description="decibels that a minute is worth, with budget = auto")
    policy: PolicyName = Field(default="auto", description="how they are chosen (docs/method.md)")
    seed: int = Field(default=0, ge=0)
    step1: Step1Settings = Step1Settings()

    @property
    def most(self) -> int:
        """The budget as a number: with ``auto`` the most that it takes."""
        return MOST_VIEWS if self.budget == "auto" else self.budget


class ExecutorSettings(Strict):
    """Where lists of tasks run; it decides nothing of what they make."""

    engine: Literal["local", "ray"] = Field(
        default="local", description="processes of this machine, or a Ray cluster (docs/scaling.md)"
    )
    address: str = Field(
        default="local",
        description="of the cluster: local (one of this machine's own), auto (the running one), or HOST:PORT",
    )
    workers: int = Field(
        default=0,
        ge=0,
        description="workers to ask the cluster for at once; 0: as many as it has room for now. More than fit make an"
        " autoscaler add nodes",
    )
    shared: bool = Field(
        default=False, description="all nodes see the workspace under the same path: nothing is sent to and fro"
    )


class FinetuneSettings(Strict):
    """Step 2."""

    seed: int = Field(default=0, ge=0)
    preview_seconds: float = Field(
        default=10.0,
        ge=0,
        le=1e6,
        description="of training between pictures of a held-out view, to look at, at least; 0 = no pictures",
    )
    step2: Step2Settings = Step2Settings()


class Settings(Strict):
    """Everything that decides what a run computes."""

    preset: str = "draft"
    strict: bool = Field(default=False, description="refuse scenes with missing files or anything ignored")
    cameras: CameraSettings = CameraSettings()
    passes: PassSettings = PassSettings()
    model: ModelSettings = ModelSettings()
    base: BaseSettings = BaseSettings()
    select: SelectSettings = SelectSettings()
    raytrace: RaytraceSettings = RaytraceSettings()
    effects: EffectSettings = EffectSettings()
    finetune: FinetuneSettings = FinetuneSettings()
    executor: ExecutorSettings = ExecutorSettings()
    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$", description="torch device")

    @model_validator(mode="after")
    def _fits(self) -> Settings:
        start = self.finetune.step2.start
        if start == "pretrained" and self.select.budget != 0 and (conflict := self.model.unlike_corrector()):
            raise ValueError(f"finetune.step2.start = pretrained, but {conflict}")
        if self.select.budget == "auto" and start != "pretrained":
            raise ValueError(
                "select.budget = auto weighs training against the shipped corrector, and finetune.step2.start ="
                f" {start}; type --set finetune.step2.start=pretrained, or name a number of views"
            )
        if start == "coarse" and self.model.aggregator == "none":
            raise ValueError(
                "finetune.step2.start = coarse begins with step 1's neural texture, and aggregator = none has none;"
                " type --set finetune.step2.start=pretrained, or --set model.aggregator=residual"
            )
        return self

    def with_budget(self, views: int) -> Settings:
        """With so many views to ray-trace."""
        return self.model_copy(update={"select": self.select.model_copy(update={"budget": views})})

    @property
    def trains_step1(self) -> bool:
        """Whether the coarse model is wanted: by the policy, or as the start of step 2."""
        return self.select.budget != 0 and (self.select.policy in TRAINED_NAMES or self.starts_coarse)

    @property
    def starts_coarse(self) -> bool:
        """Whether step 2 starts from step 1's model."""
        return self.finetune.step2.start == "coarse"


def resolve(
    preset: str | None,
    overrides: Mapping[str, Any],
    *,
    toml_files: Sequence[Path] = (),
    environment: Mapping[str, str] = os.environ,
) -> Settings:
    """Layer preset < TOML files (in order) < environment < overrides, and validate.

    Args:
        preset: its name; None: the one that the latest layer names, else draft.
        overrides: nested dict of what the flags say.
        toml_files: later ones win.
        environment: variables such as ``DNRPIPE_FINETUNE__STEP2__EPOCHS=20``.

    Raises:
        UserError: names the layer and the key, or the key and the value.
    """
    layers = [(str(path), _read_toml(path)) for path in toml_files]
    layers += [("environment", _from_environment(environment)), ("flags", overrides)]
    given: dict[str, Any] = {}
    for source, layer in layers:
        _check_keys(source, layer, Settings)
        given = merge(given, layer)
    name = str(preset or given.get("preset") or "draft")
    if name not in PRESETS:
        raise UserError(f"unknown preset '{name}'; choose one of {', '.join(PRESETS)}")
    try:
        return Settings.model_validate({**merge(PRESETS[name], given), "preset": name})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "value_error" and isinstance(first["input"], Mapping):  # settings that exclude each other
            raise UserError(f"setting {where or 'values'}: {first.get('ctx', {}).get('error')}") from None
        raise UserError(f"setting {where}: {first['msg'].lower()}, got {first['input']!r}") from None


def parse_assignment(text: str) -> dict[str, Any]:
    """``finetune.step2.epochs=20`` -> nested dict. The value is read as TOML, else as a string."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise UserError(f"--set {text!r}: expected KEY=VALUE, e.g. --set finetune.step2.epochs=20")
    return _nest(key.strip().split("."), value.strip())


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid TOML ({error})") from None


def _from_environment(environment: Mapping[str, str]) -> dict[str, Any]:
    """``DNRPIPE_FINETUNE__STEP2__EPOCHS=20`` -> nested dict."""
    result: dict[str, Any] = {}
    for name, value in sorted(environment.items()):
        if name.startswith(ENVIRONMENT_PREFIX) and name not in ENVIRONMENT_OTHER:
            result = merge(result, _nest(name.removeprefix(ENVIRONMENT_PREFIX).lower().split("__"), value))
    return result


def _nest(keys: list[str], text: str) -> dict[str, Any]:
    value: Any = text
    with suppress(tomllib.TOMLDecodeError):
        value = tomllib.loads(f"value = {text}")["value"]
    for key in reversed(keys):
        value = {key: value}
    return value


def _check_keys(source: str, layer: Mapping[str, Any], model: type[Strict], prefix: str = "") -> None:
    for key, value in layer.items():
        if key not in model.model_fields:
            near = difflib.get_close_matches(key, model.model_fields, n=1)
            hint = f"did you mean '{prefix}{near[0]}'?" if near else f"known: {', '.join(model.model_fields)}"
            raise UserError(f"{source}: unknown setting '{prefix}{key}'; {hint}")
        nested = model.model_fields[key].annotation
        if isinstance(value, Mapping):
            if not (isinstance(nested, type) and issubclass(nested, Strict)):
                raise UserError(f"{source}: setting '{prefix}{key}' is a single value, not a table")
            _check_keys(source, value, nested, f"{prefix}{key}.")
