"""Worker processes: results, retries, deaths, hangs, noise on standard output."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dnrpipe.blender.tasks import InspectAnswer, InspectTask
from dnrpipe.core.errors import UserError
from dnrpipe.stages.prepare import open_scene
from dnrpipe.workers import task_list as task_list_module
from dnrpipe.workers.processes import KeptWorker, LocalWorker, TaskFailed, WorkerDied
from dnrpipe.workers.task_list import Retry, TaskResult, run_tasks

WORKER = """
import os, pathlib, resource, signal, sys, tempfile, time
print("noise on import")

class Worker:
    def __init__(self, common):
        self.common = common
    def __call__(self, task):
        print("noise in task")
        os.write(1, b"noise below Python\\n")
        kind = task["kind"]
        if kind == "crash-once":
            mark = pathlib.Path(self.common["folder"]) / f"crashed-{task['n']}"
            if not mark.exists():
                mark.touch()
                os.kill(os.getpid(), signal.SIGSEGV)
        elif kind == "crash":
            os._exit(134)
        elif kind == "hang":
            time.sleep(60)
        elif kind == "refuse":
            raise ValueError("bad input,\\nsaid on two lines")
        elif kind == "sleep":
            time.sleep(0.4)
        elif kind == "meet":  # ends when another worker is at such a task, too
            folder = pathlib.Path(self.common["folder"])
            (folder / f"met-{os.getpid()}").touch()
            until = time.monotonic() + 120
            while len(list(folder.glob("met-*"))) < 2:
                if time.monotonic() > until:
                    raise ValueError("nobody came")
                time.sleep(0.05)
        elif kind == "greedy-once":
            mark = pathlib.Path(self.common["folder"]) / f"greedy-{task['n']}"
            if not mark.exists():
                mark.touch()
                resource.setrlimit(resource.RLIMIT_AS, (1 << 28, 1 << 28))
            bytearray(1 << 29)
        elif kind == "litter":
            pathlib.Path(tempfile.gettempdir(), "left-behind").touch()
            return {"temporary": tempfile.gettempdir()}
        return {"n": task["n"], "pid": os.getpid()}
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "fragile_worker.py").write_text(WORKER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    return "fragile_worker"


def _run(module: str, folder: Path, kinds: list[str], **options) -> tuple[list[TaskResult], list[Retry]]:
    tasks = [{"kind": kind, "n": n} for n, kind in enumerate(kinds)]
    retries: list[Retry] = []
    options = {"workers": 2, "log": folder / "log.txt", "retried": retries.append, **options}
    results = sorted(run_tasks(module, {"folder": str(folder)}, tasks, **options), key=lambda o: o.task["n"])
    return results, retries


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_kept_worker_serves_one_list_after_the_other(module: str, tmp_path: Path) -> None:
    """Until something else is wanted, or it crashed, or a list is broken off."""

    def pids(kinds: list[str], environment: dict[str, str] | None = None) -> set[int]:
        results, _ = _run(module, tmp_path, kinds, kept=kept, environment=environment)
        return {result.result["pid"] for result in results if result.result}

    with KeptWorker() as kept:
        (first,) = pids(["sleep"] * 2)
        assert pids(["sleep"]) == {first}
        (other,) = pids(["sleep"], {"WANTED": "otherwise"})
        assert other != first and not _lives(first)
        crashed = pids(["sleep", "crash-once"], {"WANTED": "otherwise"})
        assert other in crashed and len(crashed) == 2
        (fresh,) = pids(["sleep"], {"WANTED": "otherwise"})
        tasks = [{"kind": kind, "n": n} for n, kind in enumerate(("sleep", "hang"))]
        wanted = {"workers": 1, "log": tmp_path / "log.txt", "environment": {"WANTED": "otherwise"}}
        outcomes = run_tasks(module, {"folder": str(tmp_path)}, tasks, kept=kept, **wanted)
        assert next(outcomes).result["pid"] == fresh
        outcomes.close()
        assert not _lives(fresh)
        (last,) = pids(["sleep"])
    assert not _lives(last)


def test_all_tasks_are_done_on_several_processes(module: str, tmp_path: Path) -> None:
    results, retries = _run(module, tmp_path, ["sleep"] * 4)
    assert [r.result["n"] for r in results if r.result] == [0, 1, 2, 3]
    assert len({r.result["pid"] for r in results if r.result}) == 2
    assert not retries
    assert "noise below Python" in (tmp_path / "log.txt").read_text()


def test_a_crashed_worker_is_replaced_and_its_task_retried_once(module: str, tmp_path: Path) -> None:
    results, retries = _run(module, tmp_path, ["ok", "crash-once", "ok", "crash", "ok"])
    assert [r.error is None for r in results] == [True, True, True, False, True]
    assert results[1].attempts == 2
    assert results[3].attempts == 2
    assert "exit code 134" in (results[3].error or "")
    assert sorted(r.task["n"] for r in retries) == [1, 3]
    assert any("SIGSEGV" in r.reason for r in retries)


def test_bad_input_is_not_retried_and_is_one_line(module: str, tmp_path: Path) -> None:
    results, retries = _run(module, tmp_path, ["refuse", "ok"])
    assert results[0].error == "bad input, said on two lines"
    assert results[0].attempts == 1
    assert results[1].result is not None
    assert not retries


def test_a_hung_worker_is_killed(module: str, tmp_path: Path) -> None:
    started = time.monotonic()
    results, _ = _run(module, tmp_path, ["hang", "ok"], timeout=5.0)  # a busy machine starts a worker in seconds
    assert time.monotonic() - started < 45
    assert "hung" in (results[0].error or "")
    assert results[1].result is not None


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_AS is Linux's to keep")
def test_a_worker_out_of_memory_says_so_and_its_task_is_tried_on_a_fresh_one(module: str, tmp_path: Path) -> None:
    """The first worker stays as short of memory as it is: tried there again the task would fail again."""
    results, retries = _run(module, tmp_path, ["greedy-once", "ok"], workers=1)
    assert [r.reason for r in retries] == ["out of memory (MemoryError)"]
    assert [r.error for r in results] == [None, None]
    assert results[0].attempts == 2


def test_a_time_limit_from_the_environment(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DNRPIPE_TASK_TIMEOUT", "1.5s")
    started = time.monotonic()
    results, retries = _run(module, tmp_path, ["hang"])
    assert time.monotonic() - started < 20
    assert [r.reason for r in retries] == ["worker hung for 2 s"]
    assert results[0].error == "worker hung for 2 s" and results[0].died
    monkeypatch.setenv("DNRPIPE_TASK_TIMEOUT", "soon")
    with pytest.raises(UserError, match="DNRPIPE_TASK_TIMEOUT=soon: expected a time"):
        _run(module, tmp_path, ["ok"])


def test_a_time_limit_from_what_tasks_took(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hours before anything is known, then a multiple of the longest, and twice that for the second try."""
    timeout = task_list_module.TaskTimeout()
    assert (timeout.limit(1), timeout.reason()) == (6 * 3600, "")
    for seconds in (4.0, 100.0, 50.0):
        timeout.took(seconds)
    assert (timeout.limit(1), timeout.limit(2)) == (3000, 6000)
    assert timeout.reason() == "; the longest so far took 100 s"
    monkeypatch.setattr(task_list_module, "LEAST_LIMIT", 0.5)
    monkeypatch.setattr(task_list_module, "SLOWEST", 1.0)
    results, retries = _run(module, tmp_path, ["sleep", "hang"], workers=1)
    assert results[0].error is None
    assert "hung" in retries[0].reason and "the longest so far took" in retries[0].reason
    assert "hung" in (results[1].error or "") and results[1].seconds > 1


def test_a_module_that_cannot_be_imported_fails_every_task(tmp_path: Path) -> None:
    results, _ = _run("no_such_module_here", tmp_path, ["ok"])
    assert results[0].error is not None
    assert "No module named" in (tmp_path / "log.txt").read_text()


def test_a_worker_that_cannot_be_started_is_an_error_and_not_a_hang(module: str, tmp_path: Path) -> None:
    (tmp_path / "log.txt").mkdir()
    results, _ = _run(module, tmp_path, ["ok", "ok"])
    assert all("log.txt" in (r.error or "") and r.died for r in results)


def test_a_worker_that_cannot_be_made_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "class Worker:\n    def __init__(self, common):\n        raise ValueError('broken bundle')\n"
    (tmp_path / "broken_worker.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    results, retries = _run("broken_worker", tmp_path, ["ok"])
    assert results[0].error == "broken bundle"
    assert not results[0].died
    assert not retries


def test_closing_the_iterator_kills_the_workers(module: str, tmp_path: Path) -> None:
    tasks = [{"kind": "ok", "n": 0}, {"kind": "hang", "n": 1}]
    outcomes = run_tasks(module, {"folder": str(tmp_path)}, tasks, workers=2, log=tmp_path / "log.txt")
    first = next(outcomes)
    assert isinstance(first, TaskResult)
    started = time.monotonic()
    outcomes.close()  # type: ignore[attr-defined]
    assert time.monotonic() - started < 10


def test_an_interrupt_while_the_worker_of_a_scene_ends_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its answer is here already; the command must end all the same."""
    code = """
import os, signal, time

end = os._exit

def interrupt_and_end(code):
    os.kill(os.getppid(), signal.SIGUSR1)
    time.sleep(0.5)
    end(code)

os._exit = interrupt_and_end

class Worker:
    def __init__(self, common): ...
    def __call__(self, task):
        return {"census": {}, "warnings": []}
"""
    (tmp_path / "slow_to_end.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGUSR1, interrupt)
    try:
        task = InspectTask(source=tmp_path / "scene.blend", folder=tmp_path, bake_size=64)
        with pytest.raises(KeyboardInterrupt):
            open_scene("slow_to_end", task, InspectAnswer, tmp_path / "log.txt")
    finally:
        signal.signal(signal.SIGUSR1, before)


@pytest.mark.skipif(sys.platform != "linux", reason="PR_SET_PDEATHSIG is Linux's")
def test_workers_die_with_their_parent(module: str, tmp_path: Path) -> None:
    script = (
        "from dnrpipe.workers.task_list import run_tasks; from pathlib import Path;"
        f"list(run_tasks('{module}', {{'folder': '.'}}, [{{'kind': 'hang', 'n': 0}}], workers=1,"
        f" log=Path('{tmp_path}/log.txt')))"
    )
    parent = subprocess.Popen([sys.executable, "-c", script])
    children: list[int] = []
    for _ in range(100):
        time.sleep(0.1)
        lists = Path(f"/proc/{parent.pid}/task").glob("*/children")
        children = [int(pid) for found in lists for pid in found.read_text().split()]
        if children and "noise in task" in (tmp_path / "log.txt").read_text():
            break
    assert children
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    for _ in range(50):
        time.sleep(0.1)
        if not any(Path(f"/proc/{pid}").exists() and _running(pid) for pid in children):
            return
    for pid in children:
        os.kill(pid, signal.SIGKILL)
    raise AssertionError("a worker outlived its parent")


@pytest.mark.skipif(sys.platform != "linux", reason="PR_SET_PDEATHSIG is Linux's")
def test_a_worker_whose_parent_died_before_it_could_ask_ends_at_once(module: str, tmp_path: Path) -> None:
    """Its task is in the pipe already; it must not be begun, for nobody will take the answer."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    command = [sys.executable, "-m", "dnrpipe.workers.processes", module]
    line = json.dumps({"folder": str(tmp_path)}) + "\n" + json.dumps({"kind": "ok", "n": 0}) + "\n"
    orphan = subprocess.run([*command, str(dead.pid)], input=line, capture_output=True, text=True, timeout=60)
    assert (orphan.returncode, orphan.stdout) == (1, "")
    kept = subprocess.run([*command, str(os.getpid())], input=line, capture_output=True, text=True, timeout=60)
    assert kept.returncode == 0 and json.loads(kept.stdout)["result"]["n"] == 0


def _running(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"


def test_what_workers_leave_in_the_temporary_folder_goes_with_them(module: str, tmp_path: Path) -> None:
    results, _ = _run(module, tmp_path, ["litter"])
    assert results[0].result is not None
    assert not Path(results[0].result["temporary"]).exists()


def test_a_single_worker_outlives_errors_and_is_replaced_when_it_dies(module: str, tmp_path: Path) -> None:
    worker = LocalWorker(module, {"folder": str(tmp_path)}, tmp_path / "log", {})
    try:
        first = worker.ask({"kind": "plain", "n": 1}, 60)
        with pytest.raises(TaskFailed, match="bad input, said on two lines"):
            worker.ask({"kind": "refuse"}, 60)
        assert worker.ask({"kind": "plain", "n": 2}, 60)["pid"] == first["pid"]
        with pytest.raises(WorkerDied):
            worker.ask({"kind": "crash"}, 60)
        with pytest.raises(WorkerDied, match="hung"):
            worker.ask({"kind": "hang"}, 1)
        assert worker.ask({"kind": "plain", "n": 3}, 60)["pid"] != first["pid"]
    finally:
        worker.close()


def test_a_scene_that_opened_at_the_second_try_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A refusal stays one line: the first try is told of only where the second one helped."""
    from dnrpipe.core.console import Console
    from dnrpipe.core.settings import Settings
    from dnrpipe.core.workspace import Source, Workspace
    from dnrpipe.stages import prepare
    from dnrpipe.stages.stage import Run

    workspace = Workspace.create(tmp_path / "a.dnr", Source(path="a.blend", sha256=""))
    for last in (TaskResult({}, {"bakes": None}), TaskResult({}, None, "worker hung for 60 s", 2, died=True)):

        def run_tasks(*_: object, retried: Callable[[Retry], None], found: TaskResult = last, **__: object) -> list:
            retried(Retry({}, "worker hung for 60 s"))
            return [found]

        monkeypatch.setattr(prepare, "run_tasks", run_tasks)
        run = Run(workspace, Settings(), Console(quiet=True))
        if last.result is not None:
            prepare._run_conversion(run, tmp_path / "a.blend", tmp_path / "scene")
            assert "scene: worker hung for 60 s; opening it once more went well" in capsys.readouterr().err
        else:
            with pytest.raises(UserError, match="could not open it"):
                prepare._run_conversion(run, tmp_path / "a.blend", tmp_path / "scene")
            assert capsys.readouterr().err == ""
