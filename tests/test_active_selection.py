"""Policies that train on the views chosen so far: what they look for, and what all policies promise."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from dnrpipe.core.settings import resolve
from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.studies.selectbench.active import active_worker
from dnrpipe.studies.selectbench.active.active_worker import Members
from dnrpipe.studies.selectbench.active.batches import KINDS, choose_actively, sizes
from dnrpipe.studies.selectbench.active.ensemble import Disagreement, Spread
from dnrpipe.studies.selectbench.active.pieces import COUNT, Pieces, cells_of, pieces_of, seen_cells
from dnrpipe.studies.selectbench.active.variance import UNKNOWN, PredictedVariance, Reduction, features_of, train_head
from dnrpipe.studies.selectbench.policies import ActiveSettings
from dnrtrain.checkpoint import read_record
from dnrtrain.contract import View, write_cameras
from dnrtrain.dataset import ViewSet, load_views
from dnrtrain.events import EpochEnd, Event
from dnrtrain.model import DNR, Output, render_views
from dnrtrain.records import ModelRecord
from dnrtrain.selector.protocol import Choice
from dnrtrain.selector.visibility import look_at, visibility_of
from dnrtrain.settings import ModelSettings, Step1Settings
from dnrtrain.step1 import run_step1

sys.path.insert(0, str(Path(__file__).parent / "trainer"))

import synthetic

MODEL = ModelSettings(texture_size=16, width=4, depth=1, aggregator="residual")
STEP1 = Step1Settings(epochs=2, precision="float32")
SHORT = ActiveSettings(members=2, rounds=2, epochs=2)


def start(views: ViewSet, folder: Path, seed: int = 0) -> Members:
    return Members(views, MODEL, STEP1, SHORT, seed, "cpu", folder, "f")


def untrained(views: list[int], batch: int, member: int) -> DNR:
    """In place of training: a renderer of new weights, the same for one member whatever the views."""
    return DNR(MODEL, 10 * batch + member).eval()


def chosen_from(views: ViewSet, policy: str, budget: int, settings: ActiveSettings = SHORT) -> Choice:
    return choose_actively(policy, views, budget, 0, settings, untrained)


def load(folder: Path, views: list[View]) -> ViewSet:
    files, _ = synthetic.write_scene(folder, views)
    return load_views(files, None, synthetic.FRAME, cameras=views, folder=folder)


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def raster(tmp_path_factory: pytest.TempPathFactory) -> ViewSet:
    """10 views on a dome."""
    return load(tmp_path_factory.mktemp("scene"), synthetic.dome(10, 32))


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> ViewSet:
    """8 views on a dome; 8 and 9 repeat 0 and 5; 10 and 11 look away."""
    dome = synthetic.dome(8, 24)
    copies = [dome[0].model_copy(update={"name": "c0"}), dome[5].model_copy(update={"name": "c5"})]
    away = []
    for view in dome[1:3]:
        matrix = view.matrix.copy()
        matrix[:3, [0, 2]] *= -1.0
        turned = tuple(tuple(float(v) for v in row) for row in matrix)
        away.append(view.model_copy(update={"name": f"away{view.name}", "c2w": turned}))
    return load(tmp_path_factory.mktemp("pool"), [*dome, *copies, *away])


# -- the whole policy --------------------------------------------------------------------------------------


def test_batches() -> None:
    assert (
        sizes(25, 2) == [9, 17, 25] and sizes(10, 3) == [4, 6, 8, 10] and sizes(2, 5) == [1, 2] and sizes(1, 2) == [1]
    )


@pytest.mark.parametrize(("policy", "models"), [("ensemble", 4), ("variance", 2)])
def test_selection_and_books(raster: ViewSet, tmp_path: Path, policy: str, models: int) -> None:
    """The policy's own models, and the choosing beside them, are all that it costs."""
    members = start(raster, tmp_path)
    choice, cost = members.choose(policy, 4)
    assert len(set(choice.views)) == len(choice.gains) == len(choice.why) == 4
    assert choice.gains[:2] == [0.0, 0.0] and min(choice.gains[2:]) > 0
    assert choice.details["start"] == 2 and [b["trained_on"] for b in choice.details["batches"]] == [2, 3]
    assert choice.why[0].startswith("k-medoids") and choice.why[3].startswith("batch 2:")
    assert 0 <= choice.details["uncovered"] < 0.5 and "measure" in choice.details
    epochs = [epoch for folder in members.folders for epoch in record_of(folder).history]
    assert len(members.folders) == models and len(epochs) == models * SHORT.epochs
    assert sum(epoch.steps for epoch in epochs) == (2 + 3) * models // 2 * SHORT.epochs
    for name in ("seconds", "cpu_seconds"):
        assert cost[name] > sum(getattr(epoch, name) for epoch in epochs) > 0
    again, less = start(raster, tmp_path).choose(policy, 4)  # finished models answer at once
    assert again == choice and less["seconds"] > sum(epoch.seconds for epoch in epochs)


