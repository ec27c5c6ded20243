"""Workers on other machines: whole jobs over HTTP, nothing lost, nothing twice, whatever dies, and no file where none
belongs."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import httpx
import pytest
from tests.service.harness import TINY, Server, empty_workspace, processes_of

from dnrpipe.core.workspace import Source, Workspace
from dnrpipe.service import archive
from dnrpipe.service.client import Client, Refused
from dnrpipe.service.lease_client import LeaseClient
from dnrpipe.service.leases import SHA256_HEADER, Beat, Lease, LeaseGone
from dnrpipe.service.models import End, Job, JobRequest, Limits
from dnrpipe.service.queue import MAX_LOSSES, Queue
from dnrpipe.service.remote_worker import _move_source
from dnrpipe.service.root import ServiceRoot
from dnrpipe.service.routes_leases import _scene_of
from dnrpipe.service.worker import job_command
from dnrpipe.stages.pipeline import STAGES
from dnrpipe.stages.session import resolve_settings

SCENE = Path(__file__).parents[2] / "blender_scenes" / "hard" / "emissive_only.blend"
JOBS = 40
LONGER = TINY | {"cameras.train": 400}
"""Of a job that is not done before it is stopped: ten seconds, of which a worker tells every other one."""


class Elsewhere:
    """``dnrpipe worker`` with a root of its own."""

    def __init__(self, server: Server, folder: Path, name: str, *options: str) -> None:
        self.root, self.output = folder / name, folder / f"{name}.log"
        command = [sys.executable, "-m", "dnrpipe.cli", "worker", "--server", server.url, "--root", str(self.root)]
        with self.output.open("w") as sink:
            self.process = subprocess.Popen(
                [*command, "--devices", "cpu", "--name", name, *options], stdout=sink, stderr=sink
            )

    def end(self, number: int) -> int:
        """Send a signal; returns the exit code."""
        self.process.send_signal(number)
        return self.process.wait(timeout=60)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    """A server without workers of its own."""
    server = Server(tmp_path / "server", "--devices", "none", "--rate", "2000")
    yield server
    server.stop()


@pytest.fixture
def start(server: Server, tmp_path: Path) -> Iterator[Callable[..., Elsewhere]]:
    """Starts workers, and ends them."""
    workers: list[Elsewhere] = []

    def begin(name: str, *options: str) -> Elsewhere:
        workers.append(Elsewhere(server, tmp_path / "elsewhere", name, *options))
        return workers[-1]

    (tmp_path / "elsewhere").mkdir()
    yield begin
    for worker in workers:
        if worker.process.poll() is None:
            worker.end(signal.SIGKILL)


def _until(client: Client, job: int, *states: str, seconds: float = 120) -> Job:
    deadline = time.monotonic() + seconds
    while (found := client.job(job)).state not in states:
        assert time.monotonic() < deadline, f"job {job} is still {found.state}"
        time.sleep(0.1)
    return found


def _prepare(client: Client, workspace: str, **fields: object) -> Job:
    """A job that takes some seconds."""
    scene = client.upload(SCENE, "lamp.blend")
    request = JobRequest(command="prepare", workspace=workspace, scene=scene.name, settings=TINY)
    return client.submit(request.model_copy(update=fields))


def _working(client: Client, job: int) -> None:
    """Wait until the job's process has said something, over there and here."""
    next(event for event in client.events(job) if event.kind in ("progress", "message"))


def _states(client: Client, job: int) -> list[str]:
    return [event.data["state"] for event in client.events(job) if event.kind == "state"]


