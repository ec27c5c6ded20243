"""Run dnrpipe as a user does, small enough for a test."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from tools.faults.workspaces import contents

__all__ = ["STAGES", "TINY", "command", "contents", "environment", "image", "run"]

# 64², 6 candidates, a few epochs: everything runs, nothing takes long.
TINY = {
    "DNRPIPE_CAMERAS__TRAIN": "6",
    "DNRPIPE_CAMERAS__VAL": "1",
    "DNRPIPE_CAMERAS__TEST": "2",
    "DNRPIPE_CAMERAS__WIDTH": "64",
    "DNRPIPE_CAMERAS__HEIGHT": "64",
    "DNRPIPE_SELECT__BUDGET": "3",
    "DNRPIPE_SELECT__POLICY": "rl-paper",  # trains step 1; the demo chooses without
    "DNRPIPE_SELECT__STEP1__EPOCHS": "6",
    "DNRPIPE_FINETUNE__STEP2__EPOCHS": "6",
    "DNRPIPE_RAYTRACE__SPP": "32",
    "DNRPIPE_RAYTRACE__EVALUATION_SPP": "32",
    "DNRPIPE_RAYTRACE__EVALUATION_BASELINE": "false",  # a process and four kernels more
    "DNRPIPE_BASE__LIGHT_SIZE": "64",
    "DNRPIPE_BASE__LIGHT_SPP": "16",
    "DNRPIPE_BASE__SAMPLES": "2",
    "DNRPIPE_PASSES__RASTER": "cycles-direct",
}
STAGES = ("prepare", "select", "raytrace-selected", "finetune", "evaluate")


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "dnrpipe.cli", *arguments]


def environment(**extra: str) -> dict[str, str]:
    return {**os.environ, **TINY, **extra}


def run(*arguments: str, folder: Path, check: bool = True, **extra: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        command(*arguments), cwd=folder, env=environment(**extra), capture_output=True, text=True, check=False
    )
    if check and done.returncode != 0:
        raise AssertionError(f"dnrpipe {' '.join(arguments)} ended with {done.returncode}:\n{done.stderr}")
    return done


def image(path: Path) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(path), dtype=np.float32) / 255