def record_of(folder: Path) -> ModelRecord:
    record = read_record(folder)
    assert record is not None
    return record


@pytest.mark.parametrize("policy", KINDS)
def test_an_interrupted_run_goes_on(
    raster: ViewSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, policy: str
) -> None:
    """Stopped within its second model: the same choice and history, and no epoch is trained twice."""
    whole = start(raster, tmp_path / "whole")
    expected, _ = whole.choose(policy, 4)
    trained: list[int] = []

    def stop_after(count: int) -> None:
        def run(*args: Any, **options: Any) -> Iterator[Event]:
            for event in run_step1(*args, **options):
                yield event
                if isinstance(event, EpochEnd):
                    trained.append(event.epoch)
                    if len(trained) == count:
                        raise KeyboardInterrupt

        monkeypatch.setattr(active_worker, "run_step1", run)

    stop_after(3)
    with pytest.raises(KeyboardInterrupt):
        start(raster, tmp_path / "stopped").choose(policy, 4)
    assert trained == [1, 2, 1]
    stop_after(0)
    members = start(raster, tmp_path / "stopped")
    found, _ = members.choose(policy, 4)
    assert found == expected
    assert len(trained) == len(members.folders) * SHORT.epochs
    for mine, theirs in zip(members.folders, whole.folders, strict=True):
        assert [e.losses for e in record_of(mine).history] == [e.losses for e in record_of(theirs).history]


@pytest.mark.parametrize("policy", KINDS)
def test_order_does_not_matter_and_the_seed_decides(pool: ViewSet, tmp_path: Path, policy: str) -> None:
    order = [int(i) for i in np.random.default_rng(3).permutation(len(pool))]
    straight, _ = start(pool, tmp_path / "a").choose(policy, 5)
    shuffled, _ = start(pool.subset(order), tmp_path / "b").choose(policy, 5)
    twins = {8: 0, 9: 5}
    assert [twins.get(order[v], order[v]) for v in shuffled.views] == [twins.get(v, v) for v in straight.views]
    assert shuffled.gains == straight.gains
    other, _ = start(pool, tmp_path / "c", seed=1).choose(policy, 5)
    assert other.gains != straight.gains and other.gains[:2] == straight.gains[:2]


@pytest.mark.parametrize("policy", KINDS)
def test_duplicates_and_empty_views_come_last(pool: ViewSet, policy: str) -> None:
    twins = {8: 0, 9: 5}
    for budget in (1, 3, 9, 12):
        choice = chosen_from(pool, policy, budget)
        assert len(set(choice.views)) == len(choice.views) == len(choice.why) == len(choice.gains) == budget
        assert len({twins.get(view, view) for view in choice.views[:8]}) == min(budget, 8)
        assert not {10, 11} & set(choice.views[:10])
        assert np.isfinite(choice.gains).all() and min(choice.gains) >= 0
    assert choice.details["duplicates"] == 2 and choice.details["see_nothing"] == 2
    assert "a duplicate: all else was chosen" in choice.why[8] and "sees nothing" in choice.why[11]


@pytest.mark.parametrize("policy", KINDS)
def test_a_pool_that_sees_nothing(pool: ViewSet, tmp_path: Path, policy: str) -> None:
    """The models train on empty pictures, then; the choice is any."""
    empty = pool.subset([10, 11])
    choice, _ = start(empty, tmp_path).choose(policy, 2)
    assert sorted(choice.views) == [0, 1]