@pytest.mark.robustness
def test_two_workers_share_a_queue_and_one_is_killed(
    server: Server, start: Callable[..., Elsewhere], tmp_path: Path
) -> None:
    """kill -9 of a worker with a job under way: the other does all the rest, and each job is done once."""
    with server.client() as client:
        made = _prepare(client, "w0")
        killed, other = start("killed"), start("other")
        assert _until(client, made.id, "done", "failed").state == "done", client.log(made.id).text
        for number in range(1, JOBS):
            shutil.copytree(server.root / "w0.dnr", server.root / f"w{number}.dnr")
        requests = [JobRequest(command="select", workspace=f"w{n}", settings=TINY) for n in range(JOBS)]
        ids = [client.submit(request).id for request in requests]

        def has_begun() -> bool:
            """Whether the one to be killed is at the beginning of a job."""
            running = [job for job in client.jobs(["running"]) if job.device == "killed/cpu"]
            return any(time.time() - (job.started or 0) < 0.4 for job in running)

        while len([job for job in client.jobs(["done"]) if job.id in ids]) < JOBS // 2 or not has_begun():
            assert killed.process.poll() is None and other.process.poll() is None, killed.output.read_text()
            time.sleep(0.05)
        killed.end(signal.SIGKILL)
        deadline = time.monotonic() + 10
        while processes_of(killed.root):  # what it ran went with it
            assert time.monotonic() < deadline
            time.sleep(0.1)
        jobs = [_until(client, job, "done", "failed", seconds=300) for job in ids]
        assert [job.state for job in jobs] == ["done"] * JOBS
        assert all(_states(client, job).count("done") == 1 for job in ids)
        assert sorted((job.starts, job.lost) for job in jobs) == [(1, 0)] * (JOBS - 1) + [(2, 1)]
        assert next(job.device for job in jobs if job.lost) == "other/cpu"
    for number in range(JOBS):
        assert (server.root / f"w{number}.dnr" / "selection.json").is_file()
    said = [worker.output.read_text().count(": select of w") for worker in (killed, other)]
    assert sum(said) == JOBS + 1 and min(said) > 1
    assert other.end(signal.SIGTERM) == 0
    assert not list(other.root.glob("*/*.dnr"))
    assert not any((server.root / ".service" / "incoming").iterdir())


def test_cancel_and_limits_reach_a_worker(server: Server, start: Callable[..., Elsewhere]) -> None:
    with server.client() as client:
        running = _prepare(client, "halfway", settings=LONGER)
        worker = start("one")
        _working(client, running.id)
        assert processes_of(worker.root / "cpu")
        assert client.cancel(running.id).cancel_requested
        assert _until(client, running.id, "cancelled", "done").exit_code == 130
        assert not processes_of(worker.root / "cpu")
        assert (server.root / "halfway.dnr" / "manifest.json").is_file()  # what it made is kept
        limited = _prepare(client, "limited", limits=Limits(seconds=0.5))
        ended = _until(client, limited.id, "failed", "done")
        assert ended.error and "limit of 0.5 s" in ended.error and ended.device == "one/cpu"
        refused = client.submit(JobRequest(command="finetune", workspace="halfway"))
        ended = _until(client, refused.id, "failed", "done")
        assert ended.exit_code == 2 and ended.error and "has not run" in ended.error
        assert "start 1 on one/cpu" in client.log(refused.id).text and "has not run" in client.log(refused.id).text


@pytest.mark.robustness
def test_a_restart_of_the_server_is_no_end_of_a_job(server: Server, start: Callable[..., Elsewhere]) -> None:
    """kill -9 of the server while a worker elsewhere trains: one start, every epoch told once, all results here."""
    with server.client() as client:
        scene = client.upload(SCENE, "lamp.blend")
        start("steady")
        job = client.submit(JobRequest(command="run", workspace="lamp", scene=scene.name, settings=TINY))
        next(event for event in client.events(job.id) if event.kind == "epoch" and event.data["stage"] == "finetune")
    server.kill()
    time.sleep(3)
    server.start()
    with server.client() as client:
        assert client.job(job.id).state == "running"
        events = list(client.events(job.id))
        ended = client.job(job.id)
        assert ended.state == "done" and ended.starts == 1, client.log(job.id).text
        assert [e.data["state"] for e in events if e.kind == "state"] == ["queued", "running", "done"]
        epochs = [e.data["epoch"] for e in events if e.kind == "epoch" and e.data["stage"] == "finetune"]
        assert epochs == list(range(1, 41))
        found = client.workspace("lamp")
        assert {stage.state for stage in found.stages} == {"done"}
        assert client.log(job.id).text.count("held-out over") == 1
        # Its scene file is found again by the next job, although it was another machine that read it.
        forced = client.submit(JobRequest(command="prepare", workspace="lamp", force=True))
        assert _until(client, forced.id, "done", "failed").state == "done", client.log(forced.id).text
    source = Workspace.open(server.root / "lamp.dnr").manifest.source
    assert source.path == str(server.root / ".service" / "uploads" / scene.sha256 / "lamp.blend")


