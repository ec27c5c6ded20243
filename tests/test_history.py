"""What is remembered of earlier frames, on scenes whose every pixel is known: planes, a mirror, a box before a wall."""

from __future__ import annotations

import numpy as np
import pytest

from dnrpipe.raytrace.history import History
from dnrtrain.contract import FRESH_CHANNELS, View

mi = pytest.importorskip("mitsuba")
SIDE = 48


@pytest.fixture(autouse=True)
def _variant(mitsuba_variant: str) -> None:
    if mitsuba_variant.startswith("scalar"):
        pytest.skip("histories need a jit variant of Mitsuba; this machine has none")


def camera(x: float, y: float = 0.0, side: int = SIDE) -> View:
    """Looks down from height 3, a little slanted."""
    tilt = 0.3
    right, back = np.array([1.0, 0, 0]), np.array([0, -np.sin(tilt), np.cos(tilt)])
    up = np.cross(back, right)
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([right, up, back], axis=1)
    c2w[:3, 3] = x, y, 3.0
    intrinsics = {"fl_x": 1.2 * side, "fl_y": 1.2 * side, "cx": side / 2, "cy": side / 2}
    return View(name="v", width=side, height=side, c2w=tuple(map(tuple, c2w.tolist())), **intrinsics)


def pattern(points: np.ndarray) -> np.ndarray:
    """Smooth colours of a plane, [H, W, 3] in [1, 2]."""
    x, y = points[..., 0], points[..., 1]
    return 1.5 + 0.5 * np.stack([np.sin(4 * x), np.cos(5 * y), np.sin(3 * x + 3 * y)], axis=-1)


def frame(
    view: View, *, mirror: float = 0.0, box: bool = False, noise: float = 0.0, seed: int = 0
) -> dict[str, np.ndarray]:
    """Channels of the floor z = 0: matt, or a mirror below a ceiling of height ``mirror``; perhaps with a box on it."""
    rays = view.ray_directions().astype(np.float64)
    height = np.zeros(rays.shape[:2])
    at = view.position + rays * (-view.position[2] / rays[..., 2])[..., None]
    if box:
        top = view.position + rays * ((1 - view.position[2]) / rays[..., 2])[..., None]
        on_box = (np.abs(top[..., 0]) < 0.3) & (np.abs(top[..., 1] - 0.5) < 0.6)
        at, height = np.where(on_box[..., None], top, at), np.where(on_box, 1.0, 0.0)
    length, end = np.zeros(height.shape), np.zeros((*height.shape, 3))
    colour = pattern(at + 7 * height[..., None])
    if mirror:
        length = mirror / -rays[..., 2]
        end = at + rays * length[..., None] * [1, 1, -1]
        colour = pattern(end)
    colour = colour + noise * np.random.default_rng(seed).normal(size=colour.shape)
    depth = (at - view.position) @ -view.matrix[:3, 2]
    ones = np.ones(height.shape)
    diffuse = np.zeros_like(colour) if mirror else colour
    channels = {
        "base.A": ones,
        "mask": ones,
        "depth.Z": depth,
        "chain.length": length,
        "noise": 0 * ones,
        "rays": 2 * ones,
    }
    for i, c in enumerate("RGB"):
        channels[f"chain.{'XYZ'[i]}"] = end[..., i]
        channels |= {f"base.{c}": colour[..., i], f"diffuse.{c}": diffuse[..., i], f"albedo.{c}": diffuse[..., i]}
        channels |= {f"shown.{c}": diffuse[..., i]}
    channels |= {f"{kind}.{axis}": ones * (axis == "Z") for kind in ("normal", "facing") for axis in "XYZ"}
    return {name: np.asarray(values, np.float32) for name, values in channels.items()}


