"""Steps 1 and 2: they learn, resume bit for bit after SIGKILL, refuse nonsense and survive bad numbers."""

from __future__ import annotations

import dataclasses
import json
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Generator
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import run_steps
import synthetic
import torch

from conftest import Scene, make_scene
from dnrtrain.checkpoint import load_model, read_record
from dnrtrain.contract import ContractError
from dnrtrain.dataset import ViewSet, load_views
from dnrtrain.events import EpochEnd, Event, Note, Selected
from dnrtrain.losses import Step2Loss
from dnrtrain.metrics import psnr
from dnrtrain.model import DNR, render_views
from dnrtrain.precision import decide_bfloat16
from dnrtrain.schedule import Averaged, adam, guarded_step, learning_rate
from dnrtrain.selector.agent import Reward
from dnrtrain.settings import LossWeights, ModelSettings, Step1Settings, Step2Settings
from dnrtrain.step1 import run_step1
from dnrtrain.step2 import _Step2, random_patch, run_step2

MODEL = ModelSettings(texture_size=16, width=4, depth=1, aggregator="residual")
QUICK1 = Step1Settings(epochs=2, embedding=8, precision="float32")
QUICK2 = Step2Settings(epochs=2, loss=LossWeights(perceptual=0))


def step1(
    views: ViewSet, folder: Path, *, policy: str = "rl-paper", budget: int = 4, seed: int = 0,
    settings: Step1Settings = QUICK1, model: ModelSettings = MODEL, fingerprint: str = "f",
    val: ViewSet | None = None,
) -> list[Event]:  # fmt: skip
    return list(
        run_step1(
            views, val, model, settings, policy=policy, budget=budget, seed=seed, device="cpu",
            checkpoints=folder / "step1", fingerprint=fingerprint,
        )
    )  # fmt: skip


def step2(
    views: ViewSet, folder: Path, *, settings: Step2Settings = QUICK2, model: ModelSettings = MODEL,
    val: ViewSet | None = None, weights: dict | None = None, seed: int = 0,
) -> list[Event]:  # fmt: skip
    return list(
        run_step2(
            views, val, folder / "step1", model, settings, seed=seed, device="cpu",
            checkpoints=folder / "step2", fingerprint="f", weights=weights,
        )
    )  # fmt: skip


@pytest.mark.parametrize("policy", ["rl-paper", "random", "kmedoids"])
def test_selection_and_books(scene: Scene, tmp_path: Path, policy: str) -> None:
    events = step1(scene.raster, tmp_path, policy=policy, val=scene.raster.subset([0, 1]))
    epochs = [event for event in events if isinstance(event, EpochEnd)]
    assert [(e.epoch, e.epochs, e.steps, e.skipped) for e in epochs] == [(1, 2, 12, 0), (2, 2, 12, 0)]
    assert epochs[1].val["psnr"] > epochs[0].val["psnr"] > 0
    if policy != "rl-paper":  # the agent visits other views in each epoch
        assert epochs[1].losses["dnr"] < epochs[0].losses["dnr"]
    assert ("rl" in epochs[0].losses) == (policy == "rl-paper")
    last = events[-1]
    assert isinstance(last, Selected) and last.selection.policy == policy
    assert len(set(last.selection.views)) == 4 and set(last.selection.views) <= set(scene.raster.names)
    record = read_record(tmp_path / "step1")
    assert record is not None and record.selected == last.selection.views
    assert [entry.epoch for entry in record.history] == [1, 2]
    assert sorted(path.name for path in (tmp_path / "step1").iterdir()) == ["model.json", "model.safetensors"]
    # A finished step answers at once, and the same.
    assert step1(scene.raster, tmp_path, policy=policy) == [last]


