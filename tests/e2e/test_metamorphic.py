"""What must not matter does not, through training: the same still life in other units, under other names, with its
views in another order, and trained in half the bits, ends with the same held-out quality.

What is the same before training is held by tests/test_robust_scenes.py, far more closely, and quickly.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytest.importorskip("bpy")

import e2e_harness as harness

pytestmark = [pytest.mark.slow, pytest.mark.e2e, pytest.mark.robustness]

SMALL = {
    "DNRPIPE_CAMERAS__TRAIN": "6",
    "DNRPIPE_CAMERAS__VAL": "0",
    "DNRPIPE_CAMERAS__TEST": "2",
    "DNRPIPE_CAMERAS__WIDTH": "48",
    "DNRPIPE_CAMERAS__HEIGHT": "48",
    "DNRPIPE_SELECT__BUDGET": "6",
    "DNRPIPE_SELECT__POLICY": "farthest",
    "DNRPIPE_RAYTRACE__SPP": "32",
    "DNRPIPE_RAYTRACE__EVALUATION_SPP": "128",
    "DNRPIPE_RAYTRACE__MAX_DEPTH": "4",
    "DNRPIPE_BASE__LIGHT_SIZE": "64",
    "DNRPIPE_BASE__LIGHT_SPP": "64",
    "DNRPIPE_FINETUNE__STEP2__EPOCHS": "15",
    "DNRPIPE_FINETUNE__STEP2__LOSS__PERCEPTUAL": "0",
    "DNRPIPE_FINETUNE__STEP2__LEARNING_RATE_END": "1e-5",
    "DNRPIPE_FINETUNE__STEP2__PRECISION": "float32",
}
TRACED_TWICE = 0.5
"""dB between scenes that are traced anew: their noise differs."""
SAME_PICTURES = 0.3
"""dB between trainings on the same pictures in another order."""
HALF_THE_BITS = 0.1
"""dB between bfloat16 and float32."""


def _scenes() -> ModuleType:
    """Builders of the still life; the module's own name, should test_robust_scenes.py run in this process, too."""
    if "robust_scenes" not in sys.modules:
        path = Path(__file__).parents[1] / "robust_scenes.py"
        spec = importlib.util.spec_from_file_location("robust_scenes", path)
        assert spec and spec.loader
        sys.modules["robust_scenes"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules["robust_scenes"])
    return sys.modules["robust_scenes"]


def through(commands: tuple[str, ...], folder: Path, *first: str, **extra: str) -> None:
    """Commands in ``folder``; ``first`` are further arguments of the first one."""
    for number, command in enumerate(commands):
        harness.run(command, *(first if number == 0 else ()), folder=folder, **{**SMALL, **extra})


def quality(workspace: Path) -> dict[str, float]:
    """Held-out PSNR by view."""
    views = json.loads((workspace / "evaluation" / "metrics.json").read_text())["views"]
    return {row["name"] if "name" in row else row["view"]: row["psnr"] for row in views}


def difference(one: Path, other: Path) -> float:
    """dB between the means."""
    first, second = quality(one), quality(other)
    print(other, {name: (round(first[name], 2), round(second[name], 2)) for name in first})
    assert set(first) == set(second)
    assert np.mean(list(first.values())) > 20
    return abs(float(np.mean(list(first.values())) - np.mean(list(second.values()))))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The still life as it is, through all stages; the workspace."""
    folder = tmp_path_factory.mktemp("plain")
    scenes = _scenes()
    scenes.save(scenes.SAME["as it is"], folder / "a.blend")
    through(("run",), folder, "a.blend")
    return folder / "a.dnr"


def test_half_the_bits_do_not_matter_on_a_real_scene(plain: Path, tmp_path: Path) -> None:
    shutil.copytree(plain, tmp_path / "a.dnr")
    shutil.copy(plain.parent / "a.blend", tmp_path / "a.blend")
    through(("finetune", "evaluate"), tmp_path, "-w", "a.dnr", DNRPIPE_FINETUNE__STEP2__PRECISION="bfloat16")
    files = [root / "checkpoints" / "step2" / "model.safetensors" for root in (plain, tmp_path / "a.dnr")]
    assert files[0].read_bytes() != files[1].read_bytes()
    assert difference(plain, tmp_path / "a.dnr") < HALF_THE_BITS


@pytest.mark.parametrize("name", ["times 1000", "renamed"])
def test_units_and_names_do_not_matter_to_what_is_learned(plain: Path, tmp_path: Path, name: str) -> None:
    scenes = _scenes()
    scenes.save(scenes.SAME[name], tmp_path / "a.blend")
    through(("run",), tmp_path, "a.blend")
    assert difference(plain, tmp_path / "a.dnr") < TRACED_TWICE


def test_the_order_of_the_views_does_not_matter(plain: Path, tmp_path: Path) -> None:
    """A camera file with all views of the dome, each in its split, last first."""
    frames = []
    for split in ("train", "test"):
        found = json.loads((plain / "cameras" / f"{split}.json").read_text())["frames"]
        frames += [{**frame, "split": split} for frame in found]
    (tmp_path / "views.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames[::-1]}))
    shutil.copy(plain.parent / "a.blend", tmp_path / "a.blend")
    through(("run",), tmp_path, "a.blend", "--cameras", "views.json")
    order = [
        json.loads((root / "cameras" / "train.json").read_text())["frames"][0]["file_path"]
        for root in (plain, tmp_path / "a.dnr")
    ]
    assert order[0] != order[1]
    assert difference(plain, tmp_path / "a.dnr") < SAME_PICTURES
