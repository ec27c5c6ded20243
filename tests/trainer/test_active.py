"""Policies that train on the views chosen so far: what they look for, and what all policies promise."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
import pytest
import synthetic
import torch
from torch import Tensor

from conftest import Scene
from dnrtrain.checkpoint import load_model, read_record
from dnrtrain.contract import View
from dnrtrain.dataset import ViewSet, load_views
from dnrtrain.events import EpochEnd, Event, Selected
from dnrtrain.model import DNR, Output, render_views
from dnrtrain.selector.active import active_epochs, active_steps, choose_actively, sizes
from dnrtrain.selector.ensemble import Disagreement, Spread
from dnrtrain.selector.names import ACTIVE_NAMES
from dnrtrain.selector.pieces import COUNT, Pieces, cells_of, pieces_of, seen_cells
from dnrtrain.selector.protocol import Candidates, Choice
from dnrtrain.selector.sightings import look_at, sightings_of
from dnrtrain.selector.variance import UNKNOWN, PredictedVariance, Reduction, features_of, train_head
from dnrtrain.settings import ActiveSettings, ModelSettings, Step1Settings
from dnrtrain.step1 import MEMBERS, run_step1

MODEL = ModelSettings(texture_size=16, width=4, depth=1, aggregator="residual")
STEP1 = Step1Settings(epochs=2, precision="float32")
SHORT = ActiveSettings(members=2, rounds=2, epochs=2)


def start(
    views: ViewSet, folder: Path, policy: str, *, budget: int = 4, seed: int = 0, coarse: bool = False
) -> Iterator[Event]:
    return run_step1(
        views, None, views.camera_positions, MODEL, STEP1, policy=policy, budget=budget, seed=seed, device="cpu",
        checkpoints=folder, fingerprint="f", active=SHORT, coarse=coarse,
    )  # fmt: skip


def chosen(events: Iterator[Event]) -> Selected:
    *_, last = events
    assert isinstance(last, Selected)
    return last


def untrained(views: list[int], batch: int, member: int) -> Generator[Event, None, DNR]:
    """In place of training: a renderer of new weights, the same for one member whatever the views."""
    yield from ()
    return DNR(MODEL, 10 * batch + member).eval()


def chosen_from(views: ViewSet, policy: str, budget: int, settings: ActiveSettings = SHORT) -> Choice:
    candidates = Candidates(views.camera_positions, views.camera_directions)
    running = choose_actively(policy, views, candidates, budget, 0, settings, untrained)
    with pytest.raises(StopIteration) as end:
        next(running)
    return end.value.value


def load(folder: Path, views: list[View]) -> ViewSet:
    files, _ = synthetic.write_scene(folder, views)
    return load_views(files, None, synthetic.FRAME, cameras=views, folder=folder)


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
    assert active_epochs("ensemble", SHORT, 25) == 2 * 2 * 2 and active_epochs("variance", SHORT, 25) == 2 * 2
    assert active_steps("ensemble", SHORT, 25) == (9 + 17) * 2 * 2 and active_steps("variance", SHORT, 1) == 0


@pytest.mark.parametrize("policy", ACTIVE_NAMES)
def test_selection_and_books(scene: Scene, tmp_path: Path, policy: str) -> None:
    """Without training on all candidates: only the policy's own models, whose epochs are all booked."""
    events = list(start(scene.raster, tmp_path / "step1", policy))
    epochs = [event for event in events if isinstance(event, EpochEnd)]
    count = active_epochs(policy, SHORT, 4)
    assert [(e.epoch, e.epochs) for e in epochs] == [(n, count) for n in range(1, count + 1)]
    assert sum(e.steps for e in epochs) == active_steps(policy, SHORT, 4)
    last = events[-1]
    assert isinstance(last, Selected) and last.policy == policy
    assert len(set(last.views)) == len(last.gains) == len(last.why) == 4
    assert last.gains[:2] == [0.0, 0.0] and min(last.gains[2:]) > 0 and last.seconds > 0
    assert last.details["start"] == 2 and [b["trained_on"] for b in last.details["batches"]] == [2, 3]
    assert last.why[0].startswith("k-medoids") and last.why[3].startswith("batch 2:")
    assert 0 <= last.details["uncovered"] < 0.5 and "measure" in last.details
    record = read_record(tmp_path / "step1")
    assert record is not None and record["selected"] == last.views
    assert [entry["epoch"] for entry in record["history"]] == list(range(1, count + 1))
    assert record["choosing"] == {"seconds": last.seconds, "cpu_seconds": last.cpu_seconds}
    assert sorted(path.name for path in (tmp_path / "step1").iterdir()) == ["model.json", "model.safetensors"]
    assert list(start(scene.raster, tmp_path / "step1", policy)) == [last]  # a finished step answers at once


