"""The ledger: durable appends, torn lines, sums."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from dnrpipe.core.errors import UserError
from dnrpipe.core.ledger import (
    CostRecord,
    CostSummary,
    Ledger,
    break_even_frames,
    latest_epochs,
    selection_cost,
    summarise,
    total,
    total_by,
    traced_views,
    tracing_all_would_cost,
    upfront_seconds,
    upfront_work,
)


def record(**changes: Any) -> CostRecord:
    values: dict[str, Any] = {
        "time": 1.7e9,
        "run": "r1",
        "stage": "raytrace",
        "purpose": "training",
        "unit": "view",
        "name": "train/0000",
        "seconds": 2.0,
        "spp": 128,
        "cpu_seconds": 3.5,
        "device": "llvm_ad_rgb",
    }
    return CostRecord(**{**values, **changes})


def test_append_and_read_round_trip(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "deep" / "costs.jsonl")
    assert ledger.read() == []
    written = [
        record(),
        record(name="train/ü\n1", workers=2, width=128, height=64, spp=256, noise=0.02, peak_mb=812.5),
        record(stage="finetune", unit="epoch", name="epoch 3", steps=40, detail={"loss": 0.1, "nan": 0}),
        record(cache_hit=True, seconds=0.0),
    ]
    for each in written:
        ledger.append(each)
    assert ledger.read() == written
    assert ledger.truncated_records() == 0
    assert len(ledger.path.read_bytes().splitlines()) == len(written)


def test_torn_last_line_is_tolerated_then_closed_by_the_next_append(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "costs.jsonl")
    ledger.append(record(name="a"))
    ledger.append(record(name="b"))
    whole = ledger.path.read_bytes()
    for cut in (1, 40, len(whole.splitlines()[1]) - 3):  # anywhere inside the second line
        ledger.path.write_bytes(whole.splitlines(keepends=True)[0] + whole.splitlines()[1][:cut])
        assert [r.name for r in ledger.read()] == ["a"]
        assert ledger.truncated_records() == 1
        ledger.append(record(name="c"))
        assert [r.name for r in ledger.read()] == ["a", "c"]
        assert ledger.truncated_records() == 1


def test_a_whole_last_line_without_newline_is_kept(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "costs.jsonl")
    ledger.append(record(name="a"))
    ledger.path.write_bytes(ledger.path.read_bytes().rstrip(b"\n"))
    ledger.append(record(name="b"))
    assert [r.name for r in ledger.read()] == ["a", "b"]
    assert ledger.truncated_records() == 0


def test_blocks_of_zeros_and_noise_count_as_torn(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "costs.jsonl")
    ledger.append(record(name="a"))
    with ledger.path.open("ab") as file:
        file.write(b"\0" * 64 + b"\n" + b"\xff\xfe\x80\n")
    ledger.append(record(name="b"))
    assert [r.name for r in ledger.read()] == ["a", "b"]
    assert ledger.truncated_records() == 2


def test_a_foreign_line_is_refused_with_its_place(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "costs.jsonl")
    ledger.append(record())
    values = {**record().model_dump(), "colour": "red"}
    with ledger.path.open("a") as file:
        file.write(json.dumps(values) + "\n")
    with pytest.raises(UserError, match=r"costs\.jsonl:2: .*colour"):
        ledger.read()


@pytest.mark.parametrize(
    "changes",
    [
        {"seconds": float("nan")},
        {"seconds": -1.0},
        {"workers": 0},
        {"stage": "cooking"},
        {"purpose": "fun"},
        {"unknown": 1},
        {"detail": {"loss": float("nan")}},
        {"detail": {"path": Path("x")}},
    ],
)
def test_nonsense_is_not_a_record(changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        record(**changes)


def test_concurrent_appends_lose_nothing(tmp_path: Path) -> None:
    path = tmp_path / "costs.jsonl"
    code = (
        "import sys\n"
        "from dnrpipe.core.ledger import CostRecord, Ledger\n"
        "for i in range(50):\n"
        "    Ledger(sys.argv[1]).append(CostRecord(time=0, run='r', stage='raytrace', purpose='training',"
        " unit='view', name=f'{sys.argv[2]}/{i}', seconds=1))\n"
    )
    processes = [subprocess.Popen([sys.executable, "-c", code, str(path), str(p)]) for p in range(3)]
    assert [p.wait(timeout=60) for p in processes] == [0, 0, 0]
    ledger = Ledger(path)
    assert {r.name for r in ledger.read()} == {f"{p}/{i}" for p in range(3) for i in range(50)}
    assert ledger.truncated_records() == 0


def test_sums_by_stage_and_purpose_and_wall_clock() -> None:
    records = [
        record(stage="finetune", unit="epoch", name="epoch 1", seconds=10.0, peak_mb=100.0),
        record(name="train/1", seconds=4.0, workers=2),
        record(name="test/1", purpose="evaluation", seconds=6.0, workers=2, peak_mb=300.0),
        record(name="test/2", purpose="evaluation", seconds=0.0, cache_hit=True),
    ]
    stages = total_by("stage", records)
    assert list(stages) == ["raytrace", "finetune"]  # the pipeline's order, not the file's
    assert stages["raytrace"].seconds == 10.0
    assert stages["raytrace"].wall_seconds == 5.0
    assert stages["raytrace"].cache_hits == 1
    purposes = total_by("purpose", records)
    assert purposes["training"].seconds == 14.0
    assert purposes["training"].wall_seconds == 12.0
    assert purposes["evaluation"].wall_seconds == 3.0
    assert "inference" not in purposes
    assert total(records).peak_mb == 300.0
    assert total([]).peak_mb is None


def test_tracing_all_uses_the_last_computed_record_of_each_view() -> None:
    records = [
        record(name="train/1", seconds=100.0),  # an older run with more samples
        record(name="train/1", seconds=2.0),
        record(name="train/2", seconds=4.0),
        record(name="train/2", seconds=0.0, cache_hit=True),
        record(name="test/1", purpose="evaluation", seconds=50.0),
        record(stage="select", unit="epoch", name="epoch 1", seconds=20.0),
    ]
    assert [r.seconds for r in traced_views(records, "training")] == [2.0, 4.0]
    found = tracing_all_would_cost(records, 10)
    assert found is not None
    assert (found.views, found.candidates, found.seconds_per_view) == (2, 10, 3.0)
    assert (found.actual_seconds, found.all_seconds, found.saved_seconds) == (6.0, 30.0, 24.0)
    assert (found.selection_seconds, found.net_saved_seconds) == (20.0, 4.0)
    untrained = [*records, record(stage="select", unit="scene", name="selection", seconds=0.5)]
    found = tracing_all_would_cost(untrained, 10)  # chosen anew, by a policy without training
    assert found is not None and found.selection_seconds == 0.5
    one = tracing_all_would_cost(records, 10, only={"train/2"})  # train/1 is no longer selected
    assert one is not None and (one.views, one.actual_seconds, one.all_seconds) == (1, 4.0, 40.0)


def test_only_what_has_samples_per_pixel_is_ray_tracing() -> None:
    records = [
        record(stage="prepare", name="train/1", spp=None),
        record(stage="evaluate", purpose="evaluation", name="test/1"),
        record(stage="evaluate", purpose="evaluation", name="test/2", spp=None),  # a neural frame
    ]
    assert traced_views(records, "training") == []
    assert [r.name for r in traced_views(records, "evaluation")] == ["test/1"]


def test_a_view_traced_further_costs_all_its_seconds_and_the_sums_count_each_once() -> None:
    """Lower noise from the samples that are there: the second record holds the new seconds, and names the old."""
    first = record(name="train/0001", spp=64, seconds=3.0, cpu_seconds=2.0)
    earlier = {"earlier_seconds": 3.0, "earlier_cpu_seconds": 2.0}
    second = record(name="train/0001", spp=256, seconds=9.0, cpu_seconds=8.0, detail=earlier)
    (view,) = traced_views([first, second], "training")
    assert (view.seconds, view.cpu_seconds, view.spp) == (12.0, 10.0, 256)
    assert total([first, second]).seconds == 12.0
    assert upfront_seconds([first, second]) == pytest.approx(12.0)


def test_repeated_epochs_count_once_in_what_a_stage_costs() -> None:
    epochs = [
        record(stage="select", unit="epoch", name=f"epoch {i}", seconds=s, spp=None)
        for i, s in ((1, 9.0), (2, 9.0), (1, 5.0), (2, 6.0))
    ]
    assert [e.seconds for e in latest_epochs([*epochs, record()])] == [5.0, 6.0]
    assert total_by("stage", epochs)["select"].seconds == 29.0


def test_tracing_all_before_tracing_and_with_bad_counts() -> None:
    assert tracing_all_would_cost([], 10) is None
    assert tracing_all_would_cost([record(cache_hit=True)], 10) is None
    with pytest.raises(ValueError):
        tracing_all_would_cost([record()], -1)
    few = tracing_all_would_cost([record()], 0)  # traced more than there are candidates: nothing saved
    assert few is not None and few.saved_seconds == 0.0


def test_break_even() -> None:
    assert break_even_frames(100.0, 2.0, 0.01) == 51
    assert break_even_frames(0.0, 2.0, 0.01) == 0
    assert break_even_frames(100.0, 0.01, 0.02) is None


def test_summary_is_json_and_empty_ledgers_have_one() -> None:
    records = [record(spp=64, noise=0.1), record(name="train/1", spp=128, noise=0.3)]
    summary = summarise(records, n_candidates=8, truncated_records=1)
    assert CostSummary.model_validate_json(json.dumps(summary.model_dump(), allow_nan=False)) == summary
    assert summary.raytraced["training"].spp == [64, 128]
    assert summary.raytraced["training"].noise == pytest.approx(0.2)
    assert summary.tracing_all is not None and summary.tracing_all.all_seconds == 16.0
    assert summary.torn_lines == 1
    empty = summarise([])
    assert empty.total.seconds == 0.0 and empty.tracing_all is None


def test_upfront_cost_is_training_once() -> None:
    records = [
        record(stage="prepare", unit="scene", name="convert", seconds=3.0, spp=None),
        record(name="train/1", seconds=100.0),
        record(name="train/1", seconds=4.0, workers=2),
        record(name="train/9", seconds=50.0),
        record(name="train/1", seconds=0.1, cache_hit=True),
        record(name="test/1", purpose="evaluation", seconds=70.0),
    ]
    assert upfront_seconds(records, only={"train/1"}) == 5.0
    assert upfront_seconds(records) == 55.0


def test_what_comes_before_the_first_frame_is_one_list_by_kind() -> None:
    """Light that the plan's pilot baked is that of ray tracing; epochs of both steps count; names tell the rest."""
    records = [
        record(stage="prepare", unit="scene", name="convert", seconds=3.0, spp=None),
        record(stage="prepare", name="train/1", seconds=1.0, spp=None),
        record(stage="plan", unit="scene", name="light", seconds=9.0, spp=32),
        record(stage="plan", unit="scene", name="pilot: trace", seconds=8.0, spp=None),
        record(stage="raytrace", unit="scene", name="light", seconds=7.0, cpu_seconds=14.0, spp=64),
        record(name="train/1", seconds=4.0),
        record(stage="finetune", name="base/train/1", seconds=0.5, spp=None),
        record(stage="select", unit="epoch", name="epoch 1", seconds=2.0, spp=None),
        record(stage="finetune", unit="epoch", name="epoch 1", seconds=5.0, spp=None),
        record(stage="finetune", unit="overhead", name="everything else", seconds=0.25, spp=None),
        record(stage="select", unit="overhead", name="everything else", seconds=0.5, spp=None),
    ]
    assert selection_cost(records).seconds == 2.0
    work = upfront_work(records)
    seconds = {part: total(units).seconds for part, units in work.items()}
    assert seconds == {
        "conversion": 3.0, "passes": 1.0, "pilot": 8.0, "selection": 0.5, "tracing": 4.0, "light": 7.0,
        "base images": 0.5, "training": 7.25,
    }  # fmt: skip
    assert total(work["light"]).cpu_seconds == 14.0
    assert sum(seconds.values()) == upfront_seconds(records)
    assert not upfront_work(records, only=set())["base images"]
