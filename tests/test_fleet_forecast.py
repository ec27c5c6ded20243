"""The forecast of a fleet: simple cases by hand, bounds on any."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tools.bench_ray import OUT, reckoned

from dnrpipe.core.ledger import CostRecord
from dnrpipe.fleet.forecast import Step, chain_of, makespan

FREE = {"start": 0.0, "per_task": 0.0}


def _record(stage: str, unit: str, name: str, seconds: float) -> CostRecord:
    return CostRecord.model_validate(
        {"time": 0, "run": "r", "stage": stage, "purpose": "training", "unit": unit, "name": name, "seconds": seconds}
    )


def test_a_chain_is_read_from_a_ledger() -> None:
    records = [
        _record("prepare", "scene", "convert", 5),
        _record("prepare", "view", "train/0", 1),
        _record("prepare", "view", "train/1", 2),
        _record("raytrace", "overhead", "ray tracing: processes", 9),
        _record("raytrace", "view", "train/0", 3),
        _record("finetune", "epoch", "epoch 1", 4),
        _record("finetune", "view", "preview/0", 1),
        _record("finetune", "epoch", "epoch 2", 6),
        _record("finetune", "overhead", "everything else", 2),
        _record("evaluate", "view", "neural/0", 1),
    ]
    records[1:3] = [record.model_copy(update={"workers": 2}) for record in records[1:3]]
    on_nodes = [Step((1, 2)), Step((3,)), Step((11,), whole=True)]
    assert chain_of(records) == [Step((5,), driver=True), *on_nodes, Step((2,), driver=True), Step((1,), driver=True)]


def test_by_hand() -> None:
    list_of_four = [Step((1.0,) * 4)]
    assert makespan([list_of_four], 1, **FREE) == 4
    assert makespan([list_of_four], 2, **FREE) == 2
    assert makespan([list_of_four, list_of_four], 2, **FREE) == 4
    assert makespan([[Step((1.0,)), Step((1.0,))]] * 2, 2, **FREE) == 2  # steps of one scene wait for each other
    assert makespan([list_of_four], 2, start=1.0, per_task=0.5) == 2 + 1 + 2 * 0.5
    assert makespan([[Step((3.0,), driver=True)]] * 4, 1, drivers=2, **FREE) == 6
    assert makespan([], 3) == 0
    assert makespan([[Step((2.0,), whole=True)]] * 3, 1, slots=2, **FREE) == 6  # each has the node to itself
    assert makespan([[Step((2.0,))] * 1] * 3, 1, slots=2, **FREE) == 4


@given(
    chains=st.lists(
        st.lists(st.lists(st.floats(0.1, 5), min_size=1, max_size=5).map(lambda s: Step(tuple(s))), max_size=4),
        max_size=6,
    ),
    slots=st.integers(1, 8),
)
def test_between_the_bounds_of_list_scheduling(chains: list[list[Step]], slots: int) -> None:
    """Never below the work or the longest chain; never above both together (Graham 1966)."""
    work = sum(sum(step.seconds) for chain in chains for step in chain) / slots
    longest = max((sum(max(step.seconds) for step in chain) for chain in chains), default=0.0)
    found = makespan(chains, slots, drivers=100, **FREE)
    assert max(work, longest) - 1e-9 <= found <= work + longest + 1e-9


def test_more_drivers_than_chains_change_nothing() -> None:
    chains = [[Step((1.0, 2.0))]] * 3
    assert makespan(chains, 2, drivers=3, **FREE) == pytest.approx(makespan(chains, 2, drivers=30, **FREE))


def test_the_measured_fleets_took_what_is_forecast() -> None:
    """On one node of one core: within 10 %. Two shared the machine's two cores with the driver and with Ray: longer."""
    found = json.loads(OUT.read_text(encoding="utf-8"))
    ratios = {
        row["nodes"]: row["seconds"] / reckoned(found["small"], row["scenes"], row["nodes"]) for row in found["fleet"]
    }
    assert ratios == {1: pytest.approx(1, abs=0.1), 2: pytest.approx(1.2, abs=0.2)}
    assert found["fleet"][1]["seconds"] < found["fleet"][0]["seconds"]
