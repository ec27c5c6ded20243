"""Faults injected into real runs of the pipeline: what survives, what it costs.

python -m tools.faults.inject [--kills 50] [--seed 0] [--only KIND ...] [--json FILE]

A tiny workspace is made once (a 32² scene, six candidates). Each fault gets a copy with the stages from its own on
undone; the stage is disturbed, run again undisturbed, then the stages after it. It survives when no file was torn,
no traceback was printed, and every pixel, weight and metric equals the undisturbed run's.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from tools.faults.workspaces import contents, finished_units, forget, torn

from dnrtrain.atomic import write_json

REPO = Path(__file__).resolve().parents[2]
SCENE = REPO / "blender_scenes" / "hard" / "emissive_only.blend"
SETTINGS = {
    "CAMERAS__TRAIN": "6",
    "CAMERAS__VAL": "1",
    "CAMERAS__TEST": "2",
    "CAMERAS__WIDTH": "32",
    "CAMERAS__HEIGHT": "32",
    "SELECT__BUDGET": "3",
    "SELECT__STEP1__EPOCHS": "6",
    "FINETUNE__STEP2__EPOCHS": "6",
    "RAYTRACE__SPP": "16",
    "RAYTRACE__EVALUATION_SPP": "16",
    "BASE__LIGHT_SIZE": "64",
    "BASE__LIGHT_SPP": "16",
    "BASE__SAMPLES": "2",
    "PASSES__RASTER": "cycles-direct",
}
COMMANDS = {
    "prepare": "prepare",
    "select": "select",
    "raytrace": "raytrace-selected",
    "finetune": "finetune",
    "evaluate": "evaluate",
}
HANG_SECONDS = 60
"""After which a worker counts as hung here; a healthy task takes a few, a busy machine some more."""
PAGE = 4096
UNSAID = "nothing was said of it"
GONE = "no worker was there to be struck"
CLOCK = """
import os, time
_real, _calls = time.time, [0]
def _jumping():
    _calls[0] += 1
    return _real() + (-86400.0 if _calls[0] % 3 else 7 * 86400.0)
if os.environ.get("FAULT_CLOCK"):
    time.time = _jumping
