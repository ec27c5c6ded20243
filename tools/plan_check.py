"""How far off `dnrpipe plan` is: its predictions against what `dnrpipe frontier` measured in the same workspace.

    dnrpipe plan -w scene.dnr && dnrpipe frontier -w scene.dnr
    python -m tools.plan_check scene.dnr ... --out docs/results/plan-check.json

Seconds are processor seconds of a stage, which other work on the machine does not stretch. The PSNR is predicted with
the prior refitted without the scene (``tools.plan_prior``), so that it has not seen what it predicts.

Whether to train at all is asked for each scene at the PSNR of its best measured neural point; the corrector as it is
shipped, which no frontier measures, is left out. What each route really
costs is read off the frontier: path tracing on its measured baselines, the base image where it is good enough, the
cheapest measured neural point that is. The answer counts as right where the route it names costs at most 15 % more
than the cheapest.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path
from typing import Any

from tools.plan_equal import predictor_in
from tools.plan_prior import read_cells, without

from dnrpipe.core.errors import UserError
from dnrpipe.studies.cells.results import made_by
from dnrpipe.studies.frames.pareto_front import crossover, frontier
from dnrpipe.studies.frontier.records import FrontierResults, Point, read_frontier
from dnrpipe.studies.planning.choose import VIEWS, Predictor
from dnrpipe.studies.planning.records import Choice, Interval, Route
from dnrpipe.studies.planning.routes import BASE_ALONE, PATH_TRACING, TRAINED, as_reported, routes
from dnrtrain.atomic import write_json

FRAMES = (200, 2000)
NEAR = 1.15


def opened(root: Path, scene: str, cells: Path) -> tuple[FrontierResults, Predictor]:
    """(what the frontier measured, what the plan predicts with).

    Raises UserError: no pilot, or no frontier.
    """
    results = read_frontier(root / "frontier" / "results.json")
    return results, predictor_in(root, without(read_cells(cells), scene, str(cells)))


def check(scene: str, results: FrontierResults, predictor: Predictor) -> list[dict[str, Any]]:
    """A row per point of the frontier: predicted and actual."""
    cores, threads = results.cores, results.threads
    rows = []
    for point in results.points:
        if point.kind != "ours":
            continue
        assert point.spp is not None and point.steps is not None  # it was trained
        choice = predictor.choice(point.views, point.spp, point.steps)
        traced = predictor.processor.raytrace(choice.views, choice.spp) - predictor.processor.light()
        trained = predictor.processor.finetune(choice.steps, choice.epochs)
        parts = point.parts
        actual = (cores * (parts["tracing"] + parts["base images"]), threads * parts["training"])
        psnr = predictor.predict(choice).psnr
        rows.append(
            {
                "scene": scene,
                "name": point.name,
                "tracing": [round(traced, 2), round(actual[0], 2)],
                "training": [round(trained, 2), round(actual[1], 2)],
                "total": [round(traced + trained, 2), round(sum(actual), 2)],
                "psnr": [round(psnr.expected, 2), round(point.psnr, 2)],
                "inside": psnr.low <= point.psnr <= psnr.high,
            }
        )
    return rows


def routes_of(scene: str, results: FrontierResults, predictor: Predictor) -> list[dict[str, Any]]:
    """Per number of frames: which route the plan names, which is the cheapest, and what each really costs, seconds."""
    neural = [point for point in results.points if point.kind == "ours"]
    wanted = max(point.psnr for point in neural)
    found = []
    for frames in FRAMES:
        expected = _expected(predictor, results, wanted, frames)
        actual = _actual(results, neural, wanted, frames)
        named, best = expected[0].name, min(actual, key=lambda name: actual[name])
        found.append(
            {
                "scene": scene,
                "frames": frames,
                "psnr": round(wanted, 2),
                "named": named,
                "cheapest": best,
                "expected": {route.name: round(route.total, 1) for route in expected if route.reaches},
                "actual": {name: round(seconds, 1) for name, seconds in actual.items()},
                "right": named in actual and actual[named] <= NEAR * actual[best],
            }
        )
    return found


def clocked(predictor: Predictor, results: FrontierResults, choice: Choice) -> float:
    """Predicted seconds by the frontier's clock: processor seconds over the cores and over training's threads."""
    costs = predictor.processor
    return (
        costs.raytrace(choice.views, choice.spp) / results.cores
        + costs.finetune(choice.steps, choice.epochs) / results.threads
    )


def _light(results: FrontierResults) -> float:
    """Seconds of the baked light, which the pilot has baked: known to it, and counted on both sides."""
    return next(point for point in results.points if point.kind == "base").parts["light"]


def _expected(predictor: Predictor, results: FrontierResults, wanted: float, frames: int) -> list[Route]:
    """The plan's routes by the frontier's clock."""
    light = _light(results)
    enough = [p for p in predictor.grid(max(VIEWS)) if p.psnr.expected >= wanted]
    neural = min(enough, key=lambda p: clocked(predictor, results, p.choice)) if enough else None
    if neural is not None:
        seconds = clocked(predictor, results, neural.choice) + light
        clock = neural.seconds.model_copy(update={"total": Interval(expected=seconds, low=seconds, high=seconds)})
        neural = neural.model_copy(update={"seconds": clock})
    width, height = predictor.pilot.size
    scale = predictor.wall.work.pixels / (width * height)
    assert predictor.pilot.frames is not None  # make_predictor asked for it
    part = as_reported(predictor.pilot.frames, predictor.quality.reference)
    part = part.model_copy(update={"shipped": None})  # no frontier measures the corrector as it is shipped
    return routes(part, neural, light, light, scale, wanted, frames)


def _actual(results: FrontierResults, neural: list[Point], wanted: float, frames: int) -> dict[str, float]:
    """Seconds of each route that reaches ``wanted``, without the candidates' passes, which the plan takes as given."""

    def total(point: Point) -> float:
        return point.upfront - point.parts["passes"] + frames * point.frame_ms / 1000

    found = {TRAINED: min(total(point) for point in neural if point.psnr >= wanted)}
    points = {one.name: (one.ms, one.psnr) for one in results.baselines}
    ms = crossover([points[name] for name in frontier(points)], wanted)
    if ms is not None:
        found[PATH_TRACING] = frames * ms / 1000
    base = next(point for point in results.points if point.kind == "base")
    if base.psnr >= wanted:
        found[BASE_ALONE] = total(base)
    return found


