"""What `dnrpipe plan` knows before its pilot: shared parameters, fitted to what was measured on the benchmark scenes.

    python -m tools.plan_prior collect .cache/plan/*.dnr/frontier/results.json docs/results/ablation-core.json ...
    python -m tools.plan_prior fit     # -> pipeline/dnrpipe/studies/planning/prior.json

``collect`` gathers cells (views, samples, steps, PSNR, PSNR of the base image, noise of training pictures and of
references) of `dnrpipe frontier`, of `dnrpipe ablate`, and of its own older output; and the pilots beside frontiers.
``fit`` reads that, fits `dnrpipe.studies.planning.quality`, leaves every scene that has a pilot out in turn, predicts
its frontier (the same test views) from that pilot, and prints how far off that is.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dnrpipe.core.workspace import Workspace
from dnrpipe.studies.planning.pilot import read_pilot
from dnrpipe.studies.planning.quality import Prior, Quality, load_prior, measured_gains, scene_gain, without_noise
from dnrpipe.studies.planning.seconds import noise_at
from dnrtrain.atomic import write_json
from dnrtrain.exr import read_metadata

NEURAL_KINDS = ("ours", "random", "all")
"""Points of a frontier that are the default model, however their views were chosen."""
ABLATION_SPP = 128
"""Samples of training views in `dnrpipe ablate`, preset draft."""
CELL = ("scene", "source", "seed", "views", "spp", "steps")
"""What tells one cell from another."""


def collect(sources: list[Path], workspaces: list[Path], out: Path) -> None:
    """Cells of all sources in one file, later ones in place of earlier ones.

    workspaces: folders of the ablation's, whose files tell the noise.
    """
    cells: list[dict[str, Any]] = []
    pilots: list[dict[str, Any]] = []
    for source in sources:
        results = _read(source)
        if "points" in results:
            cells += _of_frontier(source, results)
            pilots += _pilot(source.resolve().parent.parent, results["scene"])
        elif all("noise" in cell for cell in results["cells"]):
            cells += results["cells"]
            pilots += results.get("pilots", [])
        else:
            cells += _of_ablation(source, results, workspaces)
    cells, pilots = _latest(cells, CELL), _latest(pilots, ("scene",))
    write_json(
        out, {"command": "python -m tools.plan_prior " + " ".join(sys.argv[1:]), "cells": cells, "pilots": pilots}
    )
    print(f"{len(cells)} cells of {len({cell['scene'] for cell in cells})} scenes, {len(pilots)} pilots: {out}")


def _latest(found: list[dict[str, Any]], names: Sequence[str]) -> list[dict[str, Any]]:
    """The last of those that agree in ``names``: what was measured again replaces what was."""
    return list({tuple(one[name] for name in names): one for one in found}.values())


def _of_frontier(source: Path, results: dict[str, Any]) -> list[dict[str, Any]]:
    root = source.resolve().parent.parent
    base = next(point["psnr"] for point in results["points"] if point["kind"] == "base")
    reference = _noise([root], results["evaluation_spp"], "test") or 0.0
    found = []
    for point in results["points"]:
        if point["kind"] in NEURAL_KINDS and (noise := _noise([root], point["spp"])) is not None:
            found.append(_cell(point, results["scene"], point["spp"], noise, base, "frontier", reference))
    return found


def _pilot(root: Path, scene: str) -> list[dict[str, Any]]:
    """What the workspace's pilot measured of quality."""
    pilot = read_pilot(Workspace.open(root))
    if pilot is None or pilot.frames is None or pilot.training is None or pilot.trace is None:
        return []
    training, frames = pilot.training, pilot.frames
    return [
        {
            "scene": scene,
            "views": training.views,
            "spp": training.spp,
            "noise": round(noise_at(pilot.trace, training.spp), 5),
            "steps": training.steps,
            "psnr": [point.psnr for point in frames.neural],
            "base": frames.base.psnr,
        }
    ]


