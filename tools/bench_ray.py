"""What a Ray cluster costs and brings on this machine: overhead per task, tiny tasks, tracing and a fleet on one node
and on two, beside what `dnrpipe batch --forecast` says; and its forecast for a hundred scenes.

python -m tools.bench_ray WORKSPACE.dnr [--out docs/results/scaling.json]

WORKSPACE: finished. Its selected views are traced anew in copies, its ledger is the forecast's. Nodes have one
processor each.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dnrpipe.cli.fleet import ON_RAY
from dnrpipe.core.ledger import Ledger
from dnrpipe.core.settings import ExecutorSettings
from dnrpipe.fleet.forecast import Step, chain_of, forecast
from dnrpipe.studies.cells.results import made_by
from dnrpipe.workers.placement import Placement
from dnrpipe.workers.task_list import run_tasks
from dnrpipe.workers.view_tasks import worker_count
from dnrtrain.atomic import write_json

OUT = Path(__file__).resolve().parents[1] / "docs" / "results" / "scaling.json"
NODE: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 200 << 20}
SECONDS, LONG, TINY = 1.0, 40, 10_000
SCENE = Path(__file__).resolve().parents[1] / "blender_scenes" / "demo.blend"
SMALL = {"cameras.train": 16, "cameras.val": 1, "cameras.test": 2, "select.budget": 8, "finetune.step2.epochs": 20}
"""Settings of the measured fleet's scenes."""
ONE_CORE = {"OMP_NUM_THREADS": "1", "DNRPIPE_PASSES__WORKERS": "1", "DNRPIPE_RAYTRACE__WORKERS": "1"}
"""A scene alone has what a node has; a cluster's workers take their share of it."""
FLEET = 4
HUNDRED, NODES, JOBS = 100, (1, 8, 16, 32, 64), (ON_RAY, 64)
WORKER = """
import time

class Worker:
    def __init__(self, common):
        pass
    def __call__(self, task):
        time.sleep(task["seconds"])
        return {}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    found: dict[str, Any] = {**made_by(), "tasks": [], "tracing": [], "fleet": []}
    found["draft"], found["slots"] = _steps(options.workspace), worker_count(0)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "sleeping_worker.py").write_text(WORKER)
        import ray
        from ray.cluster_utils import Cluster

        alone = _ran_fleet(Path(folder) / "alone", 1, None)
        found["small"] = _steps(next((Path(folder) / "alone").rglob("costs.jsonl")).parent)
        cluster = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
        for nodes in (1, 2):
            if nodes == 2:
                cluster.add_node(**NODE)
                cluster.wait_for_nodes()
            for name, place in (("local", Placement()), ("ray", _ray(cluster, Path(folder)))):
                found["tracing"].append(_traced(options.workspace.resolve(), Path(folder), name, nodes, place))
                if nodes == 2:
                    for count, seconds in ((LONG, SECONDS), (TINY, 0.0)):
                        found["tasks"].append(_slept(Path(folder), name, count, seconds, place))
            seconds = _ran_fleet(Path(folder) / f"fleet-{nodes}", FLEET, cluster.address)
            found["fleet"].append({"nodes": nodes, "scenes": FLEET, "alone_seconds": alone, "seconds": seconds})
            print(json.dumps({key: found[key][-2:] for key in ("tracing", "tasks", "fleet")}), flush=True)
            write_json(options.out, found)
        ray.shutdown()
        cluster.shutdown()
    print(markdown(found))


def _ray(cluster: Any, *roots: Path) -> Placement:
    return Placement(ExecutorSettings(engine="ray", address=cluster.address), roots)


def _steps(workspace: Path) -> list[dict[str, Any]]:
    """What the workspace's ledger says, as the forecast reads it."""
    return [asdict(step) for step in chain_of(Ledger(workspace / "costs.jsonl").read())]


def reckoned(steps: Sequence[Mapping[str, Any]], scenes: int, nodes: int, slots: int = 1, jobs: int = ON_RAY) -> float:
    """Seconds of a fleet, by `dnrpipe batch --forecast`."""
    chain = [Step(tuple(step["seconds"]), step["driver"], step["whole"]) for step in steps]
    return forecast([chain], scenes, nodes, slots=slots, drivers=jobs)


def _ran_fleet(folder: Path, scenes: int, address: str | None) -> float:
    """Seconds of `dnrpipe batch`: a small scene, so many times with other seeds; one worker without a cluster."""
    settings = "\n".join(f"{key} = {json.dumps(value)}" for key, value in SMALL.items())
    variants = "\n".join(f"[variants.s{seed}]\ncameras.seed = {seed}" for seed in range(scenes))
    folder.mkdir()
    (folder / "fleet.toml").write_text(f'scenes = ["{SCENE}"]\n[settings]\n{settings}\n{variants}\n')
    words = ["--executor", "ray", "--address", address] if address else []
    started = time.perf_counter()
    _dnrpipe("batch", str(folder / "fleet.toml"), "-q", *words, environment={} if address else ONE_CORE)
    return round(time.perf_counter() - started, 1)


