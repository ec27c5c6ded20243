"""The shipped corrector, what starts from it, and its training on many scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dnrtrain.atomic import write_json
from dnrtrain.contract import ContractError
from dnrtrain.dataset import ViewSet
from dnrtrain.pretrain import CORRECTOR, pretrain
from dnrtrain.pretraining_data import Scene, SceneMaps, channel_names
from dnrtrain.settings import LossWeights, ModelSettings, Step2Settings
from dnrtrain.shipped import WEIGHTS, corrector, with_corrector
from dnrtrain.step2 import run_step2

from . import synthetic
from .test_base import baked, load  # noqa: F401

SMALL = {"texture_size": 16, "modalities": "uv", "aggregator": "residual"}


def test_the_corrector_is_small_and_of_no_scene() -> None:
    model = corrector()
    assert model.settings == CORRECTOR and not hasattr(model, "aggregator")
    assert WEIGHTS.stat().st_size < 2 << 20


@pytest.mark.parametrize("chain", [False, True])
def test_a_scenes_model_begins_as_the_corrector(baked: ViewSet, chain: bool) -> None:  # noqa: F811
    settings = CORRECTOR.model_copy(update={**SMALL, "chain": chain})
    batch = baked.batch([1])
    with torch.no_grad():
        alone, begun = corrector(precision="float32")(batch), with_corrector(settings, seed=3)(batch)
    assert batch.base is not None and not torch.allclose(alone.rgb, batch.base, atol=0.01)
    assert torch.allclose(alone.rgb, begun.rgb, atol=1e-5)
    assert alone.texture is None and begun.texture is not None and not begun.texture.any()


def test_another_network_is_refused_by_name() -> None:
    with pytest.raises(ContractError, match=r"model.width is 8.*finetune.step2.start=fresh"):
        with_corrector(CORRECTOR.model_copy(update={"width": 8}), seed=0)


def test_step_2_trains_corrector_and_texture(baked: ViewSet, tmp_path: Path) -> None:  # noqa: F811
    from dnrtrain.checkpoint import load_model

    model = CORRECTOR.model_copy(update=SMALL)
    step2 = Step2Settings(start="pretrained", epochs=3, photometric="l1", loss=LossWeights(perceptual=0.0))
    run = {"seed": 0, "device": "cpu", "checkpoints": tmp_path, "fingerprint": "x", "weights": None}
    list(run_step2(baked, None, tmp_path / "none", model, step2, **run))  # pyright: ignore[reportArgumentType]
    trained = load_model(tmp_path)
    assert trained.aggregator.texture_uv.levels[0].abs().max() > 0
    batch = baked.batch([0])
    with torch.no_grad():
        before, after = (m(batch).rgb - batch.target for m in (with_corrector(model, 0), trained))
    assert after.abs().mean() < before.abs().mean()


def write_scene(folder: Path, seed: int, side: int = 24) -> SceneMaps:
    """Two views of noise whose reference is twice as bright as the base image."""
    rng, inputs = np.random.default_rng(seed), ["2", "8"]
    views = synthetic.dome(2, side)
    names = channel_names(inputs)
    maps = rng.uniform(0.05, 0.4, (2, len(names), side, side)).astype(np.float16)
    for name in ("mask", "coverage", "target.A", *(f"base.A@{k}" for k in inputs)):
        maps[:, names.index(name)] = 1
    for c in "RGB":
        for k in inputs:
            maps[:, names.index(f"base.{c}@{k}")] = maps[:, names.index(f"target.{c}")] / 2
    folder.mkdir(parents=True)
    np.save(folder / "maps.npy", maps)
    scene = Scene(
        seed=seed, family="noise", views=views, inputs=inputs, frame=synthetic.FRAME, triangles=2, noise=0.0, seconds={}
    )
    write_json(folder / "scene.json", scene.model_dump(mode="json"))
    return SceneMaps(folder)


def test_pretraining_learns_what_all_scenes_share_and_goes_on(tmp_path: Path) -> None:
    scenes = [write_scene(tmp_path / str(seed), seed) for seed in range(3)]
    model = ModelSettings.model_validate({**CORRECTOR.model_dump(), "width": 8, "depth": 1})
    options = {"model": model, "batch": 2, "side": 16, "every": 100.0}
    first = list(pretrain(scenes[:2], scenes[2:], tmp_path, seconds=4, **options))  # pyright: ignore[reportArgumentType]
    base, ours = first[-1]["psnr"]
    assert ours > base + 3 and set(first[-1]["by_input"]) == {"2", "8"} and set(first[-1]["by_scene"]) == {2}
    more = list(pretrain(scenes[:2], scenes[2:], tmp_path, seconds=6, **options))  # pyright: ignore[reportArgumentType]
    assert more[-1]["step"] > first[-1]["step"] and more[-1]["seconds"] >= 6 and more[-1]["psnr"][1] > base + 3