def _of_ablation(source: Path, results: dict[str, Any], workspaces: list[Path]) -> list[dict[str, Any]]:
    bases = {cell["scene"]: cell["psnr"] for cell in results["cells"] if cell["row"] == "base"}
    found = []
    for cell in results["cells"]:
        if cell["row"] not in ("dnr", "all-views") or cell["scene"] not in bases:
            continue
        noise = _noise([folder / f"{cell['scene']}.dnr" for folder in workspaces], ABLATION_SPP)
        if noise is not None:
            reference = 10 ** (-cell["ceiling"] / 20) if cell.get("ceiling") else 0.0
            base = bases[cell["scene"]]
            found.append(_cell(cell, cell["scene"], ABLATION_SPP, noise, base, source.name, reference))
    return found


def _cell(
    measured: dict[str, Any], scene: str, spp: int, noise: float, base: float, source: str, reference: float
) -> dict[str, Any]:
    kept = {name: measured[name] for name in ("seed", "views", "steps", "psnr")}
    noises = {"noise": round(noise, 5), "reference": round(reference, 5)}
    return {"scene": scene, **kept, "spp": spp, **noises, "base": base, "source": source}


def _noise(roots: Sequence[Path], spp: int, kind: str = "train") -> float | None:
    """RMSE of the pictures of a kind at ``spp``, by their files in the first workspace that has some."""
    for root in roots:
        for split in (f"{kind}-{spp}spp", kind):
            files = sorted((root / "raytraced" / split).glob("*.exr"))
            known = [m for f in files if (m := read_metadata(f)) and m.get("spp") == spp and m.get("noise_rmse")]
            if known:
                return float(np.sqrt(np.mean([m["noise_rmse"] ** 2 for m in known])))
    return None


START = {"a": 0.15, "alpha": 0.7, "b": 0.12, "beta": 0.8, "kappa": 0.3, "gamma": 0.5, "delta": 0.5}
"""Where the fit starts, and what it is drawn to by as much as a cell that is WEIGHT times off."""
WEIGHT = 0.2
OWN = 0.36
"""A scene's log b is drawn to the median by so much: (0.3 dB of a cell / a spread of 0.5)²."""
LEAST_B_SPREAD = 0.25
LEAST_SPREAD = 0.4
"""dB: no prediction is called surer than this; two seeds of one cell differ by up to 0.3."""
PILOT_SD = 0.4
"""dB: of a pilot's gain, likewise."""