"""


@dataclass
class Result:
    """One injected fault. lost: finished files that were made again. problems: what went wrong; empty: survived."""

    kind: str
    stage: str
    lost: int = 0
    problems: list[str] = field(default_factory=list)


@dataclass
class Bench:
    """A finished workspace, how its stages are run, and what they must make."""

    workspace: Path
    source: str
    environment: dict[str, str]
    expected: dict[str, object] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def command(self, stage: str, workspace: Path) -> list[str]:
        scene = [self.source] if stage == "prepare" else []
        return [sys.executable, "-m", "dnrpipe.cli", COMMANDS[stage], *scene, "-w", str(workspace), "--quiet"]

    def start(self, stage: str, workspace: Path, **extra: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            self.command(stage, workspace),
            env={**self.environment, **extra},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def finish(self, process: subprocess.Popen[str], result: Result, codes: tuple[int, ...] = (0,)) -> str:
        _, errors = process.communicate(timeout=900)
        if process.returncode not in codes:
            result.problems.append(f"exit code {process.returncode}: {errors.strip()[-200:]}")
        if "Traceback" in errors:
            result.problems.append(f"traceback: {errors.strip()[-200:]}")
        return errors

    def undone(self, folder: Path, stage: str) -> Path:
        """A copy in ``folder`` from before ``stage``."""
        copy = folder / "faulty.dnr"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.workspace, copy)
        names = list(COMMANDS)
        for later in names[names.index(stage) :]:
            forget(copy, later)
        return copy

    def complete(self, workspace: Path, stage: str, result: Result) -> None:
        """Run the stage and all after it, undisturbed; compare with the undisturbed workspace."""
        if result.problems:
            return
        before = finished_units(workspace)
        names = list(COMMANDS)
        for later in names[names.index(stage) :]:
            self.finish(self.start(later, workspace), result)
            if result.problems:
                return
        after = finished_units(workspace)
        result.lost += sum(after.get(path) != made for path, made in before.items())
        if contents(workspace) != self.expected:
            result.problems.append("the results differ from those of an undisturbed run")


def build(folder: Path) -> Bench:
    """Run all stages once."""
    environment = {**os.environ, **{f"DNRPIPE_{key}": value for key, value in SETTINGS.items()}}
    bench = Bench(folder / "whole.dnr", str(SCENE), environment)
    for stage in COMMANDS:
        started = time.monotonic()
        result = Result("none", stage)
        bench.finish(bench.start(stage, bench.workspace), result)
        if result.problems:
            raise SystemExit(f"{stage}: {result.problems[0]}")
        bench.seconds[stage] = time.monotonic() - started
    bench.expected = contents(bench.workspace)
    return bench


def kill(bench: Bench, folder: Path, stage: str, dice: random.Random) -> Result:
    """SIGKILL at a random moment."""
    result = Result("SIGKILL at a random moment", stage)
    copy = bench.undone(folder, stage)
    process = bench.start(stage, copy)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=dice.uniform(0.1, 1.0) * bench.seconds.get(stage, 20.0))
    process.kill()
    process.communicate()
    result.problems += [f"torn: {path}" for path in torn(copy)]
    bench.complete(copy, stage, result)
    return result


def worker_struck(bench: Bench, folder: Path, stage: str, kind: str, strike: Callable[[int], None]) -> Result:
    """Something happens to the first worker process of a stage; the command says so, and its task is done by another.

    strike: called with the worker's number; raises ProcessLookupError where it is gone already.
    """
    result = Result(kind, stage)
    copy = bench.undone(folder, stage)
    process = bench.start(stage, copy, DNRPIPE_TASK_TIMEOUT=f"{HANG_SECONDS}s")
    struck = False
    while process.poll() is None and not struck:
        time.sleep(0.2)
        for child in _workers(process.pid)[:1]:
            with contextlib.suppress(ProcessLookupError):
                strike(child)
                struck = True
    errors = bench.finish(process, result)
    if not struck or "once more" not in errors:
        said = errors.strip()[-200:]
        missed = f"not said: {said}" if said else UNSAID
        result.problems.append(missed if struck else GONE)
    if "SIGSTOP" in kind and struck and "worker hung for" not in errors:
        result.problems.append(f"not called a hang: {errors[-200:]}")
    bench.complete(copy, stage, result)
    return result


def worker_dies(bench: Bench, folder: Path, stage: str, number: signal.Signals) -> Result:
    """A worker process is killed: by SIGSEGV as a bad driver does, by SIGKILL as the kernel does without memory."""
    return worker_struck(bench, folder, stage, f"worker killed by {number.name}", lambda pid: os.kill(pid, number))


def worker_hangs(bench: Bench, folder: Path, stage: str) -> Result:
    """A worker process stops answering, for ever."""
    kind = "worker hangs (SIGSTOP)"
    return worker_struck(bench, folder, stage, kind, lambda pid: os.kill(pid, signal.SIGSTOP))


def worker_starves(bench: Bench, folder: Path, stage: str, dice: random.Random) -> Result:
    """A worker process gets no further memory, from some moment on: whatever it asks for is refused.

    One that asks for none any more, or has ended, is not struck: then a new run is, from its beginning on.
    """

    def starve(wait: float, pid: int) -> None:
        time.sleep(wait)
        resource.prlimit(pid, resource.RLIMIT_AS, (PAGE, PAGE))

    result = Result("worker out of memory (RLIMIT_AS)", stage)
    for wait in (dice.uniform(0.0, 3.0), 0.0):
        result = worker_struck(bench, folder, stage, result.kind, functools.partial(starve, wait))
        if result.problems not in ([UNSAID], [GONE]):
            break
    return result


def _workers(parent: int) -> list[int]:
    """Running worker processes of a command that have begun their task."""
    found = []
    for listing in Path(f"/proc/{parent}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in listing.read_text().split():
                command = Path(f"/proc/{child}/cmdline").read_text()
                if "dnrpipe.workers.processes" in command:
                    found.append(int(child))
    return found


@contextlib.contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[Path]:
    """A file system of that size; raises PermissionError where mounting is not allowed."""
    folder.mkdir(exist_ok=True)
    options = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
    if subprocess.run(options, capture_output=True, check=False).returncode != 0:
        raise PermissionError("mounting a small tmpfs needs root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


def disk_full(bench: Bench, folder: Path, stage: str, dice: random.Random) -> Result:
    """The disk fills up in the middle of the stage; then there is room again."""
    result = Result("disk full", stage)
    prepared = bench.undone(folder, stage)
    used = sum(path.stat().st_size + 4096 for path in prepared.rglob("*") if path.is_file()) // 1024
    with small_disk(folder / "disk", used + 64 + dice.randint(8, 160)) as disk:
        copy = disk / "faulty.dnr"
        shutil.copytree(prepared, copy)
        # Mounted over: what workers write elsewhere is not at stake.
        errors = bench.finish(bench.start(stage, copy), result, (0, 1, 2))
        if not any(word in errors for word in ("disk is full", "No space left")) and not _is_done(copy, stage):
            result.problems.append(f"the full disk was not said: {errors.strip()[-200:]}")
        result.problems += [f"torn: {path}" for path in torn(copy)]
        subprocess.run(["mount", "-o", "remount,size=500m", str(disk)], check=True)
        bench.complete(copy, stage, result)
    return result


def _is_done(workspace: Path, stage: str) -> bool:
    return stage in json.loads((workspace / "manifest.json").read_text())["stages"]


def read_only(bench: Bench, folder: Path, stage: str) -> Result:
    """The disk becomes read-only before the stage; then writable again."""
    result = Result("read-only workspace", stage)
    prepared = bench.undone(folder, stage)
    with small_disk(folder / "disk", 500_000) as disk:
        copy = disk / "faulty.dnr"
        shutil.copytree(prepared, copy)
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        errors = bench.finish(bench.start(stage, copy), result, (2,))
        if "cannot be written" not in errors:
            result.problems.append(f"not said: {errors.strip()[-200:]}")
        subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
        bench.complete(copy, stage, result)
    return result


def clock_jumps(bench: Bench, folder: Path, stage: str) -> Result:
    """time.time() jumps back a day and forward a week, in the command and in its workers."""
    result = Result("clock jumps", stage)
    copy = bench.undone(folder, stage)
    place = folder / "clock"
    place.mkdir(exist_ok=True)
    (place / "sitecustomize.py").write_text(CLOCK)
    path = f"{place}:{bench.environment.get('PYTHONPATH', '')}"
    bench.finish(bench.start(stage, copy, PYTHONPATH=path, FAULT_CLOCK="1"), result)
    bench.complete(copy, stage, result)
    return result


def two_at_once(bench: Bench, folder: Path, stage: str) -> Result:
    """The same command twice: one works, the other says who does and ends with 2 (or comes later and finds it done)."""
    result = Result("two processes at once", stage)
    copy = bench.undone(folder, stage)
    both = [bench.start(stage, copy), bench.start(stage, copy)]
    said = [bench.finish(process, result, (0, 2)) for process in both]
    codes = sorted(process.returncode for process in both)
    if codes == [2, 2] or (codes == [0, 2] and "is working on it" not in "".join(said)):
        result.problems.append(f"exit codes {codes}: {' '.join(said)[-200:]}")
    bench.complete(copy, stage, result)
    return result


def file_damaged(bench: Bench, folder: Path, stage: str, remove: bool, dice: random.Random) -> Result:
    """Between two stages a file of each earlier stage loses its end, or goes."""
    result = Result("file removed" if remove else "file truncated", stage)
    copy = bench.undone(folder, stage)
    files = [p for p in sorted(copy.rglob("[!.]*.exr")) if p.parent.name == "train" and p.stem in _chosen(copy)]
    victim = dice.choice(files)
    if remove:
        victim.unlink()
        owner = {"passes": "prepare", "raytraced": "raytrace", "base": "raytrace"}[victim.parent.parent.name]
        errors = bench.finish(bench.start(stage, copy), result, (2,))
        if COMMANDS[owner] not in errors:
            result.problems.append(f"does not say which command makes it again: {errors.strip()[-200:]}")
        bench.finish(bench.start(owner, copy), result)
    else:
        victim.write_bytes(victim.read_bytes()[: victim.stat().st_size // 2])
        errors = bench.finish(bench.start(stage, copy), result)
        if str(victim) not in errors:
            result.problems.append("the damaged file was not named")
    bench.complete(copy, stage, result)
    return result


def _chosen(workspace: Path) -> set[str]:
    return set(json.loads((workspace / "selection.json").read_text())["views"])


def campaign(kills: int, seed: int) -> dict[str, list[Callable[[Bench, Path], Result]]]:
    """All faults by kind; ``kills`` are spread evenly over the stages."""
    dice = random.Random(seed)
    turns = itertools.cycle(COMMANDS)
    plan: dict[str, list[Callable[[Bench, Path], Result]]] = {
        "kill": [lambda b, f, s=stage: kill(b, f, s, dice) for stage in itertools.islice(turns, kills)],
        "worker": [
            lambda b, f, s=stage, n=number: worker_dies(b, f, s, n)
            for stage in ("prepare", "raytrace")
            for number in (signal.SIGSEGV, signal.SIGKILL)
        ],
        "hang": [lambda b, f, s=stage: worker_hangs(b, f, s) for stage in ("prepare", "raytrace", "evaluate")],
        "memory": [
            lambda b, f, s=stage: worker_starves(b, f, s, dice)
            for stage in ("prepare", "raytrace", "raytrace", "evaluate")
        ],
        "disk": [lambda b, f, s=stage: disk_full(b, f, s, dice) for stage in ("raytrace", "finetune", "evaluate")],
        "read-only": [lambda b, f, s=stage: read_only(b, f, s) for stage in ("select", "finetune")],
        "clock": [lambda b, f, s=stage: clock_jumps(b, f, s) for stage in ("raytrace", "finetune")],
        "two": [lambda b, f, s=stage: two_at_once(b, f, s) for stage in ("raytrace", "finetune")],
        "file": [lambda b, f, r=remove: file_damaged(b, f, "finetune", r, dice) for remove in (False, True)],
    }
    return plan


def table(results: list[Result]) -> str:
    """Faults by kind as Markdown: injected, survived, finished files made again."""
    lines = ["| fault | stages | injected | survived | finished files made again, most |", "|---|---|---|---|---|"]
    for kind in dict.fromkeys(result.kind for result in results):
        rows = [result for result in results if result.kind == kind]
        stages = ", ".join(name for name in COMMANDS if any(row.stage == name for row in rows))
        survived = sum(not row.problems for row in rows)
        lines.append(f"| {kind} | {stages} | {len(rows)} | {survived} | {max(row.lost for row in rows)} |")
    total = sum(not result.problems for result in results)
    return "\n".join([*lines, "", f"{total} of {len(results)} faults survived."])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", default=[], help="one kind of fault; repeatable")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results there")
    options = parser.parse_args()
    plan = campaign(options.kills, options.seed)
    if unknown := set(options.only) - set(plan):
        parser.error(f"--only {sorted(unknown)[0]}: choose from {', '.join(plan)}")
    results: list[Result] = []
    with tempfile.TemporaryDirectory(prefix="dnrpipe-faults-") as scratch:
        folder = Path(scratch)
        bench = build(folder)
        for name, faults in plan.items():
            for fault in faults if not options.only or name in options.only else []:
                try:
                    results.append(fault(bench, folder))
                except PermissionError as reason:
                    print(f"{name}: left out: {reason}", file=sys.stderr)
                    continue
                last = results[-1]
                said = "survived" if not last.problems else "; ".join(last.problems)
                print(f"{last.kind}, {last.stage}: {said}", file=sys.stderr, flush=True)
                if options.json:
                    write_json(options.json, [asdict(result) for result in results])
    print(table(results))
    return 1 if any(result.problems for result in results) else 0


if __name__ == "__main__":
    raise SystemExit(main())