@pytest.mark.parametrize("budget", [1, 3, 10])
@pytest.mark.parametrize("reward", get_args(Reward))
def test_every_budget_and_reward(scene: Scene, tmp_path: Path, budget: int, reward: str) -> None:
    settings = QUICK1.model_copy(update={"epochs": 1, "reward": reward})
    events = step1(scene.raster, tmp_path, budget=budget, settings=settings)
    assert isinstance(events[-1], Selected)
    assert len(set(events[-1].selection.views)) == budget


def test_seeds_decide(scene: Scene, tmp_path: Path) -> None:
    chosen = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        event = step1(scene.raster, tmp_path / name, seed=seed)[-1]
        assert isinstance(event, Selected)
        chosen.append(event.selection.views)
    weights = [(tmp_path / name / "step1" / "model.safetensors").read_bytes() for name in "abc"]
    assert chosen[0] == chosen[1] and weights[0] == weights[1] != weights[2]


def test_nonsense_is_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(ContractError, match="budget 11"):
        step1(scene.raster, tmp_path, budget=11)
    with pytest.raises(ContractError, match="unknown policy"):
        step1(scene.raster, tmp_path, policy="best")
    blind = dataclasses.replace(scene.raster, tensors=dataclasses.replace(scene.raster.tensors, target=None))
    with pytest.raises(ContractError, match="no target"):
        step1(blind, tmp_path)
    with pytest.raises(ContractError, match="no finished model"):
        step2(scene.traced, tmp_path)
    step1(scene.raster, tmp_path, policy="random")
    with pytest.raises(ContractError, match="other model settings"):
        step2(scene.traced, tmp_path, model=MODEL.model_copy(update={"width": 8}))


def test_step2_without_weights_says_so(scene: Scene, tmp_path: Path) -> None:
    step1(scene.raster, tmp_path, policy="random")
    events = step2(scene.traced.subset([0, 1, 2]), tmp_path, settings=Step2Settings(epochs=1, batch=2))
    assert isinstance(events[0], Note) and "L_p" in events[0].text
    record = read_record(tmp_path / "step2")
    assert record is not None and record.perceptual is False
    assert isinstance(events[1], EpochEnd) and events[1].steps == 2
    assert set(events[1].losses) == {
        "total", "photometric", "ssim", "frequency", "total_variation", "regularisation"
    }  # fmt: skip


def test_non_finite_steps_are_skipped_and_counted(scene: Scene, tmp_path: Path) -> None:
    tensors = scene.raster.tensors
    assert tensors.target is not None
    target = tensors.target.clone()
    target[3] = torch.inf
    poisoned = dataclasses.replace(scene.raster, tensors=dataclasses.replace(tensors, target=target))
    for policy in ("random", "rl-paper"):
        events = step1(poisoned, tmp_path / policy, policy=policy, budget=10)
        epochs = [event for event in events if isinstance(event, EpochEnd)]
        assert all(epoch.skipped == 1 and np.isfinite(epoch.losses["dnr"]) for epoch in epochs)
        model = load_model(tmp_path / policy / "step1")
        assert all(torch.isfinite(parameter).all() for parameter in model.parameters())


def test_another_fingerprint_starts_afresh(scene: Scene, tmp_path: Path) -> None:
    first = step1(scene.raster, tmp_path, policy="random")
    again = step1(scene.raster, tmp_path, policy="random", fingerprint="other")
    assert len(again) == len(first) and isinstance(again[0], EpochEnd)


def test_a_damaged_model_is_refused(scene: Scene, tmp_path: Path) -> None:
    step1(scene.raster, tmp_path, policy="random")
    path = tmp_path / "step1" / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ContractError, match="step1"):
        load_model(tmp_path / "step1")


def test_learning_rate_falls_exponentially() -> None:
    rates = [learning_rate(step, 11, 1e-3, 1e-4) for step in range(11)]
    assert rates[0] == 1e-3 and rates[-1] == pytest.approx(1e-4)
    assert np.allclose(np.diff(np.log(rates)), np.log(0.1) / 10)
    assert learning_rate(0, 1, 1e-3, 1e-4) == 1e-3


