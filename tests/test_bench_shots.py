"""The shot benchmark's arithmetic: which path tracing is as good, and what the table makes of it."""

from __future__ import annotations

from typing import Any

import pytest
from tools.bench_shots import REEL, equal_rung, markdown, seconds_as_good


def figures(psnr: float, lpips: float) -> dict[str, float]:
    return {"psnr": psnr, "ssim": 0.9, "lpips": lpips, "flip": 0.05, "flicker": 0.01}


def rung(spp: int, frame: float, psnr: float, lpips: float, quality: str = "high") -> dict[str, Any]:
    return {"spp": spp, "quality": quality, "frame": frame, **figures(psnr, lpips)}


def row(**changes: Any) -> dict[str, Any]:
    """A shot by base images of 30 dB / .05: 100 s before its first frame, 2 s a frame."""
    return {
        "scene": "a",
        "size": "640x360",
        "machine": "M",
        "before": 100.0,
        "frame": 2.0,
        "chosen": {"way": {"name": "base", "spp": 8}},
        "ours": figures(30.0, 0.05),
        "rungs": [rung(4, 2.0, 29.0, 0.06), rung(8, 4.0, 31.0, 0.06), rung(16, 8.0, 33.0, 0.04)],
        **changes,
    }


def cells(found: dict[str, Any]) -> list[str]:
    return [cell.strip() for cell in markdown({"rows": [found]}).splitlines()[-1].strip("|").split("|")]


def test_path_tracing_must_be_as_good_in_both() -> None:
    assert (equal_rung(row(), ("psnr", "lpips")) or {})["spp"] == 16
    assert (equal_rung(row(), ("psnr",)) or {})["spp"] == 8
    assert cells(row())[9] == "16 spp, high"
    assert float(cells(row())[14]) == pytest.approx((100 + REEL * 2) / (REEL * 8), abs=0.01)


def test_between_rungs_path_tracing_is_no_better_than_ours() -> None:
    """Ours has the dB of halfway from 4 to 8 samples, and the LPIPS of halfway from 8 to 16: by the logarithm."""
    assert seconds_as_good(row(), ("psnr",)) == pytest.approx(4 * 2**0.5 / 2)
    geometric = row(ours=figures(30.0, (0.06 * 0.04) ** 0.5))
    assert seconds_as_good(geometric, ("psnr", "lpips")) == pytest.approx(8 * 2**0.5 / 2)
    assert float(cells(geometric)[15]) == pytest.approx((100 + REEL * 2) / (REEL * 8 * 2**0.5 / 2), abs=0.01)
    assert seconds_as_good(row(ours=figures(20.0, 0.2)), ("psnr", "lpips")) == 2.0, "the first rung is the cheapest"
    assert seconds_as_good(row(ours=figures(40.0, 0.05)), ("psnr", "lpips")) is None


def test_the_rival_is_the_cheaper_of_the_two_path_tracers() -> None:
    quick, slow = rung(32, 3.0, 30.5, 0.05, "fast"), rung(32, 9.0, 30.5, 0.05)
    assert cells(row(cycles=[slow]))[9] == "16 spp, high"
    found = cells(row(cycles=[rung(16, 1.0, 29.9, 0.01), quick]))
    assert found[9:11] == ["Cycles, 32 spp, fast", "3.00"]
    assert float(found[14]) == pytest.approx((100 + REEL * 2) / (REEL * 3), abs=0.01)


def test_a_path_traced_shot_is_as_good_as_the_rung_that_it_is() -> None:
    """At its own seconds: a rung's few frames vary; and none of the rungs need look as good as the shot by chance."""
    way = {"way": {"name": "path", "spp": 4}}
    assert equal_rung(row(chosen=way, frame=2.2), ("psnr", "lpips")) == rung(4, 2.2, 29.0, 0.06)
    filtered = row(chosen=way, frame=2.2, filtered=True)
    assert equal_rung(filtered, ("psnr", "lpips")) == rung(16, 8.0, 33.0, 0.04), "better than its samples alone"


def test_where_nothing_is_as_good_the_last_rungs_bound_the_ratio() -> None:
    """Either tracer would take longer than its last rung: than the quicker of these at least."""
    poor = row(ours=figures(40.0, 0.01))
    assert cells(poor)[9] == "not by 16 spp, high" and cells(poor)[10] == "> 8.00"
    found = cells(poor | {"cycles": [rung(64, 5.0, 35.0, 0.02)]})
    assert found[9] == "not by Cycles, 64 spp, high" and found[10] == "> 5.00"
    assert float(found[14].removeprefix("< ")) == pytest.approx((100 + REEL * 2) / (REEL * 5), abs=0.01)


def test_the_first_table_says_each_scenes_part_of_path_tracings_time_and_flicker() -> None:
    """By size, the largest first; scenes by what they save there."""
    changes = {"flicker": 0.004, "flicker_rms": 0.006}
    rungs = [each | {"flicker": 0.008, "flicker_rms": 0.024} for each in row()["rungs"]]
    rows = [
        row(),
        row(scene="b", size="1280x720", frame=5.0, rungs=rungs, ours=figures(30.0, 0.05) | changes),
        row(scene="c", size="1280x720", ours=figures(40.0, 0.05)),
    ]
    lines = markdown({"rows": rows}).splitlines()
    assert lines[2].startswith("| scene | 1280x720: time |") and "640x360: time" in lines[2]
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[4:7]]
    ours = 100 / REEL + 2.0
    between = seconds_as_good(rows[1], ("psnr", "lpips")) or 0.0
    assert found[0] == ["c", f"< {ours / 8:.2f}", "", "1.00", "", "", "", "", ""]
    assert found[1] == ["b", f"{(ours + 3) / 8:.2f}", f"{(ours + 3) / between:.2f}", "0.50", "0.25", "", "", "", ""]
    assert found[2][0] == "a" and found[2][1:5] == [""] * 4 and found[2][5] == f"{ours / 8:.2f}"