def test_where_step_2_starts_from_it_the_coarse_model_is_trained(scene: Scene, tmp_path: Path) -> None:
    """The same views; the saved model is then that of any policy without an agent."""
    with_it = list(start(scene.raster, tmp_path / "a", "variance", coarse=True))
    without = chosen(start(scene.raster, tmp_path / "b", "variance"))
    assert chosen(iter(with_it)) == without
    assert len(with_it) == STEP1.epochs + active_epochs("variance", SHORT, 4) + 1
    chosen(start(scene.raster, tmp_path / "c", "random"))
    weights = [load_model(tmp_path / name).state_dict() for name in "abc"]
    assert all(torch.equal(weights[0][name], weights[2][name]) for name in weights[0])
    assert not all(torch.equal(weights[1][name], weights[2][name]) for name in weights[1])


@pytest.mark.parametrize("policy", ACTIVE_NAMES)
def test_an_interrupted_run_goes_on(scene: Scene, tmp_path: Path, policy: str) -> None:
    """Stopped within its second model: the same choice and history, and no epoch is trained twice."""
    whole = chosen(start(scene.raster, tmp_path / "whole", policy))
    stopped = start(scene.raster, tmp_path / "stopped", policy)
    done = [next(stopped) for _ in range(3)]
    assert all(isinstance(event, EpochEnd) for event in done)
    stopped.close()  # type: ignore[attr-defined]
    assert (tmp_path / "stopped" / MEMBERS).is_dir()
    rest = list(start(scene.raster, tmp_path / "stopped", policy))
    assert rest[-1] == whole
    trained = [event.epoch for event in rest if isinstance(event, EpochEnd)]
    assert trained == list(range(4, active_epochs(policy, SHORT, 4) + 1))
    records = [read_record(tmp_path / name) for name in ("whole", "stopped")]
    losses = [[(e["epoch"], e["losses"]) for e in record["history"]] for record in records if record]
    assert losses[0] == losses[1]


@pytest.mark.parametrize("policy", ACTIVE_NAMES)
def test_order_does_not_matter_and_the_seed_decides(pool: ViewSet, tmp_path: Path, policy: str) -> None:
    order = [int(i) for i in np.random.default_rng(3).permutation(len(pool))]
    straight = chosen(start(pool, tmp_path / "a", policy, budget=5))
    shuffled = chosen(start(pool.subset(order), tmp_path / "b", policy, budget=5))
    twins = {"c0": pool.names[0], "c5": pool.names[5]}
    assert [twins.get(n, n) for n in shuffled.views] == [twins.get(n, n) for n in straight.views]
    assert shuffled.gains == straight.gains
    other = chosen(start(pool, tmp_path / "c", policy, budget=5, seed=1))
    assert other.gains != straight.gains and other.gains[:2] == straight.gains[:2]


@pytest.mark.parametrize("policy", ACTIVE_NAMES)
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


@pytest.mark.parametrize("policy", ACTIVE_NAMES)
def test_a_pool_that_sees_nothing(pool: ViewSet, tmp_path: Path, policy: str) -> None:
    """The models train on empty pictures, then; the choice is any."""
    empty = pool.subset([10, 11])
    assert sorted(chosen(start(empty, tmp_path, policy, budget=2)).views) == sorted(empty.names)


# -- what is unsure ----------------------------------------------------------------------------------------


