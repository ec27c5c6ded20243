"""The producer's part of the report: sentences from a plan, also where there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.plan_record import prediction, write_plan

from dnrpipe.report.budget import build_budget


def planned(root: Path, **more: Any) -> Path:
    write_plan(root, **more)
    return root


def test_nothing_is_said_where_nothing_is_known(tmp_path: Path) -> None:
    assert build_budget(tmp_path, None, None) is None
    spent = build_budget(tmp_path, None, 90.0)
    assert spent is not None
    assert "90.0 s" in spent.cost
    assert "dnrpipe plan" in spent.following


def test_the_next_minute_is_read_off_the_plans_table(tmp_path: Path) -> None:
    found = build_budget(planned(tmp_path), None, 61.0)
    assert found is not None
    assert found.following.startswith("About 1.0 dB")
    end = build_budget(planned(tmp_path / "end", chosen=prediction(240, 31.5)), None, 61.0)
    assert end is not None
    assert "Less than 0.1 dB" in end.following


def test_a_choice_below_the_smallest_of_the_table_is_no_trouble(tmp_path: Path) -> None:
    found = build_budget(planned(tmp_path, chosen=prediction(20, 29.0)), None, 61.0)
    assert found is not None
    assert found.following.startswith("About 1.0 dB")


def test_predicted_and_actual_stand_side_by_side(tmp_path: Path) -> None:
    actual = {
        "seconds": {"select": 1.0, "raytrace": 33.0, "finetune": 30.0, "evaluate": 9.0, "total": 64.0},
        "cpu_seconds": 80.0,
        "ran": {"select": True, "raytrace": True, "finetune": False, "evaluate": True},
        "psnr": 30.4,
    }
    found = build_budget(planned(tmp_path, actual=actual), None, 70.0)
    assert found is not None
    rows = {row.what: (row.predicted, row.actual) for row in found.rows}
    assert rows["raytrace"] == ("30.0 s", "33.0 s")
    assert rows["finetune"][1] == "was done before"
    assert rows["PSNR, held-out"] == ("30.0 dB (29.0 to 31.0)", "30.4 dB")
    assert "64.0 s" in found.cost


def test_a_truncated_plan_is_as_if_there_were_none(tmp_path: Path) -> None:
    (tmp_path / "plan").mkdir()
    (tmp_path / "plan" / "plan.json").write_text('{"chosen": ')
    found = build_budget(tmp_path, None, 5.0)
    assert found is not None
    assert found.rows == []


def test_sentences_say_why_and_whether_to_train(tmp_path: Path) -> None:
    route = {
        "name": "path tracing + denoiser",
        "what": "about 4 spp raw",
        "upfront": 0.0,
        "frame": 0.1,
        "reaches": True,
    }
    traced = route | {"total": 20.0, "psnr": 30.0}
    trained = route | {"name": "neural renderer", "what": "6 views", "upfront": 60.0, "total": 90.0, "psnr": 30.0}
    asked = {"routes": [traced, trained], "routes_psnr": 30.0, "break_even": None, "train": False}
    wanted = {"seconds": None, "psnr": None, "frames": 200}
    found = build_budget(planned(tmp_path, wanted=wanted, **asked), None, None)
    assert found is not None
    assert "The base image alone gives 28.0 dB; the network is expected to add 2.0, of at most 4.0" in found.why[0]
    assert "60.0 s more would buy 1.0 dB." in found.why
    assert found.routes[0] == "200 frames at 30.0 dB:"
    assert found.routes[1].startswith("path tracing + denoiser · 20.0 s ·")
    assert found.routes[2].startswith("neural renderer · 90.0 s ·")
    assert found.routes[3:] == [
        "Do not train: path tracing + denoiser is cheaper.",
        "The neural renderer never pays for itself against path tracing at that PSNR.",
    ]
    table = build_budget(planned(tmp_path / "table", chosen=None), None, None)
    assert table is not None and table.why == table.routes == []
