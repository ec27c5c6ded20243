"""The server over a real socket: life of a job, kill -9, cancel, refusals, many clients at once."""

from __future__ import annotations

import concurrent.futures
import contextlib
import json
import random
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
import pytest
from tests.service.harness import TINY, Server, empty_workspace, processes_of

from dnrpipe.core.workspace import file_sha256
from dnrpipe.service.client import Client, Refused
from dnrpipe.service.models import FINAL, Job, JobRequest, Limits
from dnrpipe.service.root import ServiceRoot
from dnrpipe.service.state import Remembered

SCENE = Path(__file__).parents[2] / "blender_scenes" / "hard" / "emissive_only.blend"


def _failing(workspace: str) -> JobRequest:
    """A real job that is over within a second: its command refuses to start."""
    return JobRequest(command="finetune", workspace=workspace)


def _until(client: Client, job: int, *states: str, seconds: float = 60) -> Job:
    deadline = time.monotonic() + seconds
    while (found := client.job(job)).state not in states:
        assert time.monotonic() < deadline, f"job {job} is still {found.state}"
        time.sleep(0.05)
    return found


def test_killed_while_it_trains(server: Server, trained: str) -> None:
    """kill -9 of the server in the middle of training: everything dies with it, and the job goes on at the next start.

    The epochs before the kill are not trained again.
    """
    with server.client() as client:
        job = next(j for j in client.jobs() if j.request.workspace == trained)
        assert job.state == "done" and job.starts == 2 and job.crashes == 0
        events = list(client.events(job.id))
        epochs = [e.data["epoch"] for e in events if e.kind == "epoch" and e.data["stage"] == "finetune"]
        # Those under way at the kill: one trained again (told twice), or some saved but not told of yet (not told: an
        # epoch takes milliseconds, the server writes down what it was told several times a second).
        untold = [epoch for epoch in range(1, 41) if epoch not in epochs]
        assert set(epochs) <= set(range(1, 41)) and epochs[-1] == 40 and epochs[:3] == [1, 2, 3]
        assert not untold or untold[-1] - untold[0] + 1 == len(untold) <= 8
        assert len(epochs) - len(set(epochs)) <= 1
        states = [e.data["state"] for e in events if e.kind == "state"]
        assert states == ["queued", "running", "queued", "running", "done"]
        assert [e.id for e in events] == sorted({e.id for e in events})
        assert any(e.kind == "picture" for e in events)
        shown = [e.data["epoch"] for e in events if e.kind == "preview"]
        assert shown[0] == 1 and shown[-1] == 40 and len(shown) >= 3  # and where it went on
        # Taken up in the middle, by the header that browsers send: the rest, nothing twice.
        middle = events[len(events) // 2].id
        assert [e.id for e in client.events(job.id, after=middle)] == [e.id for e in events if e.id > middle]
        assert "held-out over" in client.log(job.id, -5000).text


def test_what_a_workspace_shows(server: Server, trained: str) -> None:
    with server.client() as client:
        assert trained in [w.name for w in client.workspaces() if w.viewable and w.report]
        found = client.workspace(trained)
    assert {stage.state for stage in found.stages} == {"done"}
    assert sorted(v.role for v in found.views) == ["candidate", "candidate", "chosen", "chosen", "test"]
    assert found.costs.traced_views == 2 and found.costs.candidates == 4 and found.costs.total > 0
    assert found.training and found.tests[0].psnr is not None and found.sphere and found.sphere.startswith("<svg")
    base = f"{server.url}/workspaces/{trained}"
    for kind in ("truth", "prediction", "flip"):
        answer = httpx.get(f"{base}/pictures/{found.tests[0].view}/{kind}")
        assert answer.headers["content-type"] == "image/png" and answer.content.startswith(b"\x89PNG")
    report = httpx.get(f"{base}/report")
    assert "sandbox" in report.headers["content-security-policy"] and trained in report.text
    assert httpx.get(f"{base}/pictures/none/truth").status_code == 404


def test_many_clients_at_one_workspace() -> None:
    """Who asks within a second of another gets the same answer; what happens makes it anew, and so does time."""
    made, remembered = [], Remembered()

    def make() -> int:
        time.sleep(0.1)
        made.append(1)
        return len(made)

    with concurrent.futures.ThreadPoolExecutor(60) as pool:
        answers = list(pool.map(lambda _: remembered.get("a", 7, make), range(300)))
    assert answers == [1] * 300
    assert remembered.get("a", 8, make) == 2 and remembered.get("b", 8, make) == 3
    time.sleep(Remembered.SECONDS)
    assert remembered.get("a", 8, make) == 4


def test_uploads_that_nobody_wants_go(tmp_path: Path) -> None:
    root = ServiceRoot(tmp_path / "root").create()
    hashes = []
    for content in (b"first", b"second", b"third"):
        file = root.uploads / ".x.part"
        file.write_bytes(content)
        hashes.append(file_sha256(file))
        assert root.keep_scene(file, "a.blend", hashes[-1]) == (content != b"first")
    assert root.submitted_scene("a.blend", None) == (hashes[2], root.uploads / hashes[2] / "a.blend")
    root.drop_uploads([], time.time() - 60)  # named just now
    assert sorted(folder.name for folder in root.uploads.iterdir()) == sorted(hashes)
    root.drop_uploads([hashes[0]], time.time() + 60)
    assert sorted(folder.name for folder in root.uploads.iterdir()) == sorted([hashes[0], hashes[2]])
    (root.scenes / "hand.blend").write_bytes(b"by hand")
    sha256, kept = root.submitted_scene("hand.blend", None)
    (root.scenes / "hand.blend").unlink()
    assert kept.read_bytes() == b"by hand" and root.submitted_scene("hand.blend", sha256) == (sha256, kept)


def test_settings_of_the_root_count_wherever_the_server_was_started(tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "dnrpipe.toml").write_text("[cameras]\ntrain = 5\n")
    server = Server(tmp_path / "root")
    try:
        with server.client() as client:
            scene = client.upload(SCENE, "a.blend")
            settings = {key: value for key, value in TINY.items() if key != "cameras.train"}
            job = client.submit(JobRequest(command="prepare", workspace="a", scene=scene.name, settings=settings))
            _until(client, job.id, "done", seconds=120)
            states = {stage.stage: stage for stage in client.workspace("a").stages}
        assert states["prepare"].state == "done" and states["prepare"].present == states["prepare"].wanted
    finally:
        server.stop()


def test_a_job_keeps_the_scene_that_it_was_submitted_with(tmp_path: Path) -> None:
    """Another file of that name comes while it waits; which of the two it was is said."""
    server = Server(tmp_path / "root")
    other = SCENE.with_name("all_mirror.blend")
    try:
        with server.client() as client:
            first = client.upload(SCENE, "same.blend")
            assert not first.replaced
            blocking = client.submit(JobRequest(command="prepare", workspace="b", scene="same.blend", settings=TINY))
            waiting = client.submit(JobRequest(command="prepare", workspace="w", scene="same.blend", settings=TINY))
            assert not client.upload(SCENE, "same.blend").replaced  # the same file again
            second = client.upload(other, "same.blend")
            assert second.replaced and second.sha256 != first.sha256
            late = client.submit(JobRequest(command="prepare", workspace="l", scene="same.blend", settings=TINY))
            assert [client.job(job.id).request.scene_sha256 for job in (waiting, late)] == [first.sha256, second.sha256]
            for job in (blocking, waiting, late):
                _until(client, job.id, "done", seconds=180)
            with pytest.raises(Refused, match="no file of content"):
                client.submit(JobRequest(command="run", workspace="n", scene="same.blend", scene_sha256="0" * 64))
        sources = [json.loads((server.root / f"{name}.dnr" / "manifest.json").read_text()) for name in "bwl"]
        assert [source["source"]["sha256"] for source in sources] == [first.sha256, first.sha256, second.sha256]
    finally:
        server.stop()


def test_cancel_in_every_state(server: Server) -> None:
    empty_workspace(server.root, "cancelled")
    with server.client() as client:
        scene = client.upload(SCENE, "cancelled.blend")
        running = client.submit(JobRequest(command="prepare", workspace="halfway", scene=scene.name, settings=TINY))
        queued = client.submit(_failing("cancelled"))
        for event in client.events(running.id):
            if event.kind == "progress" or event.kind == "message":
                break
        assert processes_of(server.root)
        assert client.cancel(queued.id).state == "cancelled"
        assert client.cancel(running.id).cancel_requested
        assert _until(client, running.id, "cancelled").exit_code == 130
        assert not processes_of(server.root)
        assert [e.data["state"] for e in client.events(queued.id)] == ["queued", "cancelled"]
        for job in (queued.id, running.id):
            with pytest.raises(Refused, match="only queued and running") as refused:
                client.cancel(job)
            assert refused.value.status == 409
        # A failed one cannot be cancelled, but tried again.
        assert client.retry(queued.id).state == "queued"
        failed = _until(client, queued.id, "failed")
        assert failed.exit_code == 2 and failed.error and "prepare has not run" in failed.error
        with pytest.raises(Refused, match="is failed"):
            client.cancel(queued.id)


def test_limits_of_a_job(server: Server) -> None:
    """Time, memory and disk: the job is stopped, says why, and is not tried again by itself."""
    with server.client() as client:
        client.upload(SCENE, "limited.blend")
        for limits, word in ((Limits(memory_mb=64), "64 MiB of memory"), (Limits(seconds=0.5), "limit of 0.5 s")):
            job = client.submit(
                JobRequest(command="prepare", workspace="limited", scene="limited.blend", settings=TINY, limits=limits)
            )
            ended = _until(client, job.id, "failed", "done")
            assert ended.error and word in ended.error and ended.starts == 1


def test_stopped_in_order(tmp_path: Path) -> None:
    """SIGTERM: exit code 0, the running job is queued again, and goes on when the server is there again."""
    server = Server(tmp_path / "root")
    try:
        second = subprocess.run(
            [sys.executable, "-m", "dnrpipe.cli", "serve", "--root", str(server.root), "--port", "0"],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert second.returncode == 2 and "another server works here" in second.stderr
        with server.client() as client:
            client.upload(SCENE, "a.blend")
            job = client.submit(JobRequest(command="prepare", workspace="a", scene="a.blend", settings=TINY))
            next(e for e in client.events(job.id) if e.kind in ("progress", "message"))
        assert server.stop() == 0
        rows = sqlite3.connect(server.root / ".service" / "queue.sqlite").execute("SELECT state, starts FROM jobs")
        assert rows.fetchall() == [("queued", 1)]
        assert not processes_of(server.root)
    finally:
        server.stop()


def test_many_clients_lose_nothing(tmp_path: Path) -> None:
    """200 clients at once submit 1,000 jobs; the server is killed with -9 among them and started again.

    Every client gets five jobs of its own, all are in the queue exactly once, and none of another's.
    """
    server = Server(tmp_path / "root", "--rate", "5000")
    try:
        empty_workspace(server.root, "crowd")
        start = threading.Barrier(201)

        def crowd(number: int) -> list[int]:
            with Client(server.url, retry_seconds=120) as client:
                start.wait(timeout=60)
                return [
                    client.submit(_failing("crowd").model_copy(update={"priority": number % 7})).id for _ in range(5)
                ]

        with concurrent.futures.ThreadPoolExecutor(200) as pool:
            found = [pool.submit(crowd, number) for number in range(200)]
            start.wait(timeout=60)
            time.sleep(0.5)
            server.kill()
            server.start()
            ids = [job for answer in found for job in answer.result()]
        assert len(ids) == len(set(ids)) == 1000
        with server.client() as client:
            jobs = list(client.jobs())
        assert sorted(job.id for job in jobs) == sorted(ids)
        assert {job.state for job in jobs} <= {"queued", "running", "failed"}
        ended = [job for job in jobs if job.state == "failed"]
        assert all(job.exit_code == 2 for job in ended)
    finally:
        server.stop()


@pytest.mark.robustness
def test_fifty_kills_under_load_lose_nothing(tmp_path: Path) -> None:
    """kill -9 of the server, 50 times at any moment, while eight clients submit and its worker works.

    What was answered is in the queue once, all of it ends, and no job ended twice.
    """
    server, dice, over = Server(tmp_path / "root", "--rate", "5000"), random.Random(0), threading.Event()
    try:
        for number in range(8):
            empty_workspace(server.root, f"w{number}")

        def submitting(number: int) -> list[int]:
            answered = []
            with Client(server.url, retry_seconds=120) as client:
                while not over.is_set():
                    answered.append(client.submit(_failing(f"w{number}")).id)
                    over.wait(0.5)
            return answered

        with concurrent.futures.ThreadPoolExecutor(8) as pool:
            found = [pool.submit(submitting, number) for number in range(8)]
            for _ in range(50):
                time.sleep(dice.uniform(0.0, 1.5))
                server.kill()
                server.start()
            over.set()
            ids = [job for answer in found for job in answer.result()]
        assert len(ids) == len(set(ids)) > 100
        with server.client() as client:
            jobs = list(client.jobs())
            assert sorted(job.id for job in jobs) == sorted(ids)
            for job in jobs:
                if job.state == "queued":
                    with contextlib.suppress(Refused):  # it began, or ended, meanwhile
                        client.cancel(job.id)
            deadline = time.monotonic() + 120
            while {job.state for job in client.jobs()} - set(FINAL):
                assert time.monotonic() < deadline
                time.sleep(0.5)
            ended = [job for job in client.jobs() if job.state == "failed"]
            assert len(ended) > 20
            for job in ended:
                assert job.exit_code == 2 or "was lost" in str(job.error), job
                states = [event.data["state"] for event in client.events(job.id) if event.kind == "state"]
                assert states[0] == "queued" and sum(state in FINAL for state in states) == 1, states
    finally:
        over.set()
        server.stop()