@pytest.mark.slow
def test_the_worker_writes_a_selection(tmp_path: Path) -> None:
    """What `dnrpipe bench-select` asks for: a file of the names chosen and the cost; the models are gone."""
    workspace = Workspace.create(tmp_path / "scene.dnr", Source(path=str(tmp_path / "scene.blend"), sha256="0"))
    views = synthetic.dome(6, 24)
    files, _ = synthetic.write_scene(tmp_path / "made", views)
    for view, file in zip(views, files, strict=True):
        target = workspace.passes("train", view.name)
        target.parent.mkdir(parents=True, exist_ok=True)
        file.rename(target)
    for split in ("train", "val", "test"):
        write_cameras(workspace.cameras(split), views if split == "train" else [], split)
    workspace.scene.mkdir(parents=True, exist_ok=True)
    (workspace.scene / "frame.json").write_text(synthetic.FRAME.model_dump_json())
    small = {"texture_size": 16, "width": 4, "depth": 1}
    changes = {"model": small, "select": {"budget": 3}, "finetune": {"step2": {"start": "fresh"}}}
    settings = resolve(None, changes, environment={})
    task = {
        "fingerprint": "k", "workspace": str(workspace.root), "settings": settings.model_dump(mode="json"), "seed": 0,
        "policy": "variance", "folder": str(tmp_path / "models"), "output": str(tmp_path / "k.json"), "label": "k",
    }  # fmt: skip
    made = active_worker.Worker({"threads": 1, "device": "cpu"})(task)
    assert json.loads((tmp_path / "k.json").read_text()) == made
    assert len(set(made["views"])) == 3 and set(made["views"]) <= {view.name for view in views}
    assert made["key"] == "k" and made["seconds"] > 0 and made["cpu_seconds"] > 0
    assert not (tmp_path / "models").exists()


# -- what is unsure ----------------------------------------------------------------------------------------


