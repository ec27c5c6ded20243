"""Both steps on a GPU, where there is one: they learn what they learn on the CPU, and an interrupted run goes on."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from conftest import Scene
from dnrtrain import graphs
from dnrtrain.checkpoint import load_model
from dnrtrain.events import EpochEnd, Selected
from dnrtrain.metrics import psnr
from dnrtrain.model import render_views
from dnrtrain.perceptual import PerceptualLoss, random_weights
from dnrtrain.settings import LossWeights, ModelSettings, Step1Settings, Step2Settings
from dnrtrain.step1 import run_step1
from dnrtrain.step2 import run_step2

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
MODEL = ModelSettings(texture_size=32, width=8, depth=2)
STEP1 = Step1Settings(epochs=6, precision="float32", reward_scale="raw", q_target="plain")
STEP2 = Step2Settings(epochs=20, precision="float32", loss=LossWeights(perceptual=0))


def test_both_steps_end_where_the_cpus_do(scene: Scene, tmp_path: Path) -> None:
    target = scene.held_out.tensors.target
    assert target is not None
    found = {}
    for device in ("cpu", "cuda"):
        steps = tmp_path / device
        common = {"seed": 0, "device": device, "fingerprint": "f"}
        events = list(
            run_step1(
                scene.raster, None, MODEL, STEP1, policy="rl-paper", budget=4, checkpoints=steps / "step1", **common
            )
        )  # fmt: skip
        assert isinstance(events[-1], Selected) and len(set(events[-1].selection.views)) == 4
        list(
            run_step2(
                scene.traced, None, steps / "step1", MODEL, STEP2, checkpoints=steps / "step2", weights=None, **common
            )
        )  # fmt: skip
        pictures = render_views(load_model(steps / "step2", device), scene.held_out)
        found[device] = float(psnr(pictures, target).mean())
    print(found)
    assert min(found.values()) > 18 and abs(found["cpu"] - found["cuda"]) < 1.0


def test_an_interrupted_training_goes_on_there(scene: Scene, tmp_path: Path) -> None:
    settings = STEP1.model_copy(update={"epochs": 4})

    def run() -> list[int]:
        events = run_step1(
            scene.raster, None, MODEL, settings, policy="rl-paper", budget=4, seed=0, device="cuda",
            checkpoints=tmp_path, fingerprint="f",
        )  # fmt: skip
        seen = []
        for event in events:
            if isinstance(event, EpochEnd):
                seen.append(event.epoch)
                if seen == [1, 2]:
                    break
        return seen

    assert run() == [1, 2]
    assert run() == [3, 4]


def test_the_perceptual_loss_is_the_cpus() -> None:
    network = PerceptualLoss(random_weights("vgg"), Step2Settings().perceptual_weights)
    a, b = torch.rand(2, 1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    here = float(network(a, b))
    assert float(network.cuda()(a.cuda(), b.cuda())) == pytest.approx(here, rel=1e-3)


@pytest.mark.parametrize("augment", [False, True])
def test_graphs_train_what_the_networks_do(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, augment: bool
) -> None:
    """Also of pictures that are turned, and so of two shapes."""
    most, recorded, record = graphs.MOST_PIXELS, [], torch.cuda.make_graphed_callables
    monkeypatch.setattr(
        torch.cuda, "make_graphed_callables", lambda *given, **named: recorded.append(given) or record(*given, **named)
    )
    traced = dataclasses.replace(
        scene.traced, tensors=scene.traced.tensors._map(lambda maps: maps[..., :24, :].contiguous())
    )
    weights = {"vgg": random_weights("vgg")}
    settings = Step2Settings(epochs=3, precision="float32", augment=augment, frequency_norm="ortho")
    losses: dict[int, list[float]] = {}
    for pixels in (0, most):
        monkeypatch.setattr(graphs, "MOST_PIXELS", pixels)
        steps = tmp_path / str(pixels)
        common = {"seed": 0, "device": "cuda", "fingerprint": "f"}
        first = run_step1(
            scene.raster, None, MODEL, STEP1, policy="farthest", budget=4, checkpoints=steps / "step1", **common
        )
        events = list(first)
        second = run_step2(
            traced, None, steps / "step1", MODEL, settings, checkpoints=steps / "step2", weights=weights, **common
        )
        events += list(second)
        # Of step 1 one; of step 2 the renderer's and the losses'.
        assert len(recorded) == (0 if pixels == 0 else 1 + 2 * (1 + augment))
        losses[pixels] = [value for event in events if isinstance(event, EpochEnd) for value in event.losses.values()]
    # Rounding, by Adam made larger: 2.6 % in one of 27.
    assert len(losses[0]) > 9 and losses[most] == pytest.approx(losses[0], rel=0.05)