def test_a_worker_stopped_in_order_gives_its_job_back(server: Server, start: Callable[..., Elsewhere]) -> None:
    with server.client() as client:
        job = _prepare(client, "passed-on", settings=LONGER)
        first = start("first")
        _working(client, job.id)
        assert first.end(signal.SIGTERM) == 0
        found = client.job(job.id)
        assert found.state == "queued" and (found.starts, found.lost) == (1, 0)
        assert (server.root / "passed-on.dnr" / "manifest.json").is_file()
        assert not list(first.root.glob("*/*.dnr")) and not processes_of(first.root / "cpu")
        start("second")
        found = _until(client, job.id, "done", "failed")
        assert found.state == "done" and found.device == "second/cpu"
        assert _states(client, job.id) == ["queued", "running", "queued", "running", "done"]


@pytest.mark.robustness
def test_a_job_that_was_taken_back_is_ended_there(
    server: Server, start: Callable[..., Elsewhere], tmp_path: Path
) -> None:
    """As after a silence that was too long: the worker hears of it, stops what it runs, and forgets it."""
    with server.client() as client:
        job = _prepare(client, "taken-back")
        worker = start("late")
        _working(client, job.id)
        database = sqlite3.connect(server.root / ".service" / "queue.sqlite", timeout=60, isolation_level=None)
        while client.job(job.id).starts == 1:
            database.execute("UPDATE jobs SET lease_until = 0 WHERE lease_until IS NOT NULL AND starts = 1")
            time.sleep(0.02)
        database.close()
        number = worker.process.pid
        while (found := client.job(job.id)).state not in ("done", "failed"):
            assert len(Path(f"/proc/{number}/task/{number}/children").read_text().split()) <= 1  # never both at once
        assert (found.state, found.starts, found.lost) == ("done", 2, 1), client.log(job.id).text
        assert _states(client, job.id) == ["queued", "running", "queued", "running", "done"]
        assert "given up (this lease is over" in worker.output.read_text()


def _tar(*members: tuple[str, bytes | str], removed: Sequence[str] = ()) -> bytes:
    """Content as bytes; a symbolic link's target, or after ``=`` a hard link's, as text."""
    index = json.dumps({"files": len(members), "removed": removed}).encode()
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for name, content in ((archive.INDEX, index), *members):
            info = tarfile.TarInfo(name)
            if isinstance(content, bytes):
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
            else:
                info.type = tarfile.LNKTYPE if content.startswith("=") else tarfile.SYMTYPE
                info.linkname = content.removeprefix("=")
                tar.addfile(info)
    return buffer.getvalue()


def _send(server: Server, lease: Lease, body: bytes, sha256: str | None = None) -> httpx.Response:
    headers = {SHA256_HEADER: sha256 or hashlib.sha256(body).hexdigest()}
    return httpx.put(f"{server.url}/leases/{lease.id}/result", content=body, headers=headers)


def _leased(server: Server, workspace: str) -> Lease:
    empty_workspace(server.root, workspace)
    with server.client() as client, LeaseClient(server.url, None) as worker:
        client.submit(JobRequest(command="report", workspace=workspace))
        lease = worker.take("test", "cpu")
    assert lease is not None
    return lease


