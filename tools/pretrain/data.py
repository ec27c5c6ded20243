"""Make the training data of the shipped corrector, scene by scene; what is there is kept.

python -m tools.pretrain.data FOLDER [--scenes 150] [--first 1000] [--minutes 60]

Each scene is a process of its own on one core; one that fails, or takes too long, is named in FOLDER/failed.txt and
left out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from dnrpipe.core.console import clock

LIMIT = 300
"""Seconds of one scene."""
FIRST = 1000
"""Seeds below it are for judging weights on scenes that they never saw."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=150)
    parser.add_argument("--first", type=int, default=FIRST, help="seed of the first scene")
    parser.add_argument("--minutes", type=float, default=600, help="start no scene after so many")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    make_all(options.folder, range(options.first, options.first + options.scenes), options.minutes, options.jobs)


def make_all(folder: Path, seeds: range, minutes: float, jobs: int) -> None:
    """Make the scenes of the seeds that are neither there nor known to fail."""
    folder.mkdir(parents=True, exist_ok=True)
    failures = folder / "failed.txt"
    known = {int(line.split()[0]) for line in failures.read_text().splitlines()} if failures.exists() else set()
    due = [seed for seed in seeds if seed not in known and not (folder / str(seed) / "scene.json").exists()]
    started, lock, done = time.monotonic(), threading.Lock(), 0

    def one(seed: int) -> None:
        nonlocal done
        if time.monotonic() - started > 60 * minutes:
            return
        reason = scene(seed, folder / str(seed))
        with lock:
            done += 1
            spent = time.monotonic() - started
            left = min(spent / done * (len(due) - done), 60 * minutes - spent)
            print(
                f"{done}/{len(due)} seed {seed}: {reason or told(folder / str(seed))}, {clock(left)} left", flush=True
            )
            if reason:
                with failures.open("a") as file:
                    file.write(f"{seed} {reason}\n")

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(one, due))


def scene(seed: int, folder: Path) -> str:
    """Make one; "" or why there is none."""
    command = [sys.executable, "-m", "tools.pretrain.scene", str(seed), str(folder)]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return f"took more than {LIMIT} s"
    if run.returncode == 0:
        return ""
    lines = run.stderr.strip().splitlines()
    return lines[-1] if lines else f"ended with {run.returncode}"


def told(folder: Path) -> str:
    """What a scene took, by its record."""
    data = json.loads((folder / "scene.json").read_text())
    parts = ", ".join(f"{name} {seconds:.0f}" for name, seconds in data["seconds"].items())
    return f"{data['family']}, {data['triangles']} triangles ({parts} s)"


if __name__ == "__main__":
    main()
