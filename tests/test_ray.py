"""Task lists on a real Ray cluster of three nodes on this machine: as on local processes, and what a cluster adds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.service.harness import TINY
from tests.test_executors import WORKER

from dnrpipe.core.errors import UserError
from dnrpipe.core.settings import ExecutorSettings
from dnrpipe.workers import ray_workers
from dnrpipe.workers.placement import Placement
from dnrpipe.workers.task_list import Retry, TaskResult, run_tasks
from dnrtrain.exr import read_exr

Cluster = pytest.importorskip("ray.cluster_utils", reason="the extra 'ray' is not installed").Cluster
BUILD = """
import sys
import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
image = bpy.data.images.new("squares", 8, 8)
image.pixels = [float(i % 8 > 3) for i in range(256)]
image.pack()
for number, kind in enumerate(("TexNoise", "TexImage")):  # one value to bake, one picture in the file
    bpy.ops.mesh.primitive_uv_sphere_add(location=(1.2 * number, 0, 0), segments=12, ring_count=6)
    material = bpy.data.materials.new(kind)
    material.use_nodes = True
    texture = material.node_tree.nodes.new("ShaderNode" + kind)
    if kind == "TexImage":
        texture.image = image
    surface = material.node_tree.nodes["Principled BSDF"].inputs["Base Color"]
    material.node_tree.links.new(texture.outputs["Color"], surface)
    bpy.context.object.data.materials.append(material)
bpy.ops.object.light_add(type="POINT", location=(2, -3, 4))
bpy.context.object.data.energy = 500
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1] + "/scene.blend", compress=True)
"""
"""Writes a scene of one file, so that its textures are baked on the cluster."""
SCENES = Path(__file__).parents[1] / "blender_scenes" / "hard"
NODE = {"num_cpus": 1, "object_store_memory": 100 << 20}
FILES = """
import pathlib

class Worker:
    def __init__(self, common):
        self.table = pathlib.Path(common["table"]).read_text()
        self.folder = pathlib.Path(common["folder"])
    def __call__(self, task):
        inside = sorted(path.name for path in self.folder.iterdir())
        output = pathlib.Path(task["output"])
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(self.table + task["word"])
        (output.parent / "beside.txt").write_text("beside")
        return {"inside": inside, "output": str(output), "here": str(self.folder)}
"""
WAITING = """
import pathlib, time
import ray

class Worker:
    def __init__(self, common):
        self.folder, self.doomed = pathlib.Path(common["folder"]), common["doomed"]
    def __call__(self, task):
        here = ray.get_runtime_context().get_node_id()
        (self.folder / here).touch()
        until = time.monotonic() + 90
        while here == self.doomed or not (self.folder / "killed").exists():
            if time.monotonic() > until:
                raise ValueError("no node was killed")
            time.sleep(0.05)
        return {}
"""
"""A task tells its node, then waits for the doomed node's end; on that one, for ever."""


@pytest.fixture(scope="session")
def cluster() -> Iterator[Cluster]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # Ray's 15: beside other tests a start takes a minute
        found = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
        for _ in range(2):
            found.add_node(**NODE)
        found.wait_for_nodes()
        yield found
    import ray

    ray.shutdown()
    found.shutdown()