def test_what_a_worker_must_not_send_changes_nothing(server: Server, tmp_path: Path) -> None:
    lease = _leased(server, "target")
    workspace = server.root / "target.dnr"
    (workspace / "scene").mkdir()
    (workspace / "scene" / "kept").write_text("as it was")
    (workspace / "out").symlink_to(tmp_path)

    def files() -> dict[Path, bytes]:
        """All but the server's own, and locks."""
        found = [path for path in tmp_path.rglob("*") if path.is_file() and ".service" not in path.parts]
        return {path: path.read_bytes() for path in found if path.suffix != ".log" and path.name != ".lock"}

    before = files()
    good = ("scene/kept", b"new"), ("manifest.json", b"{}")
    whole = _tar(*good)
    bad = {
        "a link": _tar(*good, ("link", "/etc/passwd")),
        "a hard link": _tar(*good, ("link", "=scene/kept")),
        "the folder above": _tar(*good, ("../escaped", b"x")),
        "above in the middle": _tar(*good, ("scene/../../escaped", b"x")),
        "an absolute path": _tar(*good, (f"{tmp_path}/escaped", b"x")),
        "through a link": _tar(*good, ("out/escaped", b"x")),
        "in place of a folder": _tar(*good, ("scene", b"x")),
        "a lock": _tar(*good, (".lock", b"x")),
        "a name twice": _tar(*good, good[0]),
        "no archive": b"x" * 5000,
        "the first file alone": whole[:1024],
        "cut in the middle": whole[:1600],
        "gone, above": _tar(*good, removed=["../server.server.log"]),
    }
    for what, body in bad.items():
        assert _send(server, lease, body).status_code == 422, what
    assert _send(server, lease, whole, sha256="0" * 64).status_code == 422
    assert httpx.put(f"{server.url}/leases/{lease.id}/result", content=whole).status_code == 422  # without a checksum
    assert files() == before and server.log.exists()
    assert not any((server.root / ".service" / "incoming").iterdir())
    with server.client() as client, LeaseClient(server.url, None) as worker:
        with pytest.raises(Refused, match="send its result first"):
            worker.end(lease, End(state="done", exit_code=0))
        assert client.job(lease.job.id).state == "running"
        assert _send(server, lease, whole).status_code == 204
        assert (workspace / "scene" / "kept").read_bytes() == b"new"
        worker.end(lease, End(state="done", exit_code=0))
        assert client.job(lease.job.id).state == "done"
        with pytest.raises(LeaseGone):
            worker.end(lease, End(state="failed"))
        assert _send(server, lease, _tar(("late", b"x"))).status_code == 410 and not (workspace / "late").exists()


def test_a_workspace_survives_the_way_there_and_back(server: Server, tmp_path: Path) -> None:
    """Files of any size and name, changes and what is gone; links and locks stay at home."""
    lease = _leased(server, "there")
    source, copy = server.root / "there.dnr", tmp_path / "copy.dnr"
    large = os.urandom(3 * archive.CHUNK + 7)
    contents = {"a/empty": b"", "a/b/large": large, "ö " + "x" * 150: b"long", "gone/x": b"1"}
    for name, content in contents.items():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes(content)
    (source / "link").symlink_to("/etc/passwd")
    with LeaseClient(server.url, None) as worker:
        worker.fetch_workspace(lease, copy)
        assert {p.relative_to(copy).as_posix() for p in copy.rglob("*") if p.is_file()} == {*contents, "manifest.json"}
        assert all((copy / name).read_bytes() == content for name, content in contents.items())
        before = archive.stamps(copy)
        shutil.rmtree(copy / "gone")
        (copy / "a" / "new").write_bytes(b"new")
        (copy / "a" / "empty").write_bytes(b"not any more")
        after = archive.stamps(copy)
        changed = [name for name in after if before.get(name) != after[name]]
        assert sorted(changed) == ["a/empty", "a/new"]
        worker.send_result(lease, copy, changed, before.keys() - after.keys(), lambda: None)
        worker.end(lease, End(state="done", exit_code=0))
    assert (source / "a" / "new").read_bytes() == b"new" and (source / "a" / "empty").read_bytes() == b"not any more"
    assert not (source / "gone").exists() and (source / "link").is_symlink()
    assert (source / "a" / "b" / "large").read_bytes() == large


