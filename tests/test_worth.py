"""``--budget auto``: how many views are worth their seconds."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from dnrpipe.core.cameras import look_at_view
from dnrpipe.core.console import Console
from dnrpipe.core.errors import UserError
from dnrpipe.core.scene_files import read_selection
from dnrpipe.core.settings import MOST_VIEWS, resolve
from dnrpipe.core.workspace import Source, Workspace, file_sha256
from dnrpipe.stages import select
from dnrpipe.stages.stage import Run
from dnrpipe.stages.worth import GROWTH, Worth, expected_gain, views_worth
from dnrtrain.contract import write_cameras


def test_views_that_gain_nothing_are_not_traced() -> None:
    assert views_worth(-0.2, 1.0, 0.001, 25) == views_worth(0.0, 0.0, 0.0, 25) == 0
    assert views_worth(0.1, 60.0, 0.3, 25) == 0


def test_views_are_taken_until_the_next_one_costs_more_than_it_gains() -> None:
    gain, seconds, price = 0.4, 4.0, 0.005
    count = views_worth(gain, seconds, price, 1000)
    slope = gain * GROWTH / 2 * (count / 2) ** (GROWTH - 1)  # G'
    assert 1 < count < 1000 and slope == pytest.approx(price * seconds, rel=0.05)
    assert expected_gain(gain, 2) == gain and math.isclose(expected_gain(gain, 8), gain * 4**GROWTH)


def test_more_are_worth_it_where_training_gains_more_or_time_is_cheap() -> None:
    counts = [views_worth(gain, 4.0, 0.005, 25) for gain in (0.1, 0.2, 0.4, 3.0)]
    assert counts == sorted(set(counts)) and counts[-1] == 25
    assert views_worth(0.2, 4.0, 0.0, 12) == 12


def test_auto_is_a_budget_of_the_settings() -> None:
    assert resolve("draft", {"select": {"budget": "auto"}}, environment={}).select.most == MOST_VIEWS
    with pytest.raises(UserError, match=r"select\.budget"):
        resolve("draft", {"select": {"budget": "many"}}, environment={})
    with pytest.raises(UserError, match="start=pretrained"):
        resolve("draft", {"select": {"budget": "auto"}, "finetune": {"step2": {"start": "fresh"}}}, environment={})


def test_why_no_view_is_worth_it_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "scene.blend"
    source.write_bytes(b"")
    workspace = Workspace.create(tmp_path / "scene.dnr", Source(path=str(source), sha256=file_sha256(source)))
    settings = resolve("draft", {"select": {"budget": "auto"}}, environment={})
    camera = look_at_view("0000", np.array([3.0, 0, 1]), np.zeros(3), 40.0, settings.cameras)
    write_cameras(workspace.cameras("train"), [camera], "train")
    found = Worth(gain=-0.1, seconds=2.0, views=0, expected=0.0)
    monkeypatch.setattr(select, "worth", lambda run, candidates: found)
    monkeypatch.setattr(select, "draw_missing", lambda run, needed: None)
    select.select_views(Run(workspace, settings, Console(quiet=True), "select", "run"))
    assert read_selection(workspace).details["worth"] == found.model_dump()