@pytest.fixture
def modules(tmp_path: Path) -> Path:
    """A folder of workers that nodes import from."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "fragile_worker.py").write_text(WORKER)
    (folder / "filing_worker.py").write_text(FILES)
    (folder / "waiting_worker.py").write_text(WAITING)
    return folder


def _run(
    cluster: Cluster,
    modules: Path,
    kinds: list[str],
    worker: str = "fragile_worker",
    common: dict[str, str] | None = None,
    **options,
) -> tuple[list[TaskResult], list[Retry], Path]:
    root = modules.parent / "root"
    root.mkdir(exist_ok=True)
    place = Placement(ExecutorSettings(engine="ray", address=cluster.address), (root,))
    retries: list[Retry] = []
    outcomes = run_tasks(
        worker,
        {"folder": str(modules), **(common or {})},
        [{"kind": kind, "n": n} for n, kind in enumerate(kinds)],
        workers=2,
        log=root / "log.txt",
        retried=retries.append,
        environment={"PYTHONPATH": str(modules)},
        place=place,
        **options,
    )
    return sorted(outcomes, key=lambda outcome: outcome.task["n"]), retries, root


def test_tasks_and_deaths_as_with_local_processes(cluster: Cluster, modules: Path) -> None:
    results, retries, root = _run(cluster, modules, ["ok", "crash-once", "meet", "crash", "refuse", "meet"])
    assert [result.error for result in results[:3]] == [None] * 3 and results[5].error is None
    met = [results[n].result or {} for n in (2, 5)]
    assert met[0]["pid"] != met[1]["pid"]
    assert [results[1].attempts, results[3].attempts, results[4].attempts] == [2, 2, 1]
    assert results[3].died and "crashed" in (results[3].error or "")
    assert results[4].error == "bad input, said on two lines" and not results[4].died
    assert sorted(retry.task["n"] for retry in retries) == [1, 3]
    assert all(result.node for result in results if result.result)
    assert "noise below Python" in (root / "log.txt").read_text()


def test_a_task_that_hangs_is_ended(cluster: Cluster, modules: Path) -> None:
    results, retries, _ = _run(cluster, modules, ["hang", "ok"], timeout=3.0)
    assert results[0].error == "worker hung for 3 s" and results[0].attempts == 2
    assert results[1].result is not None and len(retries) == 1


def test_a_killed_node_costs_time_only(cluster: Cluster, modules: Path) -> None:
    node = cluster.add_node(**NODE)
    cluster.wait_for_nodes()

    def kill() -> None:
        until = time.monotonic() + 60
        while not (modules / node.node_id).exists() and time.monotonic() < until:  # until a task runs there
            time.sleep(0.05)
        cluster.remove_node(node, allow_graceful=False)
        (modules / "killed").touch()

    killer = threading.Thread(target=kill)
    killer.start()
    results, retries, _ = _run(cluster, modules, ["wait"] * 8, "waiting_worker", {"doomed": node.node_id})
    killer.join()
    assert [result.error for result in results] == [None] * 8
    assert all(result.attempts == 1 for result in results)  # not the task's doing
    assert any("is gone" in retry.reason for retry in retries)


def test_what_a_task_reads_goes_there_and_what_it_wrote_comes_back(cluster: Cluster, modules: Path) -> None:
    root = modules.parent / "root"
    (root / "folder").mkdir(parents=True)
    (root / "table.txt").write_text("table ")
    (root / "folder" / "a.txt").write_text("a")
    (root / "unread.txt").write_text("unread")
    place = Placement(ExecutorSettings(engine="ray", address=cluster.address), (root,))
    common = {"table": str(root / "table.txt"), "folder": str(root / "folder")}
    options = {"workers": 2, "log": root / "log.txt", "environment": {"PYTHONPATH": str(modules)}, "place": place}
    tasks = [{"word": f"word {n}", "output": str(root / f"made-{n}" / "out.txt")} for n in range(3)]
    results = list(run_tasks("filing_worker", common, tasks, **options))
    for result in results:
        assert result.result is not None, result.error
        number = result.task["word"][-1]
        assert (root / f"made-{number}" / "out.txt").read_text() == f"table word {number}"
        assert (root / f"made-{number}" / "beside.txt").read_text() == "beside"
        assert result.result["inside"] == ["a.txt"]
        assert result.result["output"] == result.task["output"]  # paths of answers are the driver's
    sent = dict(ray_workers._SENT)
    list(run_tasks("filing_worker", common, tasks[:1], **options))
    assert sent == ray_workers._SENT  # nothing new: nothing sent again
    (root / "folder" / "b.txt").write_text("b")
    (again,) = run_tasks("filing_worker", common, tasks[:1], **options)
    assert again.result is not None and again.result["inside"] == ["a.txt", "b.txt"]
    place = Placement(ExecutorSettings(engine="ray", address=cluster.address, shared=True), (root,))
    (shared,) = run_tasks("filing_worker", common, tasks[:1], **{**options, "place": place})
    assert shared.result is not None and shared.result["here"] == str(root / "folder")


def test_many_tiny_tasks(cluster: Cluster, modules: Path) -> None:
    started = time.monotonic()
    results, _, _ = _run(cluster, modules, ["ok"] * 1000)
    assert len(results) == 1000 and all(result.error is None for result in results)
    assert time.monotonic() - started < 60


def test_closing_the_iterator_ends_the_actors(cluster: Cluster, modules: Path) -> None:
    import ray

    place = Placement(ExecutorSettings(engine="ray", address=cluster.address), (modules,))
    tasks = [{"kind": "ok", "n": 0}, {"kind": "hang", "n": 1}]
    environment = {"PYTHONPATH": str(modules)}
    outcomes = run_tasks(
        "fragile_worker", {}, tasks, workers=2, log=modules / "log.txt", environment=environment, place=place
    )
    assert next(outcomes).result is not None
    outcomes.close()
    until = time.monotonic() + 60  # on a busy machine
    while ray.available_resources().get("CPU", 0) < 3:
        assert time.monotonic() < until, ray.available_resources()
        time.sleep(0.1)


def _require_the_same(here: Path, there: Path) -> None:
    """Pictures, selection and weights of two workspaces."""
    pictures = sorted(path.relative_to(here) for path in here.rglob("*.exr"))
    assert len(pictures) > 10
    for picture in pictures:
        channels = read_exr(here / picture)[0], read_exr(there / picture)[0]
        for name, values in channels[0].items():
            np.testing.assert_array_equal(values, channels[1][name], err_msg=f"{picture} {name}")
    assert (here / "selection.json").read_text() == (there / "selection.json").read_text()
    weights = [(root / "checkpoints" / "step2" / "model.safetensors").read_bytes() for root in (here, there)]
    assert weights[0] == weights[1]


@pytest.mark.slow
@pytest.mark.robustness
def test_a_run_gives_the_same_pictures_selection_and_weights(cluster: Cluster, tmp_path: Path) -> None:
    """The whole pipeline, here and on the cluster; its nodes see no workspace but what is sent to them."""
    subprocess.run([sys.executable, "-c", BUILD, str(tmp_path)], check=True, capture_output=True)
    made = {}
    for engine in ("local", "ray"):
        root = tmp_path / engine / "scene.dnr"
        root.parent.mkdir()
        words = [str(tmp_path / "scene.blend"), "-w", str(root), "--executor", engine]
        words += ["--address", cluster.address] if engine == "ray" else []
        words += [f"--set={key}={json.dumps(value)}" for key, value in TINY.items()]
        done = subprocess.run(
            [sys.executable, "-m", "dnrpipe.cli", "run", *words],
            capture_output=True,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},  # as many as a node of the cluster has
        )
        assert done.returncode == 0 and "baked here" not in done.stdout, done.stderr
        made[engine] = root
    here, there = made["local"], made["ray"]
    baked = [{path.name: path.read_bytes() for path in (root / "bakes").glob("*.npy")} for root in (here, there)]
    assert baked[0] and baked[0] == baked[1]
    _require_the_same(here, there)
    ledger = [json.loads(line) for line in (there / "costs.jsonl").read_text().splitlines()]
    assert any("node" in record.get("detail", {}) for record in ledger)


@pytest.mark.robustness
def test_a_node_killed_amid_a_batch_costs_time_only(cluster: Cluster, tmp_path: Path) -> None:
    """Three scenes, here and on the cluster, one of whose nodes is killed when the first of them traces."""
    scenes = ["emissive_only", "all_mirror", "all_glass"]
    settings = "\n".join(f"{key} = {json.dumps(value)}" for key, value in TINY.items())
    listed = json.dumps([str(SCENES / f"{name}.blend") for name in scenes])
    for engine in ("local", "ray"):
        (tmp_path / engine).mkdir()
        fleet = tmp_path / engine / "fleet.toml"
        fleet.write_text(f"scenes = {listed}\n[settings]\n{settings}\n")
        words = ["--executor", "ray", "--address", cluster.address, "--jobs", "3"] if engine == "ray" else []
        node = cluster.add_node(**NODE) if engine == "ray" else None
        process = subprocess.Popen(
            [sys.executable, "-m", "dnrpipe.cli", "batch", str(fleet), "--json", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},  # as many as a node of the cluster has
        )
        if node is not None:
            until = time.monotonic() + 120
            while not list((tmp_path / engine).rglob("raytraced/train/*.exr")):
                assert time.monotonic() < until and process.poll() is None, process.communicate()
                time.sleep(0.1)
            cluster.remove_node(node, allow_graceful=False)
        out, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors
        assert [row["state"] for row in json.loads(out)["rows"]] == ["done"] * 3
    for name in scenes:
        here, there = (tmp_path / engine / "fleet" / f"{name}.dnr" for engine in ("local", "ray"))
        _require_the_same(here, there)


def test_without_ray_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"pip install 'dnrpipe\[ray\]'"):
        ray_workers.connect(ExecutorSettings(engine="ray"))


def test_a_node_with_other_packages_is_refused(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    executor = ExecutorSettings(engine="ray", address=cluster.address)
    ray_workers.connect(executor)
    found = ray_workers.installed() | {"mitsuba": "0.0.1"}
    answers = iter([found])
    original = ray_workers.installed
    monkeypatch.setattr(ray_workers, "installed", lambda: next(answers, None) or original())
    with pytest.raises(UserError, match=r"node \S+ has mitsuba 0\.0\.1 \(here \d"):
        ray_workers.refuse_other_versions(executor)