def rgb(channels: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([channels[f"base.{c}"] for c in "RGB"], axis=-1)


def at_edges(channels: dict[str, np.ndarray]) -> np.ndarray:
    """Pixels with a neighbour, of eight, whose depth is another one."""
    depth = channels["depth.Z"]
    beside = [np.roll(depth, (right, below), (1, 0)) for right in (-1, 0, 1) for below in (-1, 0, 1)]
    edges = np.ptp(beside, axis=0) > 0.5
    edges[[0, -1]] = edges[:, [0, -1]] = False
    return edges


def shifted(view: View, right: float, below: float) -> View:
    """Its rays through places so far, in pixels, from the pixels' centres."""
    return view.model_copy(update={"cx": view.cx - right, "cy": view.cy - below})


def test_a_first_frame_is_as_it_was() -> None:
    channels = frame(camera(0), noise=0.1)
    taken = History(mi).take(camera(0), channels)
    for name, values in channels.items():
        np.testing.assert_allclose(taken[name], values, atol=1e-6)
    assert set(taken) - set(channels) == set(FRESH_CHANNELS)
    np.testing.assert_allclose(taken["fresh.G"], channels["base.G"], atol=1e-6)


def test_a_resting_camera_adds_up_to_the_mean_of_its_frames() -> None:
    history, frames = History(mi), [frame(camera(0), noise=0.1, seed=seed) for seed in range(8)]
    for channels in frames:
        taken = history.take(camera(0), channels)
    np.testing.assert_allclose(rgb(taken), np.mean([rgb(channels) for channels in frames], axis=0), atol=1e-3)
    assert (taken["rays"] == 16).all() and history.number == 8
    np.testing.assert_allclose(taken["fresh.R"], frames[-1]["base.R"], atol=1e-5)
    assert (taken["fresh.rays"] == 2).all()
    # The standard error of the mean of eight frames, by their spread.
    true = 0.1 * np.sqrt(0.2126**2 + 0.7152**2 + 0.0722**2) / np.sqrt(8)
    assert np.sqrt((taken["noise"] ** 2).mean()) == pytest.approx(true, rel=0.15)


@pytest.mark.parametrize("mirror", [0.0, 2.0])
def test_a_moving_camera_gathers_rays_of_what_it_sees(mirror: float) -> None:
    history, clean = History(mi), camera(0.02 * 11)
    for number in range(12):
        noisy = frame(camera(0.02 * number), mirror=mirror, noise=0.1, seed=number)
        taken = history.take(camera(0.02 * number), noisy)
    truth = rgb(frame(clean, mirror=mirror))
    inner = (slice(8, -8),) * 2
    before, after = (np.sqrt(((rgb(c) - truth)[inner] ** 2).mean()) for c in (noisy, taken))
    assert before > 0.09 and after < (0.06 if mirror else 0.07)
    assert np.median(taken["rays"][inner]) == (18 if mirror else 8), "as many as may count, and the frame's own"


def test_what_a_mirror_shows_is_not_held_to_its_surface() -> None:
    """With the length of the path left out, the same frames give a picture that is smeared or begins anew."""
    errors = []
    for known in (True, False):
        history = History(mi)
        for number in range(12):
            channels = frame(camera(0.05 * number), mirror=2.0)
            if not known:
                channels["chain.length"] = 0 * channels["chain.length"]
            taken = history.take(camera(0.05 * number), channels)
        truth = rgb(frame(camera(0.05 * 11), mirror=2.0))
        errors.append(np.sqrt(((rgb(taken) - truth)[8:-8, 8:-8] ** 2).mean()))
    assert errors[0] < 0.02 and errors[1] > 3 * errors[0], errors


def test_what_comes_from_behind_a_box_begins_anew() -> None:
    history = History(mi)
    history.take(camera(-0.4), frame(camera(-0.4), box=True))
    channels = frame(camera(0.4), box=True)
    taken = history.take(camera(0.4), channels)
    fresh, wide = taken["rays"] == 2, (taken["rays"] == 4) & ~at_edges(channels)
    assert fresh.mean() > 0.05 and wide.mean() > 0.3
    np.testing.assert_array_equal(rgb(taken)[fresh], rgb(channels)[fresh])
    assert np.abs(rgb(taken) - rgb(channels))[wide].max() < 0.05, "the box's colours are 7 units away from the floor's"


def test_edges_gather_rays_of_the_frames_before() -> None:
    """Each frame has one ray a pixel, elsewhere in it: only over the frames is the share of the box seen."""
    history, places = History(mi), np.random.default_rng(0).random((25, 2)) - 0.5
    views = [camera(0.01 * number) for number in range(len(places))]
    for view, place in zip(views, places, strict=True):
        alone = frame(view, box=True) | {
            name: plane
            for name, plane in frame(shifted(view, *place), box=True).items()
            if name[:4] in ("base", "diff")
        }
        taken = history.take(view, alone)
    grid = [((i + 0.5) / 8 - 0.5, (j + 0.5) / 8 - 0.5) for i in range(8) for j in range(8)]
    truth = np.mean([rgb(frame(shifted(views[-1], *place), box=True)) for place in grid], axis=0)
    edges = at_edges(alone)
    before, after = (np.sqrt(((rgb(c) - truth)[edges] ** 2).mean()) for c in (alone, taken))
    assert before > 0.1 and after < 0.6 * before, (before, after)


def test_a_cut_and_another_size_begin_anew() -> None:
    for view in (camera(50.0), camera(0.0, side=32)):
        history = History(mi)
        history.take(camera(0.0), frame(camera(0.0)))
        channels = frame(view, noise=0.1)
        taken = history.take(view, channels)
        assert (taken["rays"] == 2).all()
        np.testing.assert_allclose(rgb(taken), rgb(channels), atol=1e-6)


def test_light_that_went_away_does_not_stay() -> None:
    """A glossy floor that was lit: its colour is outside what is seen now."""
    history, lit, dark = History(mi), frame(camera(0), mirror=2.0), frame(camera(0.06), mirror=2.0)
    for channels in (lit, dark):
        channels["chain.length"] = 0 * channels["chain.length"]
    for c in "RGB":
        lit[f"base.{c}"] = lit[f"base.{c}"] * 0 + 5.0
    for number in range(6):
        history.take(camera(0.01 * number), lit)
    taken = history.take(camera(0.06), dark)
    assert np.abs(rgb(taken) - rgb(dark)).max() < 1.0


def bent(number: int, *, noise: float) -> dict[str, np.ndarray]:
    """A frame of a mirror whose paths end elsewhere than in the frame before, as a bent line of sight may."""
    channels = frame(camera(0.02 * number), mirror=2.0, noise=noise, seed=number)
    return {**channels, "chain.X": channels["chain.X"] + number}


def test_a_mirror_that_shows_something_else_begins_anew() -> None:
    history = History(mi)
    for number in range(4):
        channels = bent(number, noise=0.1)
        taken = history.take(camera(0.02 * number), channels)
    assert (taken["rays"] == 2).all()
    np.testing.assert_allclose(rgb(taken), rgb(channels), atol=1e-6)


def test_a_curved_mirror_is_held_to_its_surface_for_a_few_rays() -> None:
    """And within what is seen now: light from far outside the neighbourhood does not stay."""
    history = History(mi)
    rows, columns = np.mgrid[:SIDE, :SIDE]
    tilt = 0.05 * np.stack([columns % 2, rows % 2])
    for number in range(4):
        channels = bent(number, noise=0.1)
        channels["normal.X"], channels["normal.Y"] = tilt.astype(np.float32)
        channels["normal.Z"] = np.sqrt(1 - (tilt**2).sum(axis=0)).astype(np.float32)
        if number == 2:
            for c in "RGB":
                channels[f"base.{c}"] = channels[f"base.{c}"] + 5
        taken = history.take(camera(0.02 * number), channels)
    inner = (slice(8, -8),) * 2
    assert np.median(taken["rays"][inner]) == 8, "six remembered, two of the frame"
    assert np.abs(rgb(taken) - rgb(channels))[inner].max() < 1, "the light was 5 brighter two frames ago"