def _dnrpipe(*words: str, environment: Mapping[str, str] = MappingProxyType({})) -> None:
    subprocess.run([sys.executable, "-m", "dnrpipe.cli", *words], check=True, env={**os.environ, **environment})


def _slept(folder: Path, engine: str, count: int, seconds: float, place: Placement) -> dict[str, Any]:
    """Tasks that sleep, on two workers."""
    environment = {"PYTHONPATH": f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    options: dict[str, Any] = {"workers": 2, "log": folder / "log.txt", "environment": environment, "place": place}
    warm = list(run_tasks("sleeping_worker", {}, [{"seconds": 0.0, "n": n} for n in range(2)], **options))
    assert all(outcome.error is None for outcome in warm), warm
    tasks = [{"seconds": seconds, "n": n} for n in range(count)]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = first = time.perf_counter()
    for number, outcome in enumerate(run_tasks("sleeping_worker", {}, tasks, **options)):
        assert outcome.error is None, outcome.error
        if number == 1:
            first = time.perf_counter()
    ended = time.perf_counter()
    return {
        "engine": engine,
        "tasks": count,
        "task_seconds": seconds,
        "start_seconds": round(first - started - seconds, 3),
        "seconds": round(ended - first, 3),
        "per_task_ms": round(1000 * (2 * (ended - first) / (count - 2) - seconds), 3),
        "driver_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "driver_mb_before": round(before / 1024, 1),
    }


def _traced(workspace: Path, folder: Path, engine: str, workers: int, place: Placement) -> dict[str, Any]:
    """All selected views of a copy of the workspace, traced by `dnrpipe raytrace-selected`."""
    copy = folder / f"{engine}-{workers}.dnr"
    shutil.copytree(workspace, copy)
    words = ["raytrace-selected", "--force", "-w", str(copy), "-q", "--set", f"raytrace.workers={workers}"]
    words += [] if place.is_local else ["--executor", "ray", "--address", place.executor.address]
    started = time.perf_counter()
    _dnrpipe(*words)
    seconds = time.perf_counter() - started
    views = len(list((copy / "raytraced" / "train").glob("*.exr")))
    shutil.rmtree(copy)
    return {"engine": engine, "workers": workers, "views": views, "seconds": round(seconds, 2)}


def markdown(found: dict[str, Any]) -> str:
    """Two tables."""
    machine = found["machine"]
    lines = [
        f"{machine['processor']}, {machine['cores']} cores, {found['date'][:10]}, commit {found['commit'][:12]}.",
        "",
        "| engine | tasks | seconds each | first answers | the rest | a task, beyond its seconds | driver's memory |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in found["tasks"]:
        lines.append(
            f"| {row['engine']} | {row['tasks']:,} | {row['task_seconds']:g} | {row['start_seconds']:.1f} s"
            f" | {row['seconds']:.1f} s | {row['per_task_ms']:.1f} ms"
            f" | {row['driver_mb_before']:.0f} → {row['driver_mb']:.0f} MiB |"
        )
    lines += ["", "| engine | workers | views | seconds in all |", "| --- | ---: | ---: | ---: |"]
    for row in sorted(found["tracing"], key=lambda row: (row["engine"], row["workers"])):
        lines.append(f"| {row['engine']} | {row['workers']} | {row['views']} | {row['seconds']:.1f} |")
    lines += ["", "| fleet | nodes | forecast | took | one scene, alone |", "| --- | ---: | ---: | ---: | ---: |"]
    for row in found["fleet"]:
        seconds = reckoned(found["small"], row["scenes"], row["nodes"])
        lines.append(
            f"| {row['scenes']} scenes | {row['nodes']} | {seconds:.0f} s | {row['seconds']:.0f} s"
            f" | {row['alone_seconds']:.0f} s |"
        )
    lines += [
        "",
        f"{HUNDRED} scenes like the demo (draft), on nodes of {found['slots']} tasks side by side, by forecast:",
        "",
        f"| nodes |{''.join(f' minutes, --jobs {jobs} |' for jobs in JOBS)}",
        f"| ---: |{' ---: |' * len(JOBS)}",
    ]
    for nodes in NODES:
        minutes = [reckoned(found["draft"], HUNDRED, nodes, found["slots"], jobs) / 60 for jobs in JOBS]
        lines.append(f"| {nodes} |{''.join(f' {value:.0f} |' for value in minutes)}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