def markdown(record: dict[str, Any]) -> str:
    """Predicted and actual PSNR of the points that all scenes have, how far off the seconds are; medians below."""
    rows = record["rows"]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    points = [
        name
        for name in dict.fromkeys(row["name"] for row in rows)
        if {row["scene"] for row in rows if row["name"] == name} == set(scenes)
    ]
    lines = [
        f"| scene | tracing | training | {' | '.join(points)} |",
        "|" + "---|" * (3 + len(points)),
    ]
    for scene in scenes:
        own = {row["name"]: row for row in rows if row["scene"] == scene}
        seconds = [f"{100 * (_ratio(list(own.values()), name) - 1):+.0f} %" for name in ("tracing", "training")]
        psnr = ["{:.1f} / {:.1f}".format(*own[name]["psnr"]) for name in points]
        lines.append(f"| {scene} | {' | '.join([*seconds, *psnr])} |")
    off = {
        name: statistics.median(abs(r[name][0] / r[name][1] - 1) for r in rows)
        for name in ("tracing", "training", "total")
    }
    lost = statistics.median(abs(r["psnr"][0] - r["psnr"][1]) for r in rows)
    inside = sum(r["inside"] for r in rows)
    lines += [
        "",
        f"Median error: tracing {100 * off['tracing']:.0f} %, training {100 * off['training']:.0f} %, both together"
        f" {100 * off['total']:.0f} %; PSNR {lost:.2f} dB, {inside} of {len(rows)} inside their interval.",
    ]
    if record.get("routes"):
        lines += ["", *_routes_table(record["routes"])]
    return "\n".join(lines)


def _ratio(rows: list[dict[str, Any]], name: str) -> float:
    return statistics.median(row[name][0] / row[name][1] for row in rows)


def _routes_table(found: list[dict[str, Any]]) -> list[str]:
    names = {PATH_TRACING: "path tracing", BASE_ALONE: "base image", TRAINED: "neural"}
    lines = [
        "| scene | frames | dB wanted | plan names | cheapest | right | expected, s | measured, s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in found:
        cells = [
            ", ".join(f"{names[name]} {seconds:.0f}" for name, seconds in one[key].items())
            for key in ("expected", "actual")
        ]
        lines.append(
            f"| {one['scene']} | {one['frames']} | {one['psnr']:.1f} | {names[one['named']]} |"
            f" {names[one['cheapest']]} | {'yes' if one['right'] else 'no'} | {' | '.join(cells)} |"
        )
    right = sum(one["right"] for one in found)
    return [*lines, "", f"Right in {right} of {len(found)} cases."]


def main() -> int:
    """Exit code 2 where a workspace cannot be checked."""
    parser = argparse.ArgumentParser(prog="python -m tools.plan_check", description=__doc__)
    parser.add_argument("workspaces", nargs="+", metavar="[SCENE=]WORKSPACE", help="with plan/ and frontier/")
    parser.add_argument("--cells", type=Path, default=Path("docs/results/plan-prior.json"))
    parser.add_argument("--out", type=Path, help="JSON of all rows")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    asked: list[dict[str, Any]] = []
    try:
        for text in options.workspaces:
            scene, _, root = text.rpartition("=")
            path = Path(root)
            name = scene or path.name.removesuffix(".dnr")
            results, predictor = opened(path, name, options.cells)
            rows += check(name, results, predictor)
            asked += routes_of(name, results, predictor)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    record = {
        **made_by(),
        "command": "python -m tools.plan_check " + " ".join(sys.argv[1:]),
        "rows": rows,
        "routes": asked,
    }
    if options.out:
        write_json(options.out, record)
    print(markdown(record))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
