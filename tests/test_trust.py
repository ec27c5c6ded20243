"""How far the shipped corrector is trusted: the least share that is nearly as good as the best."""

import pytest

from dnrpipe.stages.trust import ENOUGH, SHARES, _sufficient


@pytest.mark.parametrize("best", [0.2, 0.5, 0.9, 1.0])
def test_a_smaller_share_that_is_nearly_as_good(best: float) -> None:
    errors = [1 + (share - best) ** 2 for share in SHARES]
    share = _sufficient(errors)
    assert 0.7 * best <= share <= best
    gain, most = errors[0] - errors[SHARES.index(share)], errors[0] - min(errors)
    assert gain >= ENOUGH * most


def test_none_where_none_gains() -> None:
    assert _sufficient([1 + share for share in SHARES]) == 0
    assert _sufficient([1.0] * len(SHARES)) == 0
