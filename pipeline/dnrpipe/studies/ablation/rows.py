"""The rows of the ablation, as data: each is a set of changes to a preset's settings.

Rows of the family ``classic`` (vanilla DNR, DNRSelect) start from the trainer's defaults, which are the
paper's, at the sizes of the preset; rows of the family ``dnr`` start from the preset itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import ValidationError

from ...core.errors import UserError
from ...core.settings import Settings, merge
from ..cells.request import choose_names

ViewChoice = Literal["farthest", "random", "rl", "all"]

# What the classic rows share with the paper in kind, at the sizes that fit the preset's images and views.
CLASSIC: dict[str, dict[str, Any]] = {
    "draft": {
        "model": {"texture_size": 128, "width": 24, "depth": 3},
        "select": {"step1": {"epochs": 12, "texture_rate_scale": 10.0}},
        "finetune": {"step2": {"epochs": 50, "texture_rate_scale": 10.0, "perceptual_crop": 64}},
    },
    "standard": {
        "model": {"texture_size": 256, "width": 32, "depth": 4},
        "select": {"step1": {"epochs": 30, "texture_rate_scale": 10.0}},
        "finetune": {"step2": {"epochs": 60, "texture_rate_scale": 10.0, "perceptual_crop": 192}},
    },
    "paper": {},
}
SHARED: dict[str, Any] = {
    "select": {"step1": {"reward_scale": "raw", "q_target": "plain"}},
    # The paper calls its photometric loss "RGB absolute loss"; it also does better than MSE (docs/ablation.md).
    "finetune": {"step2": {"photometric": "l1"}},
    # The plan must not take away what a row is about.
    "effects": {"enable": ["view-dependence", "depth", "normal"]},
}
PHOTOMETRIC_ONLY = {
    "ssim": 0.0, "perceptual": 0.0, "frequency": 0.0, "total_variation": 0.0, "regularisation": 0.0
}  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One variant.

    name: as on the command line and in tables. what: for people. changes: nested settings. views: how the
    training views are chosen. network: False measures the base image alone. against: the row that differs
    in this one thing. full_step1: step 1 runs the preset's epochs even where all rows train equally long, because
    it is what the row is about. budget, spp: views and samples of their ray tracing, None = the run's.
    """

    name: str
    what: str
    family: Literal["classic", "dnr"]
    changes: Mapping[str, Any] = field(default_factory=dict)
    views: ViewChoice = "farthest"
    network: bool = True
    against: str | None = None
    full_step1: bool = False
    budget: int | None = None
    spp: int | None = None


def _model(**changes: Any) -> dict[str, Any]:
    return {"model": changes}


def _step2(**changes: Any) -> dict[str, Any]:
    return {"finetune": {"step2": changes}}


_VANILLA = merge(
    _model(modalities="uv"),
    _step2(start="fresh", augment=False, loss=PHOTOMETRIC_ONLY),
)

_NO_BASE: dict[str, Any] = {"base": "none", "guides": True, "chain": False, "filter": 0, "output": "display"}
_FRESH = _step2(start="fresh")


def _other_network(name: str, what: str, **changes: Any) -> Row:
    """A row whose network is not the shipped corrector's: it starts fresh, and so does what it is compared with."""
    return Row(name, what, "dnr", merge(_FRESH, _model(**changes)), against="dnr-start-fresh")


