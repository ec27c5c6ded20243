"""Frames that are averaged with those next to them, on the scenes of `test_history`, whose every pixel is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dnrpipe.raytrace.temporal_filter import SHARE, Finished, TemporalFilter

from .test_history import SIDE, at_edges, camera, frame, mi

STEP = 0.025
"""Of the camera, scene units: about half a pixel."""


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("the filter needs a jit variant of Mitsuba; this machine has none")


def finished(x: float, **scene: Any) -> Finished:
    """A frame of a camera at x."""
    channels = frame(camera(x), **scene)
    layers = {c: channels[f"base.{c}"] for c in "RGBA"}
    return Finished(camera(x), layers | {name: channels[name] for name in ("depth.Z", *_normals())})


def _normals() -> tuple[str, ...]:
    return tuple(f"normal.{axis}" for axis in "XYZ")


def rgb(layers: Any) -> np.ndarray:
    return np.stack([layers[c] for c in "RGB"], axis=-1)


def three(**scene: Any) -> list[Finished]:
    """Frame, before, after, each with noise of its own."""
    return [finished(STEP * number, seed=seed, **scene) for seed, number in enumerate((0, -1, 1))]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


INNER = (slice(3, -3), slice(3, -3))
"""What all three frames see."""


def test_noise_becomes_less_and_what_is_there_stays() -> None:
    """Of the weights SHARE, 1 - 2 SHARE and SHARE, but for a part of the finest detail."""
    own, before, after = three(noise=0.1)
    found = rgb(TemporalFilter(mi)(own, before, after))
    true = rgb(finished(0).layers)
    least = np.sqrt(2 * SHARE**2 + (1 - 2 * SHARE) ** 2)
    left = rms((found - true)[INNER]) / rms((rgb(own.layers) - true)[INNER])
    assert 0.8 * least < left < 1.3 * least
    clean = TemporalFilter(mi)(*three())
    np.testing.assert_allclose(rgb(clean)[INNER], true[INNER], atol=0.02)


def test_a_frame_alone_is_as_it_was() -> None:
    own, before, after = three(noise=0.1)
    temporal = TemporalFilter(mi)
    other = Finished(camera(STEP, side=SIDE // 2), {})
    for before_, after_ in ((None, None), (other, None), (None, other)):
        np.testing.assert_array_equal(rgb(temporal(own, before_, after_)), rgb(own.layers))
    one, both = rgb(temporal(own, before, None)), rgb(temporal(own, before, after))
    assert rms(one - rgb(own.layers)) > 0.02 and rms(one - both) > 0.02
    assert temporal.kernel.n_recordings == 1, "with and without a frame after it"
    np.testing.assert_allclose(rgb(temporal(own, None, before)), one, atol=1e-5)


def test_alpha_stays_and_rims_take_of_no_others() -> None:
    """Half as opaque as in the frames next to it: their colours are twice as bright."""
    own, before, after = three(noise=0.1)
    thin = {**own.layers, **{c: 0.5 * own.layers[c] for c in "RGBA"}}
    found = TemporalFilter(mi)(Finished(own.view, thin), before, after)
    np.testing.assert_array_equal(found["A"], thin["A"])
    np.testing.assert_allclose(rgb(found), rgb(thin), rtol=1e-4)


def test_what_comes_from_behind_a_box_takes_of_no_other_surface() -> None:
    """The box has other colours than the floor, and the frames lie so far apart that it hides other parts of that."""
    own, before, after = (finished(x, box=True) for x in (0.0, -0.3, 0.3))
    found = TemporalFilter(mi)(own, before, after)
    flat = ~at_edges({name: np.asarray(values) for name, values in own.layers.items()})
    flat[:3] = flat[-3:] = flat[:, :3] = flat[:, -3:] = False
    for _ in range(2):  # the smoothed part reaches a pixel further
        flat &= np.roll(flat, 1, 0) & np.roll(flat, -1, 0) & np.roll(flat, 1, 1) & np.roll(flat, -1, 1)
    assert flat.sum() > SIDE * SIDE / 3
    np.testing.assert_allclose(rgb(found)[flat], rgb(own.layers)[flat], atol=0.06)


def test_light_that_is_elsewhere_in_the_other_frames_leaves_no_ghost() -> None:
    """A lit square on the floor that jumps: where the frame's neighbourhood shows none, there is none."""

    def lit(number: int, x: slice) -> Finished:
        own = finished(STEP * number)
        layers = {name: np.array(values) for name, values in own.layers.items()}
        for c in "RGB":
            layers[c][:] = 0.2
            layers[c][20:24, x] = 2.0
        return Finished(own.view, layers)

    own, before, after = lit(0, slice(22, 26)), lit(-1, slice(8, 12)), lit(1, slice(36, 40))
    found = rgb(TemporalFilter(mi)(own, before, after))
    assert found[20:24, 8:12].max() < 0.21 and found[20:24, 36:40].max() < 0.21
    assert found[21:23, 23:25].min() > 1.4, "where it is, it stays lit"
