"""The producer's part of the report: sentences from a plan, also where there is none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from dnrpipe.report.budget import build_budget


def prediction(seconds: float, psnr: float) -> dict[str, Any]:
    return {
        "choice": {"views": 6, "spp": 16, "epochs": 25, "steps": 150},
        "seconds": {
            "select": 1.0,
            "raytrace": seconds / 2,
            "finetune": seconds / 2 - 1,
            "evaluate": 5.0,
            "total": {"expected": seconds, "low": seconds / 2, "high": seconds * 2},
        },
        "cpu_seconds": seconds,
        "psnr": {"expected": psnr, "low": psnr - 1, "high": psnr + 1},
    }


def planned(root: Path, **more: Any) -> Path:
    record: dict[str, Any] = {
        "chosen": prediction(60, 30.0),
        "settings_default": prediction(200, 30.5),
        "table": [prediction(60, 30.0), prediction(120, 31.0), prediction(240, 31.5)],
        "base_psnr": 28.0,
        "gain": 4.0,
        **more,
    }
    (root / "plan").mkdir(parents=True)
    (root / "plan" / "plan.json").write_text(json.dumps(record))
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


def test_a_torn_plan_is_as_if_there_were_none(tmp_path: Path) -> None:
    (tmp_path / "plan").mkdir()
    (tmp_path / "plan" / "plan.json").write_text('{"chosen": ')
    found = build_budget(tmp_path, None, 5.0)
    assert found is not None
    assert found.rows == []
