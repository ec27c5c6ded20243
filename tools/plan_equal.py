"""What planning buys at equal time: `dnrpipe plan --time T --apply` against the preset's views and samples.

    dnrpipe plan -w scene.dnr                               # the pilot, once
    python -m tools.plan_equal scene.dnr ... --shares 0.5,1 --out docs/results/plan-equal.json

T is a share of the time that the preset's own choice is expected to take. The preset's side keeps its views and
samples. Both take the steps that fit into what ray tracing has left of T, one pass over the views at least; the rows
hold what the pilot predicts for those. Both run on the wall clock, one at a time, in copies of the workspace that hold
the passes, the light that the pilot baked and the test views' references: tracing, base images and training are done
anew. Needs a machine that is otherwise idle. What is in ``--out`` is not run again.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools.plan_prior import read_cells, without

from dnrpipe.core.errors import UserError
from dnrpipe.core.scene_files import read_json, split_views
from dnrpipe.core.workspace import Workspace
from dnrpipe.stages.session import Session, resolve_settings
from dnrpipe.studies.cells.results import made_by
from dnrpipe.studies.planning.carry_out import apply, steps_within
from dnrpipe.studies.planning.choose import Predictor
from dnrpipe.studies.planning.make_plan import make_plan, make_predictor
from dnrpipe.studies.planning.pilot import read_pilot
from dnrpipe.studies.planning.quality import Prior
from dnrpipe.studies.planning.records import Prediction, Wanted
from dnrpipe.studies.planning.seconds import TIME_SPREAD
from dnrtrain.atomic import write_json

KEPT = (
    "scene",
    "passes",
    "cameras",
    "bakes",
    "plan",
    "base/light.npz",
    "manifest.json",
    "dnrpipe.toml",
    "raytraced/test",
)
SIDES = ("preset", "plan")
OPTIONS = {"as_json": False, "quiet": True, "preset": None, "assignments": (), "force": False}


def compare(root: Path, scene: str, share: float, cells: Path, done: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row per side that is not in ``done``. Raises UserError: no pilot."""
    found = []
    for side in SIDES:
        if any((row["scene"], row["share"], row["side"]) == (scene, share, side) for row in done):
            continue
        with tempfile.TemporaryDirectory(prefix="plan-equal-") as folder:
            copy = Path(folder) / root.name
            _copy(root, copy)
            row = _run(copy, scene, share, side, cells)
        found.append(row)
        print(_line(row), flush=True)
    return found


def _copy(root: Path, copy: Path) -> None:
    for name in KEPT:
        source, target = root / name, copy / name
        if source.is_dir():
            shutil.copytree(source, target, copy_function=_link)
        elif source.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)


def _link(source: str, target: str) -> None:
    """Hard links where the file system has them: files are replaced, never written in place."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _run(root: Path, scene: str, share: float, side: str, cells: Path) -> dict[str, Any]:
    prior = without(read_cells(cells), scene, str(cells))
    with Session("plan", OPTIONS | {"workspace": str(root)}, None, {}) as session:
        predictor = predictor_in(root, prior)
        usual = preset_choice(predictor, session)
        seconds = share * usual(None).seconds.total.expected
        plan = make_plan(session.run, Wanted(seconds=seconds), prior)
        if side == "preset":
            plan = plan.model_copy(update={"chosen": usual(seconds)})
        plan = apply(session, plan, prior)
    chosen, actual = plan.carried_out or plan.chosen, plan.actual
    assert chosen is not None and actual is not None  # it was carried out
    return {
        "scene": scene,
        "share": share,
        "side": side,
        "seconds": round(seconds, 1),
        "load": os.getloadavg()[0],
        "choice": chosen.choice.model_dump(),
        "predicted": {
            **chosen.seconds.model_dump(),
            "cpu": chosen.cpu_seconds,
            "psnr": chosen.psnr.model_dump(),
        },
        "actual": {**actual.seconds, "cpu": actual.cpu_seconds, "psnr": actual.psnr},
    }


def predictor_in(root: Path, prior: Prior) -> Predictor:
    """The plan's predictor in a workspace. Raises UserError: no pilot."""
    workspace = Workspace.open(root)
    pilot = read_pilot(workspace)
    if pilot is None:
        raise UserError(f"{root}: has no pilot; run `dnrpipe plan -w {root}`")
    return make_predictor(workspace, resolve_settings(workspace, {}, None), pilot, prior)


