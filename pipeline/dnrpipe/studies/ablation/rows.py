"""The rows of the ablation, as data: each is a set of changes to named settings.

Rows of the family ``vanilla`` or ``paper`` start from that set of `core.presets`, at the sizes of the preset; rows of
the family ``dnr`` start from the preset itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import ValidationError

from dnrtrain.selector.names import TRAINED_NAMES

from ...core.errors import UserError
from ...core.presets import PAPER, PHOTOMETRIC_ONLY, SIZES, VANILLA
from ...core.settings import Settings, merge
from ..cells.request import choose_names

NAMED: dict[str, dict[str, Any]] = {"vanilla": VANILLA, "paper": PAPER}


@dataclass(frozen=True)
class Row:
    """One variant.

    name: as on the command line and in tables. what: for people. changes: nested settings. everything: train on all
    candidates, whatever the policy. network: False measures the base image alone. against: the row that differs in this
    one thing. as_long: step 2 has the steps that row `paper` makes in both. budget, spp: views and samples of their ray
    tracing, None = the run's.
    """

    name: str
    what: str
    family: Literal["vanilla", "paper", "dnr"]
    changes: Mapping[str, Any] = field(default_factory=dict)
    everything: bool = False
    network: bool = True
    against: str | None = None
    as_long: bool = False
    budget: int | None = None
    spp: int | None = None


def _model(**changes: Any) -> dict[str, Any]:
    return {"model": changes}


def _step2(**changes: Any) -> dict[str, Any]:
    return {"finetune": {"step2": changes}}


def _policy(name: str) -> dict[str, Any]:
    return {"select": {"policy": name}}


def _reward(name: str) -> dict[str, Any]:
    return {"select": {"step1": {"reward": name}}}


def _paper(name: str, what: str, changes: Mapping[str, Any]) -> Row:
    return Row(f"paper-{name}", what, "paper", changes, against="paper")


_NO_BASE: dict[str, Any] = {"base": "none", "guides": True, "chain": False, "filter": 0, "output": "display"}
_FRESH = _step2(start="fresh")


def _other_network(name: str, what: str, **changes: Any) -> Row:
    """A row whose network is not the shipped corrector's: it starts fresh, and so does what it is compared with."""
    return Row(name, what, "dnr", merge(_FRESH, _model(**changes)), against="dnr-start-fresh")


_ROWS = (
    Row("vanilla", "DNR (Thies et al. 2019): UV texture, harmonics, U-Net, L1, from scratch", "vanilla"),
    Row("vanilla-long", "DNR with the steps that DNRSelect makes in both of its own", "vanilla", as_long=True),
    Row("paper", "DNRSelect: RL-driven step 1, six losses, augmentation, D + N + U textures fused by a CNN", "paper"),
    _paper("no-augmentation", "without flips and rotations", _step2(augment=False)),
    _paper("one-loss", "photometric loss only", _step2(loss=PHOTOMETRIC_ONLY)),
    _paper("no-frequency", "without L_FR", _step2(loss={"frequency": 0.0})),
    _paper("no-perceptual", "without L_p", _step2(loss={"perceptual": 0.0})),
    _paper("random", "random views, no RL selector", _policy("random")),
    _paper("farthest", "farthest views, no RL selector", _policy("farthest")),
    _paper("uv", "UV texture only (no aggregator)", _model(modalities="uv")),
    _paper("uv-depth", "UV + depth textures (no normals)", _model(modalities="uv+depth")),
    _paper("uv-normal", "UV + normal textures (no depth)", _model(modalities="uv+normal")),
    _paper("early", "9 channels concatenated, no textures", _model(aggregator="early")),
    _paper("hard", "reward: +loss", _reward("pos-loss")),
    _paper("decrease", "reward: decrease of the error on probe views", _reward("improvement")),
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
    Row("dnr-perceptual", "perceptual loss at 0.1", "dnr", _step2(loss={"perceptual": 0.1}), against="dnr"),
    Row("dnr-augmentation", "with flips and rotations", "dnr", _step2(augment=True), against="dnr"),
    Row("dnr-no-augmentation", "without flips and rotations", "dnr", _step2(augment=False), against="dnr"),
    _other_network("dnr-full-resolution", "network at full resolution", stride=1),
    _other_network("dnr-mlp", "a per-pixel MLP instead of the U-Net", network="mlp"),
    _other_network("dnr-display", "residual in display space", output="display"),
    Row("dnr-log", "residual in log space", "dnr", _model(output="log"), against="dnr"),
    Row("dnr-start-fresh", "step 2 from scratch", "dnr", _FRESH, against="dnr"),
    _other_network("dnr-world-guides", "directions and normals in world space, no noise", guides=True),
    Row("dnr-start-coarse", "step 2 from step 1's weights", "dnr", _step2(start="coarse"), against="dnr"),
    Row("all-views", "the default model trained on all candidates", "dnr", everything=True, against="dnr"),
    Row("base", "the base image alone, no network", "dnr", network=False, against="dnr"),
)  # fmt: skip
ROWS: dict[str, Row] = {row.name: row for row in _ROWS}