def fit_prior(cells: list[dict[str, Any]], source: str, sd: float) -> Prior:
    """Least squares over all cells, with the best G of each scene and source and the best b of each scene."""
    groups = sorted({(cell["scene"], cell["source"]) for cell in cells})
    scenes = sorted({cell["scene"] for cell in cells})
    of_group = torch.tensor([groups.index((cell["scene"], cell["source"])) for cell in cells])
    of_scene = torch.tensor([scenes.index(cell["scene"]) for cell in cells])
    views, steps, noise, reference, truth = (
        torch.tensor([float(cell[name]) for cell in cells]) for name in ("views", "steps", "noise", "reference", "psnr")
    )
    base = torch.tensor([without_noise(cell["base"], cell["reference"]) for cell in cells])
    start = torch.tensor(list(START.values())).log()
    logs, gains = start.clone().requires_grad_(), torch.full((len(groups),), 3.0, requires_grad=True)
    own = torch.zeros(len(scenes), requires_grad=True)
    optimiser = torch.optim.LBFGS([logs, gains, own], max_iter=1000, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        a, alpha, b, beta, kappa, gamma, delta = logs.exp()
        part = 1 - a * (25 / views) ** alpha - b * own[of_scene].exp() * (500 / steps) ** beta
        clean = 10 ** (-(base + gains[of_group] * part) / 10)
        learned = kappa * (25 / views) ** delta * (steps / 500) ** gamma * noise**2
        error = -10 * torch.log10(clean + learned + reference**2) - truth
        total = error.square().sum() + OWN * own.square().sum() + WEIGHT * (logs - start).square().sum()
        total.backward()
        return total

    optimiser.step(loss)
    known = dict(zip(START, (round(value, 4) for value in logs.detach().exp().tolist()), strict=True))
    by_scene = {scene: [] for scene in scenes}
    for (scene, _), gain in zip(groups, gains.detach().tolist(), strict=True):
        by_scene[scene].append(gain)
    means = [float(np.mean(values)) for values in by_scene.values()]
    several = [i for i, s in enumerate(scenes) if len({c["steps"] for c in cells if c["scene"] == s}) > 2]
    spread = float(own.detach()[several].std()) if len(several) > 2 else 0.0
    return Prior(
        **known,
        b_spread=round(max(LEAST_B_SPREAD, spread), 3),
        gain_mean=round(float(np.mean(means)), 3),
        gain_sd=round(float(np.std(means, ddof=1)) if len(means) > 1 else 2.0, 3),
        pilot_sd=PILOT_SD,
        sd=sd,
        scenes=scenes,
        source=source,
    )


def fit(path: Path, out: Path) -> None:
    """Fit, leave every scene out that has a pilot, print, write ``out``."""
    found = _read(path)
    cells, pilots = found["cells"], found["pilots"]
    errors: list[float] = []
    print(f"{'scene left out':<16}{'predicted from its pilot, minus measured, dB':>60}")
    for pilot in pilots:
        own = [cell for cell in cells if (cell["scene"], cell["source"]) == (pilot["scene"], "frontier")]
        prior = fit_prior(but(cells + cells_of(pilots), pilot["scene"]), str(path), LEAST_SPREAD)
        networks = zip(pilot["steps"], pilot["psnr"], strict=True)
        gain = scene_gain(prior, measured_gains(prior, pilot["base"], pilot["views"], pilot["noise"], networks))
        off = [
            Quality(prior, pilot["base"], gain, reference=cell["reference"])
            .predict(cell["views"], cell["steps"], cell["noise"])
            .expected
            - cell["psnr"]
            for cell in own
        ]
        errors += off
        print(f"{pilot['scene']:<16}{', '.join(f'{value:+.2f}' for value in off):>60}")
    spread = float(np.sqrt(np.mean(np.square(errors)))) if errors else 1.0
    prior = fit_prior(cells + cells_of(pilots), str(path), round(max(LEAST_SPREAD, spread), 3))
    write_json(out, prior.model_dump(mode="json"))
    if errors:
        print(f"median |error| {np.median(np.abs(errors)):.2f} dB, root mean square {spread:.2f} dB; {out}")


def cells_of(pilots: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The networks of the pilots as cells: few steps, and judged without the noise of any reference."""
    return [
        {
            **{name: pilot[name] for name in ("scene", "views", "spp", "noise", "base")},
            "source": "pilot",
            "seed": 0,
            "steps": steps,
            "psnr": psnr,
            "reference": 0.0,
        }
        for pilot in pilots
        for steps, psnr in zip(pilot["steps"], pilot["psnr"], strict=True)
    ]


def but(cells: list[dict[str, Any]], scene: str) -> list[dict[str, Any]]:
    """The cells of all other scenes."""
    return [cell for cell in cells if cell["scene"] != scene]


def read_cells(path: Path) -> list[dict[str, Any]]:
    """Cells that ``collect`` wrote, those of pilots included."""
    found = _read(path)
    return found["cells"] + cells_of(found["pilots"])


def without(cells: list[dict[str, Any]], scene: str, source: str) -> Prior:
    """The prior of all scenes but one, as sure of itself as the one that comes with the package."""
    return fit_prior(but(cells, scene), source, load_prior().sd)


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def main() -> int:
    """The verbs of the module's docstring."""
    parser = argparse.ArgumentParser(prog="python -m tools.plan_prior", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    second = verbs.add_parser("collect")
    second.add_argument("sources", nargs="+", type=Path, help="results files")
    second.add_argument("--workspaces", nargs="*", type=Path, default=[], help="folders of the ablation's workspaces")
    second.add_argument("--out", type=Path, default=Path("docs/results/plan-prior.json"))
    third = verbs.add_parser("fit")
    third.add_argument("cells", type=Path, nargs="?", default=Path("docs/results/plan-prior.json"))
    third.add_argument("--out", type=Path, default=Path("pipeline/dnrpipe/studies/planning/prior.json"))
    options = parser.parse_args()
    if options.verb == "collect":
        collect(options.sources, options.workspaces, options.out)
    else:
        fit(options.cells, options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
