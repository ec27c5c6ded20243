"""Old logs and events go, those of jobs that wait or run never do."""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path
from typing import Any

import pytest
from tests.service.harness import Server, empty_workspace

from dnrpipe.core.errors import UserError
from dnrpipe.service.config import ServerConfig
from dnrpipe.service.models import FINAL, JobRequest
from dnrpipe.service.queue import BATCH, DAY, Queue
from dnrpipe.service.root import ServiceRoot

NOW = 1_000 * DAY


class Place:
    """A root with a queue in it, and jobs of any age."""

    def __init__(self, folder: Path) -> None:
        self.root = ServiceRoot(folder).create()
        self.queue = Queue(self.root.queue)

    def job(self, state: str, days: float = 0.0, *, told: bool = True) -> int:
        """A job that came to ``state`` so many days ago, with a log and (told) events."""
        job = self.queue.submit(JobRequest(command="report", workspace=f"w{time.monotonic_ns()}", priority=99)).id
        if state != "queued":
            claimed = self.queue.claim("cpu")
            while claimed is not None and claimed.id != job:  # older ones that wait
                self.queue.requeue(claimed.id, crashed=False, why="not this one")
                claimed = self.queue.claim("cpu")
            assert claimed is not None
        if told:
            self.queue.add_events(job, [{"time": 1.0, "kind": "message", "text": "a"}])
            self.root.log(job).write_text("what it printed")
            self.root.events(job).write_text("{}")
        if state in FINAL:
            self.queue.finish(job, state)  # type: ignore[arg-type]
        with sqlite3.connect(self.root.queue) as db:
            moment = NOW - days * DAY
            db.execute("UPDATE jobs SET created = ?, started = ? WHERE id = ?", (moment, moment, job))
            db.execute("UPDATE jobs SET finished = ? WHERE id = ? AND finished IS NOT NULL", (moment, job))
        return job

    def prune(self, **limits: Any) -> list[int]:
        return self.queue.prune(self.root, ServerConfig(root=self.root.folder, **limits), NOW)

    def told(self, job: int) -> tuple[bool, bool, bool]:
        """(events other than states, a log, an event file)"""
        events = any(event.kind != "state" for event in self.queue.events(job))
        return events, self.root.log(job).exists(), self.root.events(job).exists()


EVERYTHING, NOTHING = (True, True, True), (False, False, False)


def test_by_age(tmp_path: Path) -> None:
    place = Place(tmp_path)
    old = {state: place.job(state, 31) for state in FINAL}
    young = [place.job(state, 29) for state in FINAL]
    assert sorted(place.prune()) == sorted(old.values())
    assert all(place.told(job) == NOTHING for job in old.values())
    assert all(place.told(job) == EVERYTHING for job in young)
    for state, job in old.items():  # the job and how it ended are still known
        found = place.queue.get(job)
        assert found is not None and found.state == state
        assert [e.data["state"] for e in place.queue.events(job)] == ["queued", "running", state]
    assert place.prune() == []  # there is nothing left to do


def test_what_waits_or_runs_is_never_touched(tmp_path: Path) -> None:
    place = Place(tmp_path)
    running, again = place.job("running", 400), place.job("failed", 400)
    place.queue.retry(again)
    queued = place.job("queued", 400)
    assert place.prune(keep_days=0.001, keep_jobs=1) == []
    assert [place.told(job) for job in (running, again, queued)] == [EVERYTHING] * 3


def test_by_number(tmp_path: Path) -> None:
    """Those that ended last are kept, whichever was submitted first."""
    place = Place(tmp_path)
    first, second, third = place.job("done", 1), place.job("failed", 3), place.job("done", 2)
    assert place.prune(keep_jobs=2) == [second]
    assert [place.told(job) for job in (first, second, third)] == [EVERYTHING, NOTHING, EVERYTHING]


def test_files_that_are_left_alone(tmp_path: Path) -> None:
    """Of a job without events, files go as well; files of no job stay; more jobs than fit into one transaction."""
    place = Place(tmp_path)
    quiet = place.job("done", 50, told=False)
    place.root.log(quiet).write_text("it said nothing else")
    strangers = [place.root.log(9999), place.root.private / "logs" / "notes.log"]
    for path in strangers:
        path.write_text("not of a job")
    many = [place.job("done", 50) for _ in range(BATCH + 5)]
    assert sorted(place.prune()) == [quiet, *many]
    assert not place.root.log(quiet).exists() and all(path.exists() for path in strangers)


def test_a_job_that_is_tried_again_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the look at the jobs and the removal it was queued again: its log is kept."""
    place = Place(tmp_path)
    job = place.job("failed", 50)
    look = place.queue._prunable_jobs

    def slow(*arguments: Any) -> list[list[int]]:
        found = look(*arguments)
        assert found == [[job]]
        place.queue.retry(job)
        return found

    monkeypatch.setattr(place.queue, "_prunable_jobs", slow)
    assert place.prune() == [] and place.told(job) == EVERYTHING


def test_the_server_does_it(tmp_path: Path) -> None:
    """A server that starts removes what is past its limits."""
    place = Place(tmp_path / "root")
    empty_workspace(place.root.folder, "w")
    jobs = [place.job("done", days) for days in (3, 2, 1)]
    place.queue.close()
    server = Server(place.root.folder, "--keep-jobs", "2", "--keep-days", "36500")
    try:
        deadline = time.monotonic() + 30
        while place.root.log(jobs[0]).exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        with server.client() as client:
            assert client.log(jobs[0]).text == "" and client.log(jobs[1]).text == "what it printed"
            assert [e.kind for e in client.events(jobs[0])] == ["state"] * 3
            assert [e.kind for e in client.events(jobs[2])] == ["state", "state", "message", "state"]
    finally:
        server.stop()


@pytest.mark.parametrize("days", ["0", "-1", "nan", "1e9"])
def test_nonsense_is_refused(days: str) -> None:
    from dnrpipe.cli.service import serve

    with pytest.raises(UserError, match="--keep-days"):
        serve.main(["--keep-days", days], standalone_mode=False)
