"""How far the shipped corrector is trusted: the least share that is nearly as good as the best."""

import pytest

from dnrpipe.stages.trust import ENOUGH, LEAST_GAIN, SHARES, _sufficient, judged


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


def test_a_gain_that_rays_bring_in_the_same_time_is_none() -> None:
    assert judged(0.4, 30.0, 30.0 + 2 * LEAST_GAIN).share == 0.4
    less = judged(0.4, 30.0, 30.0 + LEAST_GAIN / 2)
    assert (less.share, less.psnr) == (0, (30.0, 30.0)) and "base images (30.0 dB" in less.told