def test_only_texels_of_the_surface_learn_faster() -> None:
    """Those of the depth and normal textures are met by every view: at the networks' rate."""
    model = DNR(ModelSettings(modalities="uv+depth+normal", texture_size=16, width=8, depth=1, base="none"), seed=0)
    scales = {id(p): group["scale"] for group in adam([model], 1e-3, "cpu", 10.0).param_groups for p in group["params"]}
    fast = {name for name, p in model.named_parameters() if scales[id(p)] == 10.0}
    assert fast and all(name.startswith("aggregator.texture_uv.") for name in fast)
    slow = {name for name in dict(model.named_parameters()) if name not in fast}
    assert any("texture_depth" in name for name in slow) and any("texture_normal" in name for name in slow)
    assert {scales[id(p)] for name, p in model.named_parameters() if name in slow} == {1.0}


def test_precision_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    assert decide_bfloat16("bfloat16", "cpu") and not decide_bfloat16("float32", "cpu")
    for capabilities, expected in (({"avx512_bf16": True}, True), ({"amx_bf16": True}, True), ({"avx2": True}, False)):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda found=capabilities: found)
        assert decide_bfloat16("auto", "cpu") is expected


def _epoch(progress: Path) -> int:
    """Whole epochs on disk, -1 before the first state."""
    return int(json.loads(progress.read_text())["epoch"]) if progress.exists() else -1


@pytest.mark.slow
@pytest.mark.parametrize(
    "moments",
    [
        [("step1", 1), ("step2", 3)],
        pytest.param(
            [("step1", 0), ("step1", 1), ("step1", 4), ("step2", 0), ("step2", 3), ("step2", 9)],
            marks=pytest.mark.robustness,
        ),
    ],
    ids=len,
)
def test_killed_at_any_moment_it_resumes_bit_for_bit(moments: list[tuple[str, int]], tmp_path: Path) -> None:
    """SIGKILL at random moments of both steps; weights and selection equal the undisturbed run's."""
    synthetic.write_scene(tmp_path / "scene", synthetic.dome(run_steps.VIEWS, run_steps.SIDE))
    script = str(Path(run_steps.__file__))

    def command(out: str) -> list[str]:
        return [sys.executable, script, str(tmp_path / "scene"), str(tmp_path / out), "rl-paper"]

    done = subprocess.run(command("whole"), capture_output=True, text=True, check=True)
    dice = random.Random(1)
    kills: set[tuple[str, int]] = set()
    for step, epoch in moments:
        process = subprocess.Popen(command("killed"), stdout=subprocess.PIPE, text=True)
        progress = tmp_path / "killed" / step / "checkpoint.json"
        while process.poll() is None and _epoch(progress) < epoch:
            time.sleep(0.002)
        time.sleep(dice.uniform(0.0, 0.08))
        process.kill()
        process.communicate()
        kills.add((step, _epoch(progress)))
    assert {step for step, epoch in kills if epoch > 0} == {"step1", "step2"}, "the kills came too late"
    again = subprocess.run(command("killed"), capture_output=True, text=True, check=True)
    assert json.loads(again.stdout) == json.loads(done.stdout)
    for step in ("step1", "step2"):
        whole, killed = (tmp_path / out / step / "model.safetensors" for out in ("whole", "killed"))
        assert whole.read_bytes() == killed.read_bytes(), step