def test_pieces_are_the_sightings_cells_by_direction(scene: Scene) -> None:
    views = scene.raster.subset([0, 1])
    view = synthetic.dome(10, 32)[1]
    seen = look_at(synthetic.gbuffer(view), view)
    count = int(views.mask[1].sum())
    found = pieces_of(views, 1, np.full(count, 2.0))
    assert found.pixels.sum() == pytest.approx(seen.seen) and found.unsure == pytest.approx(2 * found.pixels)
    assert np.unique(found.keys // 32).tolist() == np.unique(cells_of(views, 1)).tolist()
    table = sightings_of(views)
    assert table.cells[table.of(1)].tolist() == seen.cells.tolist() == np.unique(cells_of(views, 1)).tolist()
    assert np.allclose(table.pixels[table.of(1)], seen.pixels)
    assert np.allclose(table.toward[table.of(1)], seen.toward, atol=1e-5)
    assert seen_cells(views, [1]).sum() == len(seen.cells) and not seen_cells(views, []).any()


class Painted(torch.nn.Module):
    """A renderer of one colour."""

    def __init__(self, colour: float) -> None:
        super().__init__()
        self.colour = colour

    def forward(self, batch):  # type: ignore[no-untyped-def]
        return Output(torch.full_like(batch.normal, self.colour), torch.zeros_like(batch.normal))


def test_disagreement_is_the_variance_and_unseen_surface_counts_as_one(scene: Scene) -> None:
    members: list = [Painted(value) for value in (0.2, 0.4, 0.9)]
    doubt = Disagreement(members, scene.raster, [0], 0)
    assert doubt.unsure(0) == pytest.approx(np.var([0.2, 0.4, 0.9]), rel=1e-5)
    other = doubt.unsure(5)
    new = ~seen_cells(scene.raster, [0])[cells_of(scene.raster, 5)]
    assert new.any() and not new.all()
    assert other == pytest.approx(np.var([0.2, 0.4, 0.9]) + new, rel=1e-5)
    facts = doubt.facts()
    assert facts["disagreement"] == pytest.approx(np.std([0.2, 0.4, 0.9]), rel=1e-5)
    assert facts["unseen"] == pytest.approx(new.sum() / (len(new) + int(scene.raster.mask[0].sum())))


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


def test_the_head_learns_where_the_renderer_errs(scene: Scene) -> None:
    """Targets off by noise of 0.2 on the sphere and 0.02 on the disk: both are found, on a view not trained on."""
    dnr = DNR(MODEL, 0).eval()
    with torch.no_grad():  # texels that tell the halves of the atlas apart, as trained ones do
        for level in dnr.aggregator.texture_uv.levels:
            level[:, 0] = torch.where(torch.arange(level.shape[-1]) < level.shape[-1] // 2, -0.1, 0.1)
    generator = torch.Generator().manual_seed(0)
    sphere = (scene.raster.uv[:, :1] < 0).float() * scene.raster.mask
    deviation = 0.02 + 0.18 * sphere
    colours = render_views(dnr, scene.raster)
    noisy = colours + deviation * torch.randn(colours.shape, generator=generator)
    views = dataclasses.replace(scene.raster, tensors=dataclasses.replace(scene.raster.tensors, target=noisy))
    head = train_head(dnr, views.subset(list(range(1, 10))), 0)
    with torch.no_grad():
        found = head(features_of(dnr, views.batch([0]))[0]).exp().sqrt()
    ball = sphere[0, 0][scene.raster.mask[0, 0] > 0] > 0
    assert float(found[ball].median()) == pytest.approx(0.2, rel=0.25)
    assert float(found[~ball].median()) == pytest.approx(0.02, rel=0.25)


def test_unseen_surface_has_the_variance_of_ignorance(scene: Scene) -> None:
    doubt = PredictedVariance([DNR(MODEL, 0).eval()], scene.raster, [0], 0)
    new = ~seen_cells(scene.raster, [0])[cells_of(scene.raster, 5)]
    found = doubt.unsure(5)
    assert np.all(found[new] == UNKNOWN) and np.all(found[~new] != UNKNOWN)
    assert torch.get_rng_state().equal(_after_nothing(lambda: train_head(DNR(MODEL, 0), scene.raster, 1)))


def _after_nothing(work) -> Tensor:  # type: ignore[no-untyped-def]
    work()
    return torch.get_rng_state()
