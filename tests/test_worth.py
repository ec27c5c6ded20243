"""``--budget auto``: how many views are worth their seconds."""

from __future__ import annotations

import math

import pytest

from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import MOST_VIEWS, resolve
from dnrpipe.stages.worth import GROWTH, expected_gain, views_worth


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