@pytest.mark.slow
def test_interruption_after_every_epoch(scene: Scene, tmp_path: Path) -> None:
    """Closing the generator after each epoch and starting again gives the undisturbed run's bytes."""
    settings = QUICK1.model_copy(update={"epochs": 4})
    whole = step1(scene.raster, tmp_path / "whole", settings=settings)
    folder = tmp_path / "pieces"
    events: list[Event] = []
    for _ in range(4):
        run = run_step1(
            scene.raster, None, MODEL, settings, policy="rl-paper", budget=4, seed=0,
            device="cpu", checkpoints=folder / "step1", fingerprint="f",
        )  # fmt: skip
        for event in run:
            if isinstance(event, EpochEnd):
                events.append(event)
                break
        assert isinstance(run, Generator)
        run.close()
    assert [event.epoch for event in events if isinstance(event, EpochEnd)] == [1, 2, 3, 4]
    assert step1(scene.raster, folder, settings=settings)[-1] == whole[-1]
    paths = [tmp_path / name / "step1" / "model.safetensors" for name in ("whole", "pieces")]
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.slow
def test_it_learns_views_it_has_not_seen(tmp_path: Path) -> None:
    """Held-out ray-traced views: far above the mean image, and fine-tuning beats the coarse model."""
    scene = make_scene(tmp_path / "scene", 16, 4, 48)
    model = ModelSettings(texture_size=64, width=12, depth=2, aggregator="residual")
    step1(scene.raster, tmp_path, policy="farthest", budget=8, model=model,
          settings=Step1Settings(epochs=8, precision="float32"))  # fmt: skip
    record = read_record(tmp_path / "step1")
    assert record is not None
    chosen = scene.traced.subset([scene.traced.index(name) for name in record.selected])
    step2(chosen, tmp_path, model=model,
          settings=Step2Settings(epochs=25, photometric="l1", loss=LossWeights(perceptual=0)))  # fmt: skip
    target, seen = scene.held_out.tensors.target, chosen.tensors.target
    assert target is not None and seen is not None
    baseline = float(psnr(seen.mean(0, keepdim=True).expand_as(target), target).mean())
    scores = {
        name: float(psnr(render_views(load_model(tmp_path / name), scene.held_out), target).mean())
        for name in ("step1", "step2")
    }
    shutil.rmtree(tmp_path / "scene")
    print(baseline, scores)
    assert scores["step1"] > baseline  # the raster lacks shadow and highlight
    assert scores["step2"] > scores["step1"] + 3
    assert scores["step2"] > baseline + 4


def best_parts(scene: Scene) -> tuple[ViewSet, ModelSettings, Step2Settings]:
    """Three views with a raster base, and settings with everything that the default preset uses."""
    views = synthetic.dome(10, 32)[:3]
    passes, images = ([scene.folder / kind / f"{v.name}.exr" for v in views] for kind in ("passes", "raytraced"))
    data = load_views(passes, images, synthetic.FRAME, cameras=views, folder=scene.folder, base="raster")
    model = ModelSettings(
        texture_size=16, width=4, depth=1, aggregator="residual", base="raster", guides=True, stride=2
    )  # fmt: skip
    settings = Step2Settings(
        epochs=4, start="fresh", ema=0.9, patch=16, photometric="l1", loss=LossWeights(perceptual=0)
    )  # fmt: skip
    return data, model, settings


def test_averages_and_patches_resume_bit_for_bit(scene: Scene, tmp_path: Path) -> None:
    data, model, settings = best_parts(scene)
    step2(data, tmp_path / "whole", model=model, settings=settings)
    for _ in range(4):
        run = run_step2(
            data, None, tmp_path / "nothing", model, settings, seed=0, device="cpu",
            checkpoints=tmp_path / "pieces" / "step2", fingerprint="f", weights=None,
        )  # fmt: skip
        assert isinstance(next(event for event in run if isinstance(event, EpochEnd)), EpochEnd)
        assert isinstance(run, Generator)
        run.close()
    step2(data, tmp_path / "pieces", model=model, settings=settings)
    whole, pieces = ((tmp_path / name / "step2" / "model.safetensors").read_bytes() for name in ("whole", "pieces"))
    assert whole == pieces