def test_heartbeats_tell_everything_once(server: Server) -> None:
    lease = _leased(server, "beating")
    event = {"time": 1.0, "kind": "message", "level": "info", "text": "ö" * 1000}
    with server.client() as client, LeaseClient(server.url, None) as worker:
        beat = Beat.model_validate({"number": 1, "events": [event], "log": "YWJjCg=="})
        for _ in range(3):  # its answer was lost twice
            answer = worker.beat(lease, beat)
            assert answer is not None and not answer.cancelled
        assert client.log(lease.job.id).text == "abc\n"
        client.cancel(lease.job.id)
        answer = worker.beat(lease, Beat(number=2))
        assert answer is not None and answer.cancelled
        state = {"number": 3, "events": [{"time": 1.0, "kind": "state", "state": "done"}]}
        assert httpx.post(f"{server.url}/leases/{lease.id}", json=state).status_code == 422
        worker.end(lease, End(state="cancelled", exit_code=130))
        told = list(client.events(lease.job.id))
        assert [e.kind for e in told] == ["state", "state", "message", "state"] and told[2].data["text"] == "ö" * 1000


def test_who_is_not_wanted_is_told_in_one_line(tmp_path: Path) -> None:
    """Another role, no token, another version, no server, and somebody else's folder as its root."""
    users = tmp_path / "users"
    users.write_text("vera viewer the-token-of-vera\nwim worker the-token-of-wim\n")
    for name in ("vera", "wim"):
        (tmp_path / name).write_text(f"the-token-of-{name}\n")
    for path in (users, tmp_path / "vera", tmp_path / "wim"):
        path.chmod(0o600)
    server = Server(tmp_path / "server", "--devices", "none", "--token-file", str(users))
    try:

        def said(*options: str, url: str = server.url) -> str:
            command = [sys.executable, "-m", "dnrpipe.cli", "worker", "--server", url, "--root", str(tmp_path / "w")]
            done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=120, check=False)
            lines = done.stderr.splitlines()
            assert done.returncode == 2 and len(lines) == 1 and lines[0].startswith("dnrpipe: error: "), done.stderr
            return lines[0]

        assert "vera is a viewer here" in said("--token-file", str(tmp_path / "vera"), "--devices", "cpu")
        assert "vera is a viewer here" in said("--token-file", str(tmp_path / "vera"), "--devices", "cpu,cuda:0")
        assert "wrong or missing token" in said("--devices", "cpu")
        mine = ["--token-file", str(tmp_path / "wim"), "--devices", "cpu", "--root", str(tmp_path)]
        (tmp_path / "cpu").mkdir()
        (tmp_path / "cpu" / "precious").touch()
        assert "holds something else" in said(*mine) and (tmp_path / "cpu" / "precious").exists()
        assert "neither cpu nor cuda" in said("--devices", "none")
        headers = {"Authorization": "Bearer the-token-of-wim"}
        wish = {"worker": "old", "device": "cpu", "version": "0.0.1"}
        answer = httpx.post(f"{server.url}/leases", json=wish, headers=headers)
        assert answer.status_code == 409 and "install the same" in answer.json()["detail"]
        assert httpx.get(f"{server.url}/leases", params={"version": "0.0.1"}, headers=headers).status_code == 409
        assert httpx.get(f"{server.url}/jobs", headers=headers).status_code == 403
    finally:
        server.stop()


