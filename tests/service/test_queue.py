"""The queue: nothing lost, nothing twice, whatever dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sqlite3
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from dnrpipe.core.errors import UserError
from dnrpipe.service.models import FINAL, JobRequest
from dnrpipe.service.queue import MAX_LOSSES, Queue, QueueFull, WrongState
from dnrpipe.service.root import ServiceRoot
from dnrpipe.service.worker import job_command


def _request(workspace: str, priority: int = 0) -> JobRequest:
    return JobRequest(command="report", workspace=workspace, priority=priority)


def _drain(path: Path, device: str, found: multiprocessing.Queue[int]) -> None:
    queue = Queue(path)
    while (job := queue.claim(device)) is not None:
        found.put(job.id)
        queue.finish(job.id, "done", exit_code=0)


def test_a_thousand_jobs_on_four_workers(tmp_path: Path) -> None:
    """Every job is claimed exactly once, by processes that race for it."""
    queue = Queue(tmp_path / "q.sqlite")
    ids = [queue.submit(_request(f"w{i}")).id for i in range(1000)]
    context = multiprocessing.get_context("spawn")
    found: multiprocessing.Queue[int] = context.Queue()
    workers = [context.Process(target=_drain, args=(queue.path, f"cpu:{i}", found)) for i in range(4)]
    for worker in workers:
        worker.start()
    claimed = [found.get(timeout=120) for _ in ids]
    for worker in workers:
        worker.join(timeout=60)
    assert sorted(claimed) == sorted(ids)
    assert found.empty()
    assert queue.counts() == {"queued": 0, "running": 0, "done": 1000, "failed": 0, "cancelled": 0}


def test_order(tmp_path: Path) -> None:
    """Priority first, then age; one job of a workspace at a time."""
    queue = Queue(tmp_path / "q.sqlite")
    first, urgent, same, other = (
        queue.submit(_request(name, priority)).id for name, priority in (("a", 0), ("b", 5), ("b", 4), ("c", 0))
    )
    claimed = [queue.claim("cpu"), queue.claim("cpu"), queue.claim("cpu")]
    assert [job.id for job in claimed if job] == [urgent, first, other]
    assert queue.claim("cpu") is None  # b is being worked on
    queue.finish(urgent, "done")
    again = queue.claim("cpu")
    assert again is not None and again.id == same


def test_killed_worker_loses_nothing(tmp_path: Path) -> None:
    """A process that claims a job and is killed with -9 in the same breath: the job is queued again."""
    queue = Queue(tmp_path / "q.sqlite")
    job = queue.submit(_request("a")).id
    code = (
        "import os, signal, sys; from pathlib import Path; from dnrpipe.service.queue import Queue;"
        "assert Queue(Path(sys.argv[1])).claim('cpu') is not None; os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(queue.path)], timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL
    running = queue.get(job)
    assert running is not None and running.state == "running"
    assert queue.recover("cuda:0") == []  # another device's are left alone
    assert queue.recover("cpu") == [job]
    again = queue.claim("cpu")
    assert again is not None and (again.id, again.starts) == (job, 2)


def test_a_worker_whose_server_died_while_it_started_does_nothing(tmp_path: Path) -> None:
    """Linux tells a process of its parent's death only if it asked before; this one asks too late."""
    queue = Queue(tmp_path / ".service" / "queue.sqlite")
    job = queue.submit(_request("a")).id
    done = subprocess.run(
        [sys.executable, "-m", "dnrpipe.service.worker", "cpu", "1"],
        input=f'{{"root": "{tmp_path}"}}',
        text=True,
        timeout=60,
        check=False,
    )
    found = queue.get(job)
    assert done.returncode == 1 and found is not None and found.state == "queued"


def test_a_job_that_kills_its_worker_is_given_up(tmp_path: Path) -> None:
    queue = Queue(tmp_path / "q.sqlite")
    job = queue.submit(_request("a")).id
    for _ in range(MAX_LOSSES):
        assert queue.claim("cpu") is not None
        queue.recover()
    found = queue.get(job)
    assert found is not None and found.state == "failed" and found.error and "lost" in found.error
    assert queue.claim("cpu") is None


def test_stops_in_order_are_no_losses(tmp_path: Path) -> None:
    """A server that is restarted often, and then dies once, ends no job; a retry counts anew."""
    queue = Queue(tmp_path / "q.sqlite")
    job = queue.submit(_request("a")).id
    for _ in range(MAX_LOSSES):
        assert queue.claim("cpu") is not None
        queue.requeue(job, crashed=False, why="its worker was stopped")
    for _ in range(2):
        for _ in range(MAX_LOSSES):
            assert queue.get(job).state == "queued" and queue.claim("cpu") is not None
            queue.recover()
        found = queue.get(job)
        assert found.state == "failed" and found.error == f"its process was lost {MAX_LOSSES} times"
        queue.retry(job)


