"""tools.plan_prior and tools.plan_equal: what they fit and print, on cells whose truth is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from tools.plan_equal import markdown
from tools.plan_prior import collect, fit, fit_prior, without

from dnrpipe.studies.planning.quality import Prior, Quality, scene_gain, with_noise

SCENES = {"quick": (3.0, 0.08), "slow": (6.0, 0.28), "even": (4.0, 0.15), "plain": (2.0, 0.12)}
"""Scenes that learn by the formula: their G and b."""


def gain(scene: str, views: int, steps: int) -> float:
    total, missing = SCENES[scene]
    return total * (1 - 0.1 * (25 / views) ** 0.4 - missing * (500 / steps) ** 0.8)


def cells() -> list[dict[str, Any]]:
    return [
        {
            "scene": scene,
            "source": "frontier",
            "seed": 0,
            "views": views,
            "spp": 16,
            "steps": steps,
            "psnr": with_noise(28.0 + gain(scene, views, steps), 0.005),
            "base": with_noise(28.0, 0.005),
            "noise": 0.01,
            "reference": 0.005,
        }
        for scene in SCENES
        for views in (6, 25)
        for steps in (150, 500, 1000)
    ]


def pilots() -> list[dict[str, Any]]:
    common = {"views": 6, "spp": 16, "noise": 0.01, "steps": [100, 300], "base": 28.0}
    return [
        common | {"scene": scene, "psnr": [28.0 + gain(scene, 6, steps) for steps in (100, 300)]} for scene in SCENES
    ]


def test_cells_of_the_formula_are_fitted_and_a_scene_left_out_has_no_say() -> None:
    prior = fit_prior(cells(), "here", 0.5)
    assert prior.scenes == sorted(SCENES)
    assert prior.gain_mean == pytest.approx(3.75, abs=1.0)
    off = [
        Quality(prior, 28.0, scene_gain(prior, []), reference=0.005)
        .predict(cell["views"], cell["steps"], cell["noise"])
        .expected
        - cell["psnr"]
        for cell in cells()
    ]
    assert abs(sum(off) / len(off)) < 0.5
    changed = [cell | {"psnr": cell["psnr"] + 5.0 * (cell["scene"] == "slow")} for cell in cells()]
    assert without(changed, "slow", "here").model_dump() == without(cells(), "slow", "here").model_dump()
    assert fit_prior(changed, "here", 0.5).gain_mean > prior.gain_mean + 0.5


def test_collected_pilots_predict_scenes_that_the_fit_has_not_seen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, out = tmp_path / "old.json", tmp_path / "new.json", tmp_path / "all.json"
    wrong = [cell | {"psnr": 0.0} for cell in cells()]
    first.write_text(json.dumps({"cells": wrong, "pilots": []}))
    second.write_text(json.dumps({"cells": cells(), "pilots": pilots()}))
    collect([first, second], [], out)
    assert json.loads(out.read_text())["cells"] == cells()  # what was measured again replaces what was
    fit(out, tmp_path / "prior.json")
    said = capsys.readouterr().out
    median = float(said.split("median |error| ")[1].split()[0])
    assert median < 0.4
    prior = Prior.model_validate_json((tmp_path / "prior.json").read_text())
    assert 0.4 <= prior.sd < 0.8


def test_equal_time_is_summed_by_share_and_lateness_is_told() -> None:
    def row(side: str, share: float, total: float, psnr: float) -> dict[str, Any]:
        stages = {"select": 2.0, "raytrace": 8.0, "finetune": total - 10.0}
        spread = {"expected": 31.0, "low": 30.0, "high": 32.0}
        return {
            "scene": "quick",
            "share": share,
            "side": side,
            "seconds": 40.0 * share,
            "choice": {"views": 25, "spp": 16, "steps": 500, "epochs": 20},
            "predicted": {**stages, "total": {"expected": total, "low": 1.0, "high": 99.0}, "psnr": spread},
            "actual": {**stages, "total": 1.2 * total, "psnr": psnr},
        }

    rows = [row("preset", 0.5, 20.0, 30.0), row("plan", 0.5, 20.0, 31.5), row("preset", 1.0, 40.0, 31.0)]
    text = markdown({"rows": rows})
    assert "| +1.50 |" in text
    assert "In 0.5 of that time: +1.50 dB on average over 1 scenes." in text
    assert "total 17 %" in text  # predicted over actual: 1 / 1.2
    assert "120 to 120 %" in text and "0 of 1 stayed below 110 %" in text
    assert "3 of 3 inside" in text
