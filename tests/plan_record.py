"""``plan/plan.json`` as `dnrpipe plan` writes it, for tests that read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def prediction(seconds: float, psnr: float, *, views: int = 6, epochs: int = 25) -> dict[str, Any]:
    """A choice that is expected to take so many seconds, a half for ray tracing, and to give so many dB."""
    return {
        "choice": {"views": views, "spp": 16, "epochs": epochs, "steps": views * epochs},
        "seconds": {
            "select": 1.0,
            "raytrace": seconds / 2,
            "finetune": seconds / 2 - 1,
            "evaluate": 5.0,
            "total": {"expected": seconds, "low": seconds / 2, "high": seconds * 2},
        },
        "cpu_seconds": seconds,
        "psnr": {"expected": psnr, "low": psnr - 1, "high": psnr + 1},
    }


def plan_record(**more: Any) -> dict[str, Any]:
    """A whole plan, with ``more`` in place of its own."""
    return {
        "schema": 1,
        "made": 1_000_000.0,
        "wanted": {"seconds": None, "psnr": None, "frames": None},
        "pilot": {"fingerprint": "x", "seconds": 90.0, "load": 1.0},
        "policy": "coverage",
        "base_psnr": 28.0,
        "gain": 4.0,
        "chosen": prediction(60, 30.0),
        "table": [prediction(60, 30.0), prediction(120, 31.0), prediction(240, 31.5)],
        "prior": {"source": "here", "scenes": ["demo"], "sd": 0.5},
        "settings_default": prediction(200, 30.5),
        **more,
    }


def write_plan(root: Path, **more: Any) -> Path:
    """``plan/plan.json`` in a workspace's folder."""
    (root / "plan").mkdir(parents=True)
    path = root / "plan" / "plan.json"
    path.write_text(json.dumps(plan_record(**more)))
    return path