PAPER_TABLE = ("vanilla", "paper", "paper-no-augmentation", "paper-one-loss", "paper-random", "paper-uv")
GROUPS: dict[str, tuple[str, ...]] = {
    "core": ("vanilla", "paper", "dnr"),
    "paper-table": PAPER_TABLE,
    "paper-more": ("vanilla-long", "paper-no-frequency", "paper-no-perceptual", "paper-farthest"),
    "fig7a": ("paper", "paper-early", "paper-uv"),
    "fig7b": ("paper-uv", "paper-uv-depth", "paper-uv-normal", "paper"),
    "fig7c": ("paper", "paper-hard", "paper-decrease", "paper-random"),
    "ingredients": tuple(row.name for row in _ROWS if row.family == "dnr"),
    "all": tuple(ROWS),
}


def choose_rows(text: str) -> list[Row]:
    """``"vanilla,dnr"`` or groups of rows, in the order of the table. Raises UserError for unknown names."""
    return [ROWS[name] for name in choose_names("--rows", "row", text, ROWS, GROUPS)]


def settings_of(row: Row, base: Settings, overrides: Mapping[str, Any]) -> Settings:
    """The row's settings: ``base`` (the resolved preset), the row's changes, then the user's ``overrides``."""
    if base.preset not in SIZES:
        raise UserError(f"--preset {base.preset}: the ablation has rows for the sizes of {', '.join(SIZES)}")
    data = base.model_dump(mode="json")
    if row.family == "dnr":
        data = merge(data, _policy("farthest"))
    else:
        data["model"], data["select"]["step1"], data["finetune"]["step2"] = {}, {}, {}
        for layer in (NAMED[row.family], SIZES[base.preset]):
            data = merge(data, layer)
    try:
        settings = Settings.model_validate(merge(merge(data, row.changes), overrides))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UserError(f"row {row.name}: setting {where}: {first['msg'].lower()}") from None
    if row.as_long:
        views = settings.select.most
        episodes = -(-settings.cameras.train // views)
        settings.finetune.step2.epochs += settings.select.step1.epochs * episodes
    return settings


def needs_base(row: Row, settings: Settings) -> bool:
    """Whether the row reads base images."""
    return settings.model.base != "none" or not row.network


def needs_coarse(row: Row, settings: Settings) -> bool:
    """Whether step 1 must run for the row: its network starts there, or its views are chosen there."""
    return row.network and settings.trains_step1


def step1_policy(settings: Settings) -> str:
    """Rows that do not use the RL selector share one coarse model: it is trained the same for all of them."""
    return settings.select.policy if settings.select.policy in TRAINED_NAMES else "farthest"
