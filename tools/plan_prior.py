"""What `dnrpipe plan` knows before its pilot: shared parameters, fitted to what was measured on the benchmark scenes.

    python -m tools.plan_prior collect .cache/plan/*.dnr/frontier/results.json docs/results/ablation-core.json ...
    python -m tools.plan_prior fit                                       # -> pipeline/dnrpipe/planning/prior.json

``collect`` gathers cells (views, samples, steps, PSNR, PSNR of the base image, noise of the training pictures) of
`dnrpipe frontier`, of `dnrpipe ablate`, and of its own older output in docs/results/plan-prior.json. ``fit`` reads
that, fits :mod:`dnrpipe.planning.quality`, leaves every scene out in turn, and prints how far off it is then.
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

from dnrpipe.planning.quality import LEAST_SHARE, Prior, load_prior, predict, scene_gain, share
from dnrtrain.atomic import write_json
from dnrtrain.exr import read_metadata

NEURAL_KINDS = ("ours", "random", "all")
"""Points of a frontier that are the default model, however their views were chosen."""
ABLATION_SPP = 128
"""Samples of training views in `dnrpipe ablate`, preset draft."""


def collect(sources: list[Path], workspaces: list[Path], out: Path) -> None:
    """Cells of all sources in one file. workspaces: folders of the ablation's, whose files tell the noise."""
    found: list[dict[str, Any]] = []
    for source in sources:
        results = _read(source)
        if "points" in results:
            found += _of_frontier(source, results)
        elif all("noise" in cell for cell in results["cells"]):
            found += results["cells"]
        else:
            found += _of_ablation(source, results, workspaces)
    write_json(out, {"command": "python -m tools.plan_prior " + " ".join(sys.argv[1:]), "cells": found})
    print(f"{len(found)} cells of {len({cell['scene'] for cell in found})} scenes: {out}")


def _of_frontier(source: Path, results: dict[str, Any]) -> list[dict[str, Any]]:
    root = source.resolve().parent.parent
    base = next(point["psnr"] for point in results["points"] if point["kind"] == "base")
    found = []
    for point in results["points"]:
        if point["kind"] in NEURAL_KINDS and (noise := _noise([root], point["spp"])) is not None:
            found.append(_cell(point, results["scene"], point["spp"], noise, base, "frontier"))
    return found


def _of_ablation(source: Path, results: dict[str, Any], workspaces: list[Path]) -> list[dict[str, Any]]:
    bases = {cell["scene"]: cell["psnr"] for cell in results["cells"] if cell["row"] == "base"}
    found = []
    for cell in results["cells"]:
        if cell["row"] not in ("dnr", "all-views") or cell["scene"] not in bases:
            continue
        noise = _noise([folder / f"{cell['scene']}.dnr" for folder in workspaces], ABLATION_SPP)
        if noise is not None:
            found.append(_cell(cell, cell["scene"], ABLATION_SPP, noise, bases[cell["scene"]], source.name))
    return found


def _cell(measured: dict[str, Any], scene: str, spp: int, noise: float, base: float, source: str) -> dict[str, Any]:
    kept = {name: measured[name] for name in ("seed", "views", "steps", "psnr")}
    return {"scene": scene, **kept, "spp": spp, "noise": round(noise, 5), "base": base, "source": source}


def _noise(roots: Sequence[Path], spp: int) -> float | None:
    """RMSE of training pictures at ``spp``, by their files in the first workspace that has some."""
    for root in roots:
        for split in (f"train-{spp}spp", "train"):
            files = sorted((root / "raytraced" / split).glob("*.exr"))
            known = [m for f in files if (m := read_metadata(f)) and m.get("spp") == spp and m.get("noise_rmse")]
            if known:
                return float(np.sqrt(np.mean([m["noise_rmse"] ** 2 for m in known])))
    return None


START = {"a": 0.15, "alpha": 0.7, "b": 0.12, "beta": 0.8, "kappa": 0.3}
"""Where the fit starts, and what it is drawn to by as much as a cell that is WEIGHT times off."""
WEIGHT = 0.2
PILOT = (6, 16, 200)
"""The pilot's corner of the grid: at most so many views, samples, steps."""
LEAST_SPREAD = 0.4
"""dB: no prediction is called surer than this; two seeds of one cell differ by up to 0.3."""


