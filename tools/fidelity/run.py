"""Render what is missing and measure: references by Cycles, conversions, traces, other exporters' formulas.

Everything is cached by content. A reference is made again when its builder changes, a conversion when
``dnrpipe/blender`` changes, a trace when the bundle that came out differs or ``dnrpipe/raytrace`` changes.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dnrpipe.core.console import Console
from dnrpipe.core.images import read_rgba
from dnrpipe.raytrace.variants import choose_variant
from dnrpipe.workers.task_list import run_tasks
from dnrtrain.atomic import write_json

from . import ours, reference_settings
from .catalogue import Case
from .formulas import write_variant
from .measure import Measured, claim_of, compare

SEEDS = 2
REFERENCE_TIMEOUT = 1800.0


@dataclass(frozen=True)
class Plan:
    """Where things go and how many samples each of the two seeds takes."""

    cache: Path
    cycles_spp: int
    ours_spp: int
    jobs: int = 1

    def reference(self, case: Case) -> Path:
        """Folder of one scene's .blend and Cycles pictures."""
        content = [case.source, reference_settings.BOUNCES, self.samples(case, self.cycles_spp)]
        return self.cache / "cycles" / f"{case.name}-{_digest(content)}"

    @staticmethod
    def samples(case: Case, spp: int) -> int:
        return max(2, round(spp * case.samples))


def make_references(cases: Sequence[Case], plan: Plan, console: Console) -> dict[str, str]:
    """Build and render what is missing; returns {case name: error} of those that failed."""
    tasks = []
    for case in cases:
        folder = plan.reference(case)
        outputs = [folder / f"{seed}.exr" for seed in range(SEEDS)]
        if not all(path.is_file() for path in outputs):
            tasks.append(
                {
                    "case": case.name,
                    "blend": str(folder / f"{case.name}.blend"),
                    "outputs": [str(path) for path in outputs],
                    "spp": plan.samples(case, plan.cycles_spp),
                }
            )
    failed: dict[str, str] = {}
    if not tasks:
        return failed
    log = plan.cache / "cycles.log"
    with console.bar("Cycles", len(cases), len(cases) - len(tasks)) as bar:
        for outcome in run_tasks(
            "tools.fidelity.reference", {}, tasks, workers=plan.jobs, log=log, timeout=REFERENCE_TIMEOUT
        ):
            if outcome.result is None:
                failed[outcome.task["case"]] = f"Cycles: {outcome.error}"
                console.warn(f"{outcome.task['case']}: {outcome.error}")
            bar.advance(note=outcome.task["case"])
    return failed


def run_cases(cases: Sequence[Case], plan: Plan, console: Console) -> list[dict[str, Any]]:
    """The record of every case (see `measure_case`), in order; also kept as results/<name>.json."""
    failed = make_references(cases, plan, console)
    choose_variant("auto")  # probed once, before threads ask for it
    records: dict[str, dict[str, Any]] = {}
    with ThreadPoolExecutor(plan.jobs) as pool, console.bar("ours", len(cases)) as bar:
        todo = {pool.submit(measure_case, case, plan, failed.get(case.name)): case for case in cases}
        for future in as_completed(todo):
            case, record = todo[future], future.result()
            records[case.name] = record
            write_json(plan.cache / "results" / f"{case.name}.json", record)
            bar.advance(note=case.name)
            console.say(summary_line(record))
    return [records[case.name] for case in cases]


def measure_case(case: Case, plan: Plan, broken: str | None) -> dict[str, Any]:
    """Convert, trace and compare one scene.

    Returns {"name", "title", "group", "error" (None when it worked), "claim", "findings", "measured", "pictures"
    (Cycles' and ours' files), "formulas": {name: measured or None where the formula changes nothing}}.
    """
    record: dict[str, Any] = {"name": case.name, "title": case.title, "group": case.group, "error": broken}
    if broken:
        return record
    folder = plan.reference(case)
    expected = [read_rgba(folder / f"{seed}.exr") for seed in range(SEEDS)]
    try:
        workspace = _conversion(case, folder, plan)
        pictures = _traces(case, plan, workspace.scene / "scene.xml", workspace)
        found = ours.findings(workspace)
        record |= {
            "claim": claim_of(found),
            "findings": found,
            "measured": asdict(_compare(expected, pictures)),
            "pictures": {
                "cycles": [str(folder / f"{seed}.exr") for seed in range(SEEDS)],
                "ours": [str(path) for path in pictures],
            },
            "formulas": {},
        }
        for name in case.formulas:
            variant = write_variant(workspace.scene / "scene.xml", name)
            traced = None if variant is None else _compare(expected, _traces(case, plan, variant, workspace))
            record["formulas"][name] = None if traced is None else asdict(traced)
    except ours.FidelityError as error:
        record["error"] = str(error)
    return record


def load_records(cases: Sequence[Case], cache: Path) -> Iterator[dict[str, Any]]:
    """The kept records of those cases that were ever measured."""
    for case in cases:
        path = cache / "results" / f"{case.name}.json"
        if path.is_file():
            yield {**json.loads(path.read_text()), "title": case.title, "group": case.group}


def summary_line(record: dict[str, Any]) -> str:
    """One line for the terminal."""
    if record["error"]:
        return f"{record['name']:24} FAILED: {record['error']}"
    m = Measured(**record["measured"])
    return (
        f"{record['name']:24} {record['claim']:12} rmse {m.rmse:7.4f}  psnr {m.psnr:5.1f} (floor {m.floor:5.1f})"
        f"  flip {m.flip:.4f}  energy {m.energy:.4f} ± {m.energy_error:.4f}"
    )


def _conversion(case: Case, folder: Path, plan: Plan) -> Any:
    key = f"{folder.name}-{ours.code_hash(ours.CONVERSION)}"
    root = plan.cache / "converted" / f"{key}.dnr"
    if (root / "scene" / "prepared.json").is_file():
        return ours.Workspace.open(root)
    for old in root.parent.glob(f"{case.name}-*.dnr"):  # a bundle with baked textures is some megabytes
        shutil.rmtree(old, ignore_errors=True)
    return ours.convert(folder / f"{case.name}.blend", root)


def _traces(case: Case, plan: Plan, bundle: Path, workspace: Any) -> list[Path]:
    spp = plan.samples(case, plan.ours_spp)
    content = [ours.bundle_hash(bundle), ours.tracing_hash(bundle), spp, case.size, reference_settings.PATH_DEPTH]
    folder = plan.cache / "traced" / f"{case.name}-{_digest(content)}"
    outputs = [folder / f"{seed}.exr" for seed in range(SEEDS)]
    if not all(path.is_file() for path in outputs):
        ours.trace(workspace, outputs, size=case.size, spp=spp, bundle=bundle)
    return outputs


def _compare(expected: Sequence[Any], outputs: Sequence[Path]) -> Measured:
    return compare(expected, [read_rgba(path) for path in outputs])


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]