def test_a_retry_throws_nothing_away(tmp_path: Path) -> None:
    """A job with `force` that failed goes on from what it made; one of which nothing is left begins anew."""
    queue, root = Queue(tmp_path / "q.sqlite"), ServiceRoot(tmp_path / "root").create()
    job = queue.submit(_request("a").model_copy(update={"force": True})).id
    first = queue.claim("cpu")
    assert first is not None and "--force" in job_command(first, root)
    queue.finish(job, "failed")
    queue.retry(job)
    again = queue.claim("cpu")
    assert again is not None and again.starts == 2 and "--force" not in job_command(again, root)
    queue.finish(job, "done")
    job = queue.submit(_request("b").model_copy(update={"force": True})).id
    queue.claim("box/cpu", lease="gone", seconds=-1)
    queue.recover_lapsed()
    queue.cancel(job)
    queue.retry(job)
    again = queue.claim("cpu")
    assert again is not None and "--force" in job_command(again, root)


def test_a_queue_of_before_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "q.sqlite"
    job = Queue(path).submit(_request("a")).id
    with sqlite3.connect(path) as db:
        db.execute("ALTER TABLE jobs DROP COLUMN losses")
        db.execute("PRAGMA user_version = 2")
    queue = Queue(path)
    queue.claim("cpu")
    assert queue.recover() == [job] and queue.get(job).state == "queued"


def test_limits_and_repeated_wishes(tmp_path: Path) -> None:
    queue = Queue(tmp_path / "q.sqlite")
    first = queue.submit(_request("a"), most_queued=2, token="a-client-key")
    assert queue.submit(_request("a"), most_queued=2, token="a-client-key").id == first.id
    queue.submit(_request("a"), most_queued=2)
    with pytest.raises(QueueFull, match="2 jobs"):
        queue.submit(_request("a"), most_queued=2)


def test_cancelled_while_it_was_lost(tmp_path: Path) -> None:
    queue = Queue(tmp_path / "q.sqlite")
    job = queue.submit(_request("a")).id
    queue.claim("cpu")
    assert queue.cancel(job).state == "running" and queue.get(job).cancel_requested
    queue.recover()
    found = queue.get(job)
    assert found is not None and found.state == "cancelled"


def test_not_a_queue(tmp_path: Path) -> None:
    path = tmp_path / "q.sqlite"
    path.write_bytes(os.urandom(8192))
    with pytest.raises(UserError, match="not a job queue"):
        Queue(path)


class Life(RuleBasedStateMachine):
    """Any order of wishes, claims, ends and crashes: every job stays in one state, and final means final."""

    def __init__(self) -> None:
        super().__init__()
        import tempfile

        self.folder = tempfile.TemporaryDirectory()
        self.queue = Queue(Path(self.folder.name) / "q.sqlite")
        self.ids: list[int] = []
        self.final: dict[int, str] = {}

    @rule(workspace=st.sampled_from("abc"), priority=st.integers(-2, 2))
    def submit(self, workspace: str, priority: int) -> None:
        self.ids.append(self.queue.submit(_request(workspace, priority)).id)

    @rule()
    def claim(self) -> None:
        waiting = [j for j in self.queue.page() if j.state == "queued"]
        busy = {j.request.workspace for j in self.queue.page() if j.state == "running"}
        free = [j for j in waiting if j.request.workspace not in busy]
        job = self.queue.claim("cpu")
        expected = min(free, key=lambda j: (-j.request.priority, j.id)).id if free else None
        assert (job.id if job else None) == expected

    @precondition(lambda self: self.ids)
    @rule(data=st.data(), state=st.sampled_from(FINAL))
    def finish(self, data: st.DataObject, state: str) -> None:
        self.queue.finish(data.draw(st.sampled_from(self.ids)), state)  # type: ignore[arg-type]

    @rule()
    def crash(self) -> None:
        self.queue.recover()

    @precondition(lambda self: self.ids)
    @rule(data=st.data(), what=st.sampled_from(["cancel", "retry"]))
    def wish(self, data: st.DataObject, what: str) -> None:
        job = data.draw(st.sampled_from(self.ids))
        before = self.queue.get(job)
        assert before is not None
        allowed = ("queued", "running") if what == "cancel" else ("failed", "cancelled")
        if before.state in allowed:
            after = getattr(self.queue, what)(job)
            assert after.state in (("cancelled", "running") if what == "cancel" else ("queued",))
            self.final.pop(job, None)
        else:
            with pytest.raises(WrongState):
                getattr(self.queue, what)(job)

    @invariant()
    def nothing_lost(self) -> None:
        found = {job.id: job for job in self.queue.page(limit=1000)}
        assert sorted(found) == sorted(self.ids)
        running = Counter(job.request.workspace for job in found.values() if job.state == "running")
        assert all(count == 1 for count in running.values())
        for job, state in self.final.items():
            assert found[job].state == state
        self.final = {job.id: job.state for job in found.values() if job.state in FINAL}
        for job in found.values():
            states = [event.data["state"] for event in self.queue.events(job.id) if event.kind == "state"]
            assert states[-1] == job.state

    def teardown(self) -> None:
        self.queue.close()
        self.folder.cleanup()


TestLife = Life.TestCase
TestLife.settings = settings(max_examples=15, stateful_step_count=25, deadline=None)