def shared(cells: list[dict[str, Any]]) -> dict[str, float]:
    """a, alpha, b, beta, kappa: least squares over all cells, with the best G of each scene and source."""
    groups = sorted({(cell["scene"], cell["source"]) for cell in cells})
    place = torch.tensor([groups.index((cell["scene"], cell["source"])) for cell in cells])
    views, steps, noise, base, truth = (
        torch.tensor([float(cell[name]) for cell in cells]) for name in ("views", "steps", "noise", "base", "psnr")
    )
    start = torch.tensor(list(START.values())).log()
    logs, gains = start.clone().requires_grad_(), torch.full((len(groups),), 3.0, requires_grad=True)
    optimiser = torch.optim.LBFGS([logs, gains], max_iter=500, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        a, alpha, b, beta, kappa = logs.exp()
        part = 1 - a * (25 / views) ** alpha - b * (500 / steps) ** beta
        clean = 10 ** (-(base + gains[place] * part) / 10)
        error = -10 * torch.log10(clean + kappa * noise**2) - truth
        total = error.square().sum() + WEIGHT * (logs - start).square().sum()
        total.backward()
        return total

    optimiser.step(loss)
    return dict(zip(START, logs.detach().exp().tolist(), strict=True))


def fit(path: Path, out: Path) -> None:
    """Fit, leave every scene out that has the pilot's corner, print, write ``out``."""
    cells = read_cells(path)
    scenes = sorted({cell["scene"] for cell in cells})
    errors: list[float] = []
    print(f"{'scene left out':<16}{'predicted from its pilot corner, minus measured, dB':>60}")
    for scene in scenes:
        own = [cell for cell in cells if cell["scene"] == scene]
        corner = next(
            (c for c in own if all(c[k] <= m for k, m in zip(("views", "spp", "steps"), PILOT, strict=True))), None
        )
        others = [cell for cell in cells if cell["scene"] != scene]
        if corner is None or not others:
            continue
        prior = _prior(others, scenes, str(path))
        gain = scene_gain(prior, corner["psnr"] - corner["base"], corner["views"], corner["steps"])
        off = [
            predict(prior, cell["base"], gain, cell["views"], cell["steps"], cell["noise"]).expected - cell["psnr"]
            for cell in own
            if cell is not corner
        ]
        errors += off
        print(f"{scene:<16}{', '.join(f'{value:+.2f}' for value in off):>60}")
    prior = _prior(cells, scenes, str(path))
    spread = float(np.sqrt(np.mean(np.square(errors)))) if len(errors) > 1 else 1.0
    prior = prior.model_copy(update={"sd": round(max(LEAST_SPREAD, spread), 3)})
    write_json(out, prior.model_dump(mode="json"))
    print(f"median |error| {np.median(np.abs(errors)):.2f} dB, root mean square {spread:.2f} dB; {out}")


def _prior(cells: list[dict[str, Any]], scenes: list[str], source: str) -> Prior:
    found = {name: round(value, 4) for name, value in shared(cells).items()}
    bare = Prior(**found, gain_mean=0, gain_sd=1, pilot_sd=LEAST_SPREAD, sd=LEAST_SPREAD, scenes=scenes, source=source)
    gains: dict[str, list[float]] = {}
    for cell in cells:
        part = max(share(bare, cell["views"], cell["steps"]), LEAST_SHARE)
        gains.setdefault(cell["scene"], []).append((cell["psnr"] - cell["base"]) / part)
    means = [float(np.mean(values)) for values in gains.values()]
    spread = float(np.std(means, ddof=1)) if len(means) > 1 else 2.0
    return bare.model_copy(update={"gain_mean": round(float(np.mean(means)), 3), "gain_sd": round(spread, 3)})


def read_cells(path: Path) -> list[dict[str, Any]]:
    """Cells that ``collect`` wrote."""
    return _read(path)["cells"]


def without(cells: list[dict[str, Any]], scene: str, source: str) -> Prior:
    """The prior of all scenes but one, as sure of itself as the one that comes with the package."""
    others = [cell for cell in cells if cell["scene"] != scene]
    return _prior(others, sorted({cell["scene"] for cell in others}), source).model_copy(update={"sd": load_prior().sd})


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
    third.add_argument("--out", type=Path, default=Path("pipeline/dnrpipe/planning/prior.json"))
    options = parser.parse_args()
    if options.verb == "collect":
        collect(options.sources, options.workspaces, options.out)
    else:
        fit(options.cells, options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
