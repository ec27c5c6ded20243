"""Named sets of settings. `PAPER` and `VANILLA` are the one place that says what the paper's method and DNR are.

`SIZES` says how large and how long, for each preset: the two sets leave that out. The presets of the same names, the
rows of `dnrpipe ablate` and the agent of `dnrpipe bench-select` are made of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def merge(base: Mapping[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``extra`` merged into a copy, recursively."""
    result = dict(base)
    for key, value in extra.items():
        if isinstance(value, Mapping):
            below = result.get(key)
            value = merge(below if isinstance(below, Mapping) else {}, value)
        result[key] = value
    return result


# -- what ----------------------------------------------------------------------------------------------------

_PAINTED: dict[str, Any] = {
    "base": "none",
    "guides": False,
    "chain": False,
    "filter": 0,
    "output": "display",
    "network": "unet",
    "stride": 1,
    "aggregator": "concat",
    "spherical_harmonics": True,
    "texture_levels": 4,
    "texture_channels": 16,
}
_RATES = {"learning_rate": 1e-3, "learning_rate_end": 1e-4, "precision": "float32"}
# What the paper leaves open, and why it is as it is here: docs/method.md.
PAPER: dict[str, Any] = {
    "model": {**_PAINTED, "modalities": "uv+depth+normal"},
    # The plan must not take away what the method is about.
    "effects": {"enable": ["view-dependence", "depth", "normal"]},
    "select": {
        "policy": "rl-paper",
        "step1": {
            **_RATES,
            "weight_rl": 0.1,
            "weight_dnr": 1.0,
            "texture_rate_scale": 10.0,
            "reward": "neg-loss",
            "reward_scale": "raw",
            "q_target": "plain",
            "gamma": 0.5,
        },
    },
    "finetune": {
        "step2": {
            **_RATES,
            "start": "coarse",
            "ema": 0.0,
            "patch": 0,
            "augment": True,
            "texture_rate_scale": 10.0,
            "photometric": "l1",
            "frequency_norm": "backward",
            "perceptual_weights": [1 / 32, 1 / 16, 1 / 8, 1 / 4],
            "loss": {
                "photometric": 1.0,
                "ssim": 0.1,
                "perceptual": 0.1,
                "frequency": 0.01,
                "total_variation": 0.001,
                "regularisation": 0.1,
            },
        }
    },
}
PHOTOMETRIC_ONLY = {
    "ssim": 0.0, "perceptual": 0.0, "frequency": 0.0, "total_variation": 0.0, "regularisation": 0.0
}  # fmt: skip
VANILLA: dict[str, Any] = {
    "model": {**_PAINTED, "modalities": "uv"},
    "effects": {"enable": ["view-dependence"]},
    "select": {"policy": "farthest"},
    "finetune": {
        "step2": {
            **_RATES,
            "start": "fresh",
            "ema": 0.0,
            "patch": 0,
            "augment": False,
            "texture_rate_scale": 10.0,
            "photometric": "l1",
            "loss": {"photometric": 1.0, **PHOTOMETRIC_ONLY},
        }
    },
}
"""DNR (Thies et al. 2019): what DNRSelect is compared with."""

# The default model, "dnr": it corrects an image of baked light (docs/method.md; figures in docs/experiments.md).
DNR: dict[str, Any] = {
    "base": "baked",
    "guides": "camera",
    "filter": 3,
    "stride": 2,
    "output": "log",
    "aggregator": "residual",
    "modalities": "uv",
}
DNR_STEP2: dict[str, Any] = {
    "start": "pretrained",
    "ema": 0.99,
    "photometric": "l1",
    "texture_rate_scale": 3.0,
    "perceptual_weights": [1 / 16, 1 / 8, 1 / 4, 1.0],
    "frequency_norm": "ortho",
    "loss": {"perceptual": 0.03},
}


# -- how large -----------------------------------------------------------------------------------------------


def _size(texture: int, width: int, depth: int, step1: int, step2: int, crop: int) -> dict[str, Any]:
    return {
        "model": {"texture_size": texture, "width": width, "depth": depth},
        "select": {"step1": {"epochs": step1}},
        "finetune": {"step2": {"epochs": step2, "perceptual_crop": crop}},
    }


SIZES: dict[str, dict[str, Any]] = {
    "draft": _size(128, 24, 3, 12, 50, 64),
    "standard": _size(256, 32, 4, 30, 60, 192),
    "paper": _size(512, 64, 4, 50, 100, 0),
    "paper-128": _size(128, 24, 3, 50, 100, 64),
}
"""Of a network that paints from nothing, and of its schedule, by the preset that it is trained beside."""
_DENOISED = {"denoise": True, "evaluation_denoise": True}
_DRAFT_TRACING = {"spp": 128, "evaluation_spp": 512, **_DENOISED}
_PICTURES_128: dict[str, Any] = {
    "cameras": {"train": 100, "val": 4, "test": 12, "width": 128, "height": 128},
    "passes": {"bake_size": 1024},
    "raytrace": _DRAFT_TRACING,
}

PRESETS: dict[str, dict[str, Any]] = {
    # Minutes on two CPU cores.
    "draft": {
        "cameras": {"train": 40, "val": 4, "test": 12, "width": 128, "height": 128},
        "passes": {"bake_size": 1024},
        "raytrace": _DRAFT_TRACING,
        "model": {**DNR, "texture_size": 128, "width": 24, "depth": 3},
        "select": {"step1": {"epochs": 12, "texture_rate_scale": 10.0}},
        "finetune": {"step2": {**DNR_STEP2, "epochs": 40, "perceptual_crop": 32}},
    },
    # Minutes to an hour on two CPU cores, at the size of a film.
    "standard": {
        "cameras": {"train": 40, "val": 4, "test": 6, "width": 1280, "height": 720},
        "raytrace": {"spp": 64, "evaluation_spp": 256, **_DENOISED},
        "model": {**DNR, "texture_size": 256, "width": 24, "depth": 3},
        "select": {"step1": {"epochs": 30, "texture_rate_scale": 10.0}},
        "finetune": {"step2": {**DNR_STEP2, "epochs": 60, "patch": 192, "perceptual_crop": 64}},
    },
    # The paper's numbers: pictures and views are the settings' own defaults.
    "paper": merge({"raytrace": _DENOISED}, merge(PAPER, SIZES["paper"])),
    "vanilla": merge({"raytrace": _DENOISED}, merge(VANILLA, SIZES["paper"])),
    # The paper's schedule on pictures of 128²: what docs/ablation.md measures. An hour on one CPU core.
    "paper-128": merge(_PICTURES_128, merge(PAPER, SIZES["paper-128"])),
    "vanilla-128": merge(_PICTURES_128, merge(VANILLA, SIZES["paper-128"])),
}