def test_the_averaged_weights_are_the_model(scene: Scene, tmp_path: Path) -> None:
    """By hand: the mean of the weights after each step, weighted by decay^age, is what is saved."""
    data, model, settings = best_parts(scene)
    settings = settings.model_copy(update={"epochs": 1})
    step2(data, tmp_path / "averaged", model=model, settings=settings)
    tracks = []
    for steps in (1, 2, 3):
        loss, folder = Step2Loss(settings, None), tmp_path / f"cut{steps}"
        dnr = DNR(model, 0)
        dnr.use_bfloat16 = decide_bfloat16(settings.precision, "cpu")
        run = _Step2(
            dnr=dnr, views=data, val=None, settings=settings, loss=loss, seed=0, run="run", folder=folder, device="cpu",
            average=Averaged(dnr, settings.ema),
        )  # fmt: skip
        run._restore()
        taken = 0

        def stop_after(*args: object, steps: int = steps) -> bool:
            nonlocal taken
            taken += 1
            return guarded_step(*args) if taken <= steps else False  # type: ignore[arg-type]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("dnrtrain.step2.guarded_step", stop_after)
            patch.setattr("dnrtrain.schedule.Watch.trouble", lambda *_: None)  # steps not taken look like divergence
            run._epoch(0)
        tracks.append({name: p.detach().clone() for name, p in run.dnr.named_parameters()})
    saved = load_model(tmp_path / "averaged" / "step2")
    ages = torch.tensor([0.9**2, 0.9, 1.0])
    for name, value in saved.named_parameters():
        stack = torch.stack([track[name] for track in tracks])
        expected = torch.einsum("t,t...->...", ages / ages.sum(), stack)
        assert torch.allclose(value, expected, atol=1e-6), name
    assert not torch.equal(next(iter(saved.parameters())), next(iter(tracks[-1].values())))


def test_patches_bound_what_a_step_sees(scene: Scene) -> None:
    batch = scene.traced.batch([0])
    corners = set()
    for seed in range(20):
        patch = random_patch(batch, 20, np.random.default_rng(seed))
        assert patch.mask.shape[-2:] == (20, 20) and patch.target is not None
        corners.add(patch.view_dir[..., 0, 0].numpy().tobytes())
    assert len(corners) > 10
    assert random_patch(batch, 0, np.random.default_rng(0)) is batch
    assert random_patch(batch, 32, np.random.default_rng(0)) is batch
    wide = batch._map(lambda tensor: tensor[..., :20, :])
    assert random_patch(wide, 24, np.random.default_rng(0)).mask.shape[-2:] == (20, 24)


def test_a_richer_model_starts_from_the_coarse_one(scene: Scene, tmp_path: Path) -> None:
    """Step 1 trains the coarse part of the same settings; step 2 takes over what fits and says how much."""
    data, model, settings = best_parts(scene)
    step1(scene.raster, tmp_path, policy="random", model=model)
    coarse = load_model(tmp_path / "step1")
    assert coarse.settings == model.coarse() != model
    settings = settings.model_copy(update={"start": "coarse", "epochs": 1, "learning_rate": 1e-12, "ema": 0.0})
    settings = settings.model_copy(update={"learning_rate_end": 1e-12})
    events = step2(data, tmp_path, model=model, settings=settings)
    assert isinstance(events[0], Note | EpochEnd) and any(
        "from step 1" in e.text for e in events if isinstance(e, Note)
    )
    tuned = load_model(tmp_path / "step2")
    texels = [dict(m.named_parameters())["aggregator.texture_uv.levels.0"] for m in (coarse, tuned)]
    assert torch.allclose(texels[0], texels[1], atol=1e-6)
    assert tuned.renderer.head.weight.abs().max() < 1e-6  # still the base image


@pytest.mark.slow
def test_the_q_loss_falls(scene: Scene, tmp_path: Path) -> None:
    settings = Step1Settings(epochs=12, precision="float32", embedding=32)
    events = step1(scene.raster, tmp_path, budget=5, settings=settings)
    losses = [event.losses["rl"] for event in events if isinstance(event, EpochEnd)]
    values = [event.losses["q"] for event in events if isinstance(event, EpochEnd)]
    assert np.mean(losses[-3:]) < 0.5 * np.mean(losses[:3])
    assert np.abs(values).max() < 10  # no divergence