_ROWS = (
    Row("vanilla", "DNR (Thies et al. 2019): UV texture, harmonics, U-Net, L1, from scratch", "classic", _VANILLA),
    Row("paper", "DNRSelect: coarse step 1, six losses, augmentation, D + N + U textures fused by a CNN", "classic"),
    Row("paper-no-augmentation", "without flips and rotations", "classic", _step2(augment=False), against="paper"),
    Row("paper-one-loss", "photometric loss only", "classic", _step2(loss=PHOTOMETRIC_ONLY), against="paper"),
    Row("paper-rl", "views chosen by the RL selector", "classic", views="rl", against="paper-random", full_step1=True),
    Row("paper-random", "random views, no RL selector", "classic", views="random", against="paper-rl", full_step1=True),
    Row("paper-uv", "UV texture only (no aggregator)", "classic", _model(modalities="uv"), against="paper"),
    Row("paper-uv-depth", "UV + depth textures", "classic", _model(modalities="uv+depth"), against="paper"),
    Row("paper-uv-normal", "UV + normal textures", "classic", _model(modalities="uv+normal"), against="paper"),
    Row("paper-early", "9 channels concatenated, no textures", "classic", _model(aggregator="early"), against="paper"),
    Row("dnr", "the default model", "dnr"),
    _other_network("dnr-base-none", "no base image", **_NO_BASE),
    _other_network("dnr-base-raster", "base image: rasterised", base="raster", guides=True, chain=False),
    Row("dnr-base-baked", "base image: baked light", "dnr", _model(base="baked"), against="dnr"),
    _other_network("dnr-base-direct", "base image: direct light, denoised", base="direct"),
    _other_network("dnr-base-path", "base image: few path-traced samples, denoised", base="path"),
    Row("dnr-no-chain", "texture not looked up at the specular chain's end", "dnr", _model(chain=False), against="dnr"),
    _other_network("dnr-no-filter", "base image not smoothed by predicted kernels", filter=0),
    Row("dnr-chain", "texture looked up at the specular chain's end, too", "dnr", _model(chain=True), against="dnr"),
    _other_network("dnr-no-guides", "no directions, normals, albedo as inputs", guides=False),
    Row("dnr-uv", "UV texture only (no aggregator)", "dnr", _model(modalities="uv"), against="dnr"),
    Row("dnr-all-maps", "UV + depth + normal", "dnr", _model(modalities="uv+depth+normal"), against="dnr"),
    Row("dnr-no-ema", "weights of the last step, no average", "dnr", _step2(ema=0.0), against="dnr"),
    Row("dnr-no-perceptual", "no perceptual loss", "dnr", _step2(loss={"perceptual": 0.0}), against="dnr"),
    Row("dnr-perceptual", "with the paper's perceptual loss", "dnr", _step2(loss={"perceptual": 0.1}), against="dnr"),
    Row("dnr-augmentation", "with flips and rotations", "dnr", _step2(augment=True), against="dnr"),
    Row("dnr-no-augmentation", "without flips and rotations", "dnr", _step2(augment=False), against="dnr"),
    _other_network("dnr-full-resolution", "network at full resolution", stride=1),
    _other_network("dnr-mlp", "a per-pixel MLP instead of the U-Net", network="mlp"),
    _other_network("dnr-display", "residual in display space", output="display"),
    Row("dnr-log", "residual in log space", "dnr", _model(output="log"), against="dnr"),
    Row("dnr-start-fresh", "step 2 from scratch", "dnr", _FRESH, against="dnr"),
    _other_network("dnr-world-guides", "directions and normals in world space, no noise", guides=True),
    Row("dnr-start-coarse", "step 2 from step 1's weights", "dnr", _step2(start="coarse"), against="dnr"),
    Row("all-views", "the default model trained on all candidates", "dnr", views="all", against="dnr"),
    Row("base", "the base image alone, no network", "dnr", network=False, against="dnr"),
)  # fmt: skip
ROWS: dict[str, Row] = {row.name: row for row in _ROWS}

PAPER_TABLE = ("paper", "paper-no-augmentation", "paper-one-loss", "paper-rl", "paper-random", "paper-uv")
GROUPS: dict[str, tuple[str, ...]] = {
    "core": ("vanilla", *PAPER_TABLE, "dnr"),
    "paper-table": PAPER_TABLE,
    "fig7a": ("paper", "paper-early", "paper-uv"),
    "fig7b": ("paper-uv", "paper-uv-depth", "paper-uv-normal", "paper"),
    "ingredients": tuple(row.name for row in _ROWS if row.family == "dnr"),
    "all": tuple(ROWS),
}


def choose_rows(text: str) -> list[Row]:
    """``"vanilla,dnr"`` or groups of rows, in the order of the table. Raises UserError for unknown names."""
    return [ROWS[name] for name in choose_names("--rows", "row", text, ROWS, GROUPS)]


def settings_of(row: Row, base: Settings, overrides: Mapping[str, Any]) -> Settings:
    """The row's settings: ``base`` (the resolved preset), the row's changes, then the user's ``overrides``."""
    if base.preset not in CLASSIC:
        raise UserError(f"--preset {base.preset}: the ablation has rows for the sizes of {', '.join(CLASSIC)}")
    data = base.model_dump(mode="json")
    if row.family == "classic":
        data["model"], data["select"]["step1"], data["finetune"]["step2"] = {}, {}, {}
        for layer in (SHARED, CLASSIC[base.preset]):
            data = merge(data, layer)
    try:
        return Settings.model_validate(merge(merge(data, row.changes), overrides))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UserError(f"row {row.name}: setting {where}: {first['msg'].lower()}") from None


def needs_base(row: Row, settings: Settings) -> bool:
    """Whether the row reads base images."""
    return settings.model.base != "none" or not row.network


def needs_coarse(row: Row, settings: Settings) -> bool:
    """Whether step 1 must run for the row: its network starts there, or its views are chosen there."""
    return row.network and (settings.finetune.step2.start == "coarse" or row.views == "rl")


def step1_policy(row: Row) -> str:
    """Rows that do not use the RL selector share one coarse model: it is trained the same for all of them."""
    return "rl-paper" if row.views == "rl" else "farthest"