def test_pieces_are_the_visible_cells_by_direction(raster: ViewSet) -> None:
    views = raster.subset([0, 1])
    view = synthetic.dome(10, 32)[1]
    seen = look_at(synthetic.gbuffer(view), view)
    count = int(views.tensors.mask[1].sum())
    found = pieces_of(views, 1, np.full(count, 2.0))
    assert found.pixels.sum() == pytest.approx(seen.seen[0]) and found.unsure == pytest.approx(2 * found.pixels)
    assert np.unique(found.keys // 32).tolist() == np.unique(cells_of(views, 1)).tolist()
    table = visibility_of(views)
    assert table.cells[table.of(1)].tolist() == seen.cells.tolist() == np.unique(cells_of(views, 1)).tolist()
    assert np.allclose(table.pixels[table.of(1)], seen.pixels)
    assert np.allclose(table.view_directions[table.of(1)], seen.view_directions, atol=1e-5)
    assert seen_cells(views, [1]).sum() == len(seen.cells) and not seen_cells(views, []).any()


class Painted(torch.nn.Module):
    """A renderer of one colour."""

    def __init__(self, colour: float) -> None:
        super().__init__()
        self.colour = colour

    def forward(self, batch):  # type: ignore[no-untyped-def]
        return Output(torch.full_like(batch.normal, self.colour), torch.zeros_like(batch.normal))


def test_disagreement_is_the_variance_and_unseen_surface_counts_as_one(raster: ViewSet) -> None:
    members: list = [Painted(value) for value in (0.2, 0.4, 0.9)]
    doubt = Disagreement(members, raster, [0], 0)
    assert doubt.unsure(0) == pytest.approx(np.var([0.2, 0.4, 0.9]), rel=1e-5)
    other = doubt.unsure(5)
    new = ~seen_cells(raster, [0])[cells_of(raster, 5)]
    assert new.any() and not new.all()
    assert other == pytest.approx(np.var([0.2, 0.4, 0.9]) + new, rel=1e-5)
    facts = doubt.facts()
    assert facts["disagreement"] == pytest.approx(np.std([0.2, 0.4, 0.9]), rel=1e-5)
    assert facts["unseen"] == pytest.approx(new.sum() / (len(new) + int(raster.tensors.mask[0].sum())))


def piece(keys: list[int], pixels: float, unsure: float) -> Pieces:
    return Pieces(np.array(keys), np.full(len(keys), pixels), np.full(len(keys), unsure))


def test_a_batch_is_not_one_view_many_times() -> None:
    """The most unsure view first; its like is worth half, then; another place is worth what it was."""
    table = [piece([1, 2], 0.1, 0.05), piece([1, 2], 0.1, 0.049), piece([COUNT - 1], 0.1, 0.06)]
    batch = Spread(table)
    assert [batch.gain(one) for one in table] == pytest.approx([0.1, 0.098, 0.06])
    batch.take(table[0])
    assert [batch.gain(one) for one in table[1:]] == pytest.approx([0.049, 0.06])


def test_reduction_is_bayes_rule() -> None:
    """Against precisions added up piece by piece, as a share of all candidates' pixels."""
    random = np.random.default_rng(0)
    keys = [np.unique(random.integers(0, 30, 12)) for _ in range(5)]
    table = [Pieces(k, random.uniform(0.1, 1.0, len(k)), random.uniform(0.0, 1.0, len(k))) for k in keys]
    everything = sum(one.pixels.sum() for one in table)
    prior, seen, usual = np.zeros(30), np.zeros(30), np.ones(30)
    for key in range(30):
        looks = [(one.pixels[one.keys == key], one.unsure[one.keys == key]) for one in table if key in one.keys]
        if looks:
            prior[key] = sum(float(unsure[0]) for _, unsure in looks)
            usual[key] = np.mean([pixels[0] for pixels, _ in looks])

    def posterior() -> float:
        precision = 1.0 / np.maximum(prior, 1e-300) * (1.0 + seen)
        return float((1.0 / precision).sum() / everything)

    batch, gains = Reduction(table), []
    for one in table:
        before, gain = posterior(), batch.gain(one)
        batch.take(one)
        seen[one.keys] += one.pixels / usual[one.keys]
        assert gain == pytest.approx(before - posterior())
        gains.append(batch.gain(one))
        assert gains[-1] < gain


def test_the_head_learns_where_the_renderer_errs(raster: ViewSet) -> None:
    """Targets off by noise of 0.2 on the sphere and 0.02 on the disk: both are found, on a view not trained on."""
    dnr = DNR(MODEL, 0).eval()
    with torch.no_grad():  # texels that tell the halves of the atlas apart, as trained ones do
        for level in dnr.aggregator.texture_uv.levels:
            level[:, 0] = torch.where(torch.arange(level.shape[-1]) < level.shape[-1] // 2, -0.1, 0.1)
    generator = torch.Generator().manual_seed(0)
    sphere = (raster.tensors.uv[:, :1] < 0).float() * raster.tensors.mask
    deviation = 0.02 + 0.18 * sphere
    colours = render_views(dnr, raster)
    noisy = colours + deviation * torch.randn(colours.shape, generator=generator)
    views = dataclasses.replace(raster, tensors=dataclasses.replace(raster.tensors, target=noisy))
    head = train_head(dnr, views.subset(list(range(1, 10))), 0)
    with torch.no_grad():
        found = head(features_of(dnr, views.batch([0]))[0]).exp().sqrt()
    ball = sphere[0, 0][raster.tensors.mask[0, 0] > 0] > 0
    assert float(found[ball].median()) == pytest.approx(0.2, rel=0.25)
    assert float(found[~ball].median()) == pytest.approx(0.02, rel=0.25)


def test_unseen_surface_has_the_variance_of_ignorance(raster: ViewSet) -> None:
    doubt = PredictedVariance([DNR(MODEL, 0).eval()], raster, [0], 0)
    new = ~seen_cells(raster, [0])[cells_of(raster, 5)]
    found = doubt.unsure(5)
    assert np.all(found[new] == UNKNOWN) and np.all(found[~new] != UNKNOWN)
    assert torch.get_rng_state().equal(_after_nothing(lambda: train_head(DNR(MODEL, 0), raster, 1)))


def _after_nothing(work) -> Tensor:  # type: ignore[no-untyped-def]
    work()
    return torch.get_rng_state()