def test_a_shot_finds_its_scene_and_its_cameras_on_either_machine(tmp_path: Path) -> None:
    """The lease names the file; paths of the manifest follow the workspace, and `prepare` is done there as here."""
    here, there = (ServiceRoot(tmp_path / name).create() for name in ("here", "there"))
    (tmp_path / "part").write_bytes(b"scene")
    sha256 = hashlib.sha256(b"scene").hexdigest()
    here.keep_scene(tmp_path / "part", "lamp.blend", sha256)
    _, scene = here.submitted_scene("lamp.blend", sha256)
    request = JobRequest(command="shot", workspace="lamp", scene="lamp.blend", scene_sha256=sha256)
    found = _scene_of(Job(id=1, state="running", request=request, created=0), here)
    assert found is not None and (found.name, found.sha256) == ("lamp.blend", sha256)
    workspace = Workspace.create(here.folder / "lamp.dnr", Source(path=str(scene), sha256=sha256))
    again = request.model_copy(update={"scene": None, "scene_sha256": None})
    assert _scene_of(Job(id=2, state="running", request=again, created=0), here) == found
    views = workspace.root / "shots" / "Camera" / "candidates.json"
    workspace.manifest.overrides = {"cameras": {"source": str(views), "source_sha256": "1" * 64}}
    workspace.save()
    made_from = STAGES["prepare"].settings(resolve_settings(workspace, {}, None))
    shutil.copytree(workspace.root, there.folder / "lamp.dnr")
    copy = there.folder / "lamp.dnr"
    _move_source(copy, here.folder, there.folder)
    moved = Workspace.open(copy)
    assert Path(moved.manifest.source.path) == there.folder / scene.relative_to(here.folder)
    settings = resolve_settings(moved, {}, None)
    assert Path(settings.cameras.source) == copy / "shots" / "Camera" / "candidates.json"
    assert STAGES["prepare"].settings(settings) == made_from
    _move_source(copy, there.folder, here.folder)
    assert Workspace.open(copy).manifest == workspace.manifest


def test_a_lease_in_the_queue(tmp_path: Path) -> None:
    """A restart leaves it alone, its end queues the job, and `--force` is for the first start that left something."""
    queue, root = Queue(tmp_path / "q.sqlite"), ServiceRoot(tmp_path / "root").create()
    job = queue.submit(JobRequest(command="report", workspace="a", force=True)).id
    queue.submit(JobRequest(command="report", workspace="a"))
    claimed = queue.claim("box/cpu", lease="first", seconds=0.3)
    assert claimed is not None and "--force" in job_command(claimed, root)
    assert queue.claim("cpu") is None  # of the same workspace
    assert queue.recover() == [] and queue.recover("box/cpu") == [] and queue.recover_lapsed() == []
    queue.extend("first", 60)
    time.sleep(0.4)
    assert queue.recover_lapsed() == []
    queue.extend("first", -1)
    assert queue.recover_lapsed() == [job]
    with pytest.raises(LeaseGone):
        queue.extend("first", 60)
    with pytest.raises(LeaseGone), queue.leased("first"):
        pass
    claimed = queue.claim("box/cpu", lease="second", seconds=60)
    assert claimed is not None and (claimed.id, claimed.starts, claimed.lost) == (job, 2, 1)
    assert "--force" in job_command(claimed, root)
    queue.result_came(job)
    queue.end(job, End(state="queued", error="its worker was stopped"))
    claimed = queue.claim("box/cpu", lease="third", seconds=-1)
    assert claimed is not None and (claimed.starts, claimed.lost) == (3, 1)
    assert "--force" not in job_command(claimed, root)
    for _ in range(MAX_LOSSES - 2):
        assert queue.recover_lapsed() == [job]
        assert queue.claim("box/cpu", lease="last", seconds=-1) is not None
    assert queue.recover_lapsed() == [job]
    ended = queue.get(job)
    assert ended.state == "failed" and ended.error and "lost" in ended.error