def preset_choice(predictor: Predictor, session: Session) -> Callable[[float | None], Prediction]:
    """The preset's views and samples, with its own steps (None) or with as many as fit into so many seconds."""
    settings = session.settings
    views = min(settings.select.most, len(split_views(session.workspace)["train"]))
    per_epoch = -(-views // predictor.batch)

    def of(seconds: float | None) -> Prediction:
        if seconds is None:
            return predictor.predict(
                predictor.choice(views, settings.raytrace.spp, settings.finetune.step2.epochs * per_epoch)
            )
        least = predictor.predict(predictor.choice(views, settings.raytrace.spp, per_epoch))
        return steps_within(predictor, least.choice, seconds - least.seconds.select - least.seconds.raytrace)

    return of


def _write(out: Path, rows: list[dict[str, Any]]) -> None:
    write_json(out, {**made_by(), "command": "python -m tools.plan_equal " + " ".join(sys.argv[1:]), "rows": rows})


def _line(row: dict[str, Any]) -> str:
    choice, actual, expected = row["choice"], row["actual"], row["predicted"]
    return (
        f"{row['scene']} {row['seconds']:.0f} s, {row['side']}: {choice['views']} views, {choice['spp']} spp,"
        f" {choice['steps']} steps; {actual['total']:.1f} s ({expected['total']['expected']:.1f} expected),"
        f" {actual['psnr']:.2f} dB ({expected['psnr']['expected']:.2f} expected)"
    )


def markdown(record: dict[str, Any]) -> str:
    """Both sides in a row; what planning bought; how far off the predictions were."""
    rows = record["rows"]
    pairs: dict[tuple[str, float], dict[str, dict[str, Any]]] = {}
    for row in rows:
        pairs.setdefault((row["scene"], row["share"]), {})[row["side"]] = row
    by_share = sorted(pairs.items(), key=lambda item: item[0][1])
    whole = {key: pair for key, pair in by_share if len(pair) == len(SIDES)}
    lines = [
        "| scene | s | the preset's views and samples | took, s | dB | the plan's choice | took, s | dB | bought |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for (scene, _), pair in whole.items():
        cells = [
            f"{pair[side]['choice']['views']} views, {pair[side]['choice']['spp']} spp, {pair[side]['choice']['steps']}"
            f" steps | {pair[side]['actual']['total']:.0f} | {pair[side]['actual']['psnr']:.2f}"
            for side in SIDES
        ]
        lines.append(f"| {scene} | {pair['plan']['seconds']:.0f} | {' | '.join(cells)} | {_bought(pair):+.2f} |")
    lines.append("")
    for share in sorted({share for _, share in whole}):
        bought = [_bought(pair) for (_, one), pair in whole.items() if one == share]
        what = "the time that the preset's own choice takes" if share == 1 else f"{share:g} of that time"
        lines.append(f"In {what}: {statistics.mean(bought):+.2f} dB on average over {len(bought)} scenes.")
    off = {
        name: statistics.median(abs(_expected(row, name) / row["actual"][name] - 1) for row in rows)
        for name in ("raytrace", "finetune", "total")
    }
    late = [row["actual"]["total"] / row["seconds"] for row in rows if row["side"] == "plan"]
    lost = [abs(row["predicted"]["psnr"]["expected"] - row["actual"]["psnr"]) for row in rows]
    ratios = [row["actual"]["total"] / _expected(row, "total") for row in rows]
    kept = sum(1 / TIME_SPREAD <= ratio <= TIME_SPREAD for ratio in ratios)
    inside = sum(r["predicted"]["psnr"]["low"] <= r["actual"]["psnr"] <= r["predicted"]["psnr"]["high"] for r in rows)
    lines += [
        "",
        f"Wall seconds of all {len(rows)} runs, median error: ray tracing with light and base images"
        f" {100 * off['raytrace']:.0f} %, training {100 * off['finetune']:.0f} %, total {100 * off['total']:.0f} %."
        f" Totals were {min(ratios):.2f} to {max(ratios):.2f} times their forecast, {kept} of {len(rows)} inside the"
        f" printed interval (1/{TIME_SPREAD:g} to {TIME_SPREAD:g}). PSNR: {statistics.median(lost):.2f} dB,"
        f" {inside} of {len(rows)} inside their interval.",
        "",
        f"`--time`: the plan's runs took {100 * min(late):.0f} to {100 * max(late):.0f} % of the time given, median"
        f" {100 * statistics.median(late):.0f} %; {sum(one <= 1.1 for one in late)} of {len(late)} stayed below 110 %.",
    ]
    return "\n".join(lines)


def _bought(pair: dict[str, dict[str, Any]]) -> float:
    return pair["plan"]["actual"]["psnr"] - pair["preset"]["actual"]["psnr"]


def _expected(row: dict[str, Any], name: str) -> float:
    value = row["predicted"][name]
    return value["expected"] if name == "total" else value


def main() -> int:
    """Exit code 2 where a workspace has no pilot."""
    parser = argparse.ArgumentParser(prog="python -m tools.plan_equal", description=__doc__)
    parser.add_argument("workspaces", nargs="+", metavar="[SCENE=]WORKSPACE", help="with plan/pilot.json")
    parser.add_argument("--shares", default="0.5,1", help="of the preset's own time")
    parser.add_argument("--cells", type=Path, default=Path("docs/results/plan-prior.json"))
    parser.add_argument("--out", type=Path, required=True, help="JSON of all rows, added to")
    options = parser.parse_args()
    rows = read_json(options.out)["rows"] if options.out.exists() else []
    try:
        for text in options.workspaces:
            scene, _, root = text.rpartition("=")
            path = Path(root).resolve()
            name = scene or path.name.removesuffix(".dnr")
            for share in options.shares.split(","):
                rows += compare(path, name, float(share), options.cells, rows)
                _write(options.out, rows)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    print(markdown({"rows": rows}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
