"""Pictures of a view while step 2 trains: they change nothing, come when due, and show the averaged weights."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from conftest import Scene
from dnrtrain import preview as preview_module
from dnrtrain.checkpoint import load_model
from dnrtrain.dataset import ViewSet
from dnrtrain.events import EpochEnd, Event, Previewed
from dnrtrain.metrics import psnr
from dnrtrain.model import DNR, render_views
from dnrtrain.preview import Preview
from dnrtrain.settings import LossWeights, ModelSettings, Step2Settings
from dnrtrain.step2 import run_step2

MODEL = ModelSettings(texture_size=16, width=4, depth=1, aggregator="residual")
SETTINGS = Step2Settings(epochs=4, start="fresh", ema=0.9, patch=16, loss=LossWeights(perceptual=0))


def train(scene: Scene, folder: Path, shown: Preview | None) -> Iterator[Event]:
    return run_step2(
        scene.traced.subset([0, 1, 2]), None, folder / "step1", MODEL, SETTINGS, seed=3, device="cpu",
        checkpoints=folder / "step2", fingerprint="f", weights=None, preview=shown,
    )  # fmt: skip


def unseen(scene: Scene, *, target: bool) -> ViewSet:
    views = scene.held_out.subset([1])
    return views if target else dataclasses.replace(views, tensors=dataclasses.replace(views.tensors, target=None))


def always(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Preview:
    """A picture after every epoch."""
    monkeypatch.setattr(preview_module, "SHARE", 1e9)
    return Preview(unseen(scene, target=True), 1e-9)


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_model(folder / "step2", "cpu").state_dict()


def test_the_same_weights_with_and_without(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit; losses, too. And nobody's random numbers are touched."""
    plain = [e for e in train(scene, tmp_path / "plain", None) if isinstance(e, EpochEnd)]
    torch.manual_seed(5), np.random.seed(5), random.seed(5)
    before = torch.get_rng_state(), np.random.get_state()[1].tolist(), random.getstate()
    shown = list(train(scene, tmp_path / "shown", always(scene, monkeypatch)))
    after = torch.get_rng_state(), np.random.get_state()[1].tolist(), random.getstate()
    assert torch.equal(before[0], after[0]) and before[1:] == after[1:]
    assert [type(e) for e in shown] == [EpochEnd, Previewed] * 4
    assert [e.losses for e in shown if isinstance(e, EpochEnd)] == [e.losses for e in plain]
    expected, found = weights(tmp_path / "plain"), weights(tmp_path / "shown")
    assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_an_interrupted_run_goes_on(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped at a picture; the rest shows at once where it stands, and ends where an unbroken run without any does."""
    list(train(scene, tmp_path / "plain", None))
    shown = always(scene, monkeypatch)
    events = train(scene, tmp_path / "cut", shown)
    while not (isinstance(event := next(events), Previewed) and event.epoch == 2):
        pass
    events.close()  # type: ignore[attr-defined]
    rest = list(train(scene, tmp_path / "cut", shown))
    assert [e.epoch for e in rest if isinstance(e, Previewed)] == [3, 4]
    expected, found = weights(tmp_path / "plain"), weights(tmp_path / "cut")
    assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_it_shows_what_the_model_would_be(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last picture is the saved model's, averaged weights and all; its PSNR is that of the whole view."""
    last = list(train(scene, tmp_path, always(scene, monkeypatch)))[-1]
    assert isinstance(last, Previewed) and (last.epoch, last.epochs, last.view) == (4, 4, scene.held_out.names[1])
    views = unseen(scene, target=True)
    rendered = render_views(load_model(tmp_path / "step2", "cpu"), views)
    np.testing.assert_array_equal(last.image, rendered[0].permute(1, 2, 0).numpy())
    assert views.tensors.target is not None and last.psnr == pytest.approx(float(psnr(rendered, views.tensors.target)))
    assert last.image.dtype == np.float32 and 0 <= last.image.min() < last.image.max() <= 1
    alone = list(train(scene, tmp_path / "alone", Preview(unseen(scene, target=False), 1e9)))
    assert [e.psnr for e in alone if isinstance(e, Previewed)] == [None, None]


def test_when_a_picture_is_due(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """First and last epoch; between them every so many seconds of training, and never more than a share of it."""
    clock = 0.0
    monkeypatch.setattr(preview_module.time, "monotonic", lambda: clock)
    model = DNR(MODEL, 0).train()

    def pictures(pause: float, cost: float) -> list[int]:
        nonlocal clock
        preview = Preview(unseen(scene, target=False), pause)
        found = []
        for number in range(1, 101):
            done = EpochEnd(stage="step2", epoch=number, epochs=100, seconds=1.0)
            for event in preview.after(done, model, None):
                found.append(event.epoch)
                clock += cost  # rendering and whoever writes the picture
        return found

    assert pictures(10.0, 0.01) == [1, *range(11, 100, 10), 100]
    assert pictures(1e9, 0.01) == [1, 100]
    costly = pictures(10.0, 0.75)  # 3 % of 25 seconds
    assert costly == [1, 26, 51, 76, 100]
    assert model.training  # as it was


@pytest.mark.parametrize(("count", "seconds", "message"), [(2, 1.0, "one view"), (1, 0.0, "above 0")])
def test_nonsense_is_refused(scene: Scene, count: int, seconds: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Preview(scene.held_out.subset(range(count)), seconds)
