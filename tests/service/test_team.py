"""Several users of one server: roles and owners, search, downloads, deleting and restoring, webhooks."""

from __future__ import annotations

import json
import socket
import sqlite3
import threading
import time
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any, ClassVar

import httpx
import pytest
from tests.service.harness import Server, empty_workspace

from dnrpipe.core.errors import UserError
from dnrpipe.service import webhooks
from dnrpipe.service.client import Client, Refused
from dnrpipe.service.models import FINAL, Job, JobRequest
from dnrpipe.service.queue import Queue
from dnrpipe.service.root import ServiceRoot, UnknownName
from dnrpipe.service.users import User, read_users
from dnrpipe.service.webhooks import address_of, check_webhook

TOKENS = {name: f"the-token-of-{name}" for name in ("vera", "sam", "sue", "ada", "wim")}
ROLES = {"vera": "viewer", "sam": "submitter", "sue": "submitter", "ada": "admin", "wim": "worker"}


class Receiver(BaseHTTPRequestHandler):
    """Keeps what it is told; /hooks/moved sends elsewhere."""

    heard: ClassVar[list[tuple[str, dict[str, Any]]]] = []

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.heard.append((self.path, body))
        self.send_response(302 if self.path == "/hooks/moved" else 204)
        self.send_header("Location", "/hooks/elsewhere")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture(scope="module")
def receiver() -> Iterator[str]:
    """Address of a server that takes webhooks."""
    found = HTTPServer(("127.0.0.1", 0), Receiver)
    threading.Thread(target=found.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{found.server_port}"
    found.shutdown()


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory, receiver: str) -> Iterator[Server]:
    """A server with a user of each role."""
    folder = tmp_path_factory.mktemp("team")
    tokens = folder / "tokens"
    tokens.write_text("# who may do what\n" + "".join(f"{n} {ROLES[n]} {t}\n" for n, t in TOKENS.items()))
    tokens.chmod(0o600)
    server = Server(folder / "root", "--token-file", str(tokens), "--webhook", f"{receiver}/hooks/", "--rate", "500")
    yield server
    server.stop()


def _as(server: Server, name: str) -> Client:
    return server.client(TOKENS[name])


def _ended(client: Client, job: int, seconds: float = 60) -> Job:
    deadline = time.monotonic() + seconds
    while (found := client.job(job)).state not in FINAL:
        assert time.monotonic() < deadline, found
        time.sleep(0.1)
    return found


def _fails(name: str) -> JobRequest:
    """A job that fails within a second."""
    return JobRequest(command="finetune", workspace=name)


def test_what_each_role_may_do(team: Server) -> None:
    empty_workspace(team.root, "shared")
    with _as(team, "vera") as vera, _as(team, "sam") as sam, _as(team, "sue") as sue, _as(team, "ada") as ada:
        assert [entry.name for entry in vera.workspaces()] == ["shared"]
        with pytest.raises(Refused, match="vera is a viewer here"):
            vera.submit(_fails("shared"))
        job = sam.submit(_fails("shared"))
        assert job.owner == "sam" and _ended(vera, job.id).state == "failed"
        for other in (vera, sue):
            with pytest.raises(Refused) as refused:
                other.retry(job.id)
            assert refused.value.status == 403
        assert sam.retry(job.id).state == "queued" and _ended(sam, job.id).state == "failed"
        assert ada.retry(job.id).state == "queued" and _ended(sam, job.id).state == "failed"
        assert [entry.owner for entry in vera.workspaces()] == ["sam"]
        with pytest.raises(Refused, match="only they and admins"):
            sue.delete("shared")
    with _as(team, "wim") as wim, pytest.raises(Refused, match="wim is a worker here"):
        wim.workspaces()
    leases = httpx.post(f"{team.url}/leases", headers={"Authorization": f"Bearer {TOKENS['sam']}"})
    assert leases.status_code == 403


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("", "has no token"),
        ("ada admin", "expected NAME ROLE TOKEN"),
        ("ada boss sixteen-letters-0", "is no role"),
        ("ada admin short", "is no token"),
        ("ada admin sixteen-letters-0\nada viewer sixteen-letters-1", "is twice there"),
        ("ada admin sixteen-letters-0\nbob viewer sixteen-letters-0", "the token is twice there"),
        ("a/b admin sixteen-letters-0", "no name"),
    ],
)
def test_a_token_file_that_is_wrong_is_refused(tmp_path: Path, text: str, wrong: str) -> None:
    file = tmp_path / "tokens"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(UserError, match=wrong):
        read_users(file)


def test_one_token_alone_is_the_admins(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("sixteen-letters-0\n")
    file.chmod(0o600)
    assert read_users(file) == {"sixteen-letters-0": User("admin", "admin")}


def test_search_and_pages(tmp_path: Path) -> None:
    queue = Queue(tmp_path / "queue.sqlite")
    for number in range(7):
        queue.submit(_fails(f"chair-{number}"), owner="sam" if number % 2 else "sue")
    queue.submit(JobRequest(command="report", workspace="TABLE_%"[:5]), owner="sam")
    assert [job.id for job in queue.page(search="SAM chair")] == [6, 4, 2]
    assert [job.id for job in queue.page(search="report")] == [8]
    assert queue.page(search="%") == [] and queue.page(search="_x") == []
    assert [job.id for job in queue.page(search="sam", before=6, limit=2)] == [4, 2]
    assert queue.owners()["chair-1"] == "sam"


def test_a_queue_of_the_former_schema_is_taken_over(tmp_path: Path) -> None:
    queue = Queue(tmp_path / "queue.sqlite")
    queue.submit(_fails("old"), owner="sam")
    queue.close()
    with sqlite3.connect(tmp_path / "queue.sqlite") as db:
        present = {row[1] for row in db.execute("PRAGMA table_info(jobs)")}
        db.execute("DROP INDEX jobs_leased")
        leases = {"lost", "lease", "lease_until", "lease_beat", "lease_result"}
        for column in present & {"owner", "hook_due", "hook_tries", *leases}:
            db.execute(f"ALTER TABLE jobs DROP COLUMN {column}")
        db.execute("PRAGMA user_version = 1")
    db.close()
    queue = Queue(tmp_path / "queue.sqlite")
    assert queue.get(1).owner is None and queue.submit(_fails("new"), owner="sue").owner == "sue"
    assert queue.claim("box/cpu", lease="a-lease", seconds=60) is not None and queue.extend("a-lease", 60).lost == 0
    queue.close()
    Queue(tmp_path / "queue.sqlite").close()


def test_deleted_workspaces_can_be_restored(team: Server, tmp_path: Path) -> None:
    empty_workspace(team.root, "gone")
    (team.root / "gone.dnr" / "kept.txt").write_text("still here")
    with _as(team, "sam") as sam, _as(team, "ada") as ada:
        job = sam.submit(_fails("gone"))
        if sam.job(job.id).state not in FINAL:
            with pytest.raises(Refused, match="a job waits for it or works in it"):
                ada.delete("gone")
        _ended(sam, job.id)
        deleted = sam.delete("gone")
        assert deleted.name == "gone" and 6.9 < (deleted.until - time.time()) / 86_400 <= 7
        assert "gone" not in [entry.name for entry in sam.workspaces()]
        with pytest.raises(Refused, match="no such workspace"):
            sam.submit(_fails("gone"))
        empty_workspace(team.root, "gone")
        with pytest.raises(Refused, match="there is a workspace of this name again"):
            sam.restore(deleted.id)
        ada.delete("gone")
        sam.restore(deleted.id)
        assert (team.root / "gone.dnr" / "kept.txt").read_text() == "still here"
        with pytest.raises(Refused, match="no deleted workspace"):
            ada.restore("1-nothing")
    root = ServiceRoot(tmp_path / "root").create()
    empty_workspace(root.folder, "old")
    put_away = root.delete("old")
    root.drop_deleted(time.time() - 60)
    assert [entry[0] for entry in root.restorable()] == [put_away]
    root.drop_deleted(time.time() + 60)
    with pytest.raises(UnknownName):
        root.restore(put_away)


def test_what_is_made_can_be_downloaded(server: Server, trained: str, tmp_path: Path) -> None:
    """A movie and an export, made by jobs; nothing else of the workspace."""
    with server.client() as client:
        movie = client.submit(JobRequest(command="render", workspace=trained, orbit=3, settings={"cameras.width": 48}))
        exported = client.submit(JobRequest(command="export-nerf", workspace=trained))
        for job in (movie, exported):
            assert _ended(client, job.id, 240).state == "done", client.log(job.id).text
        found = {result.file: result for result in client.results(trained)}
        movies = [file for file, result in found.items() if result.kind == "movie"]
        assert movies == ["renders/orbit-3/orbit-3.mp4"] and {"renders/orbit-3.zip", "exports/nerf.zip"} <= set(found)
        client.download(trained, movies[0], tmp_path / "orbit.mp4")
        assert (tmp_path / "orbit.mp4").read_bytes() == (server.root / f"{trained}.dnr" / movies[0]).read_bytes()
        client.download(trained, "renders/orbit-3.zip", tmp_path / "frames.zip")
        with zipfile.ZipFile(tmp_path / "frames.zip") as archive:
            assert archive.testzip() is None
            assert sum(name.startswith("orbit-3/frame_") for name in archive.namelist()) == 3
        deadline = time.monotonic() + 10  # removed once it is sent
        while list((server.root / ".service").glob("*.zip")):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        for file in ("manifest.json", "renders/../manifest.json", "../../etc/passwd", "renders/none.zip"):
            with pytest.raises(Refused):
                client.download(trained, file, tmp_path / "no")
            assert not (tmp_path / "no").exists()
        with pytest.raises(Refused, match="takes none"):
            client.submit(JobRequest(command="export-nerf", workspace=trained, settings={"select.budget": 3}))
        with pytest.raises(Refused, match="only render does"):
            client.submit(JobRequest(command="report", workspace=trained, orbit=3))


def test_a_webhook_is_told_once_and_redirects_are_not_followed(team: Server, receiver: str) -> None:
    empty_workspace(team.root, "hooked")
    Receiver.heard.clear()
    with _as(team, "sam") as sam:
        jobs = [
            sam.submit(_fails("hooked").model_copy(update={"webhook": f"{receiver}/hooks/{path}"}))
            for path in ("told", "moved")
        ]
        for job in jobs:
            _ended(sam, job.id)
        for refused in (f"{receiver}/other", "http://127.0.0.1:1/hooks/x", f"{receiver}/hooks/../other"):
            with pytest.raises(Refused, match="not an address that this server calls"):
                sam.submit(_fails("hooked").model_copy(update={"webhook": refused}))
    deadline = time.monotonic() + 20
    while len(Receiver.heard) < 2:
        assert time.monotonic() < deadline, Receiver.heard
        time.sleep(0.1)
    time.sleep(2)
    assert sorted(path for path, _ in Receiver.heard) == ["/hooks/moved", "/hooks/told"]
    told = dict(Receiver.heard)["/hooks/told"]
    assert (told["id"], told["state"], told["owner"]) == (jobs[0].id, "failed", "sam")
    assert "webhook failed" in team.log.read_text()  # of the redirect


def test_a_name_that_leads_into_the_network_is_not_called(monkeypatch: pytest.MonkeyPatch) -> None:
    allowed = ("https://hooks.example.org/ci", "http://10.0.0.5:8080")
    check_webhook("https://hooks.example.org/ci/12", allowed)
    for url in (
        "https://hooks.example.org/cinema",
        "http://hooks.example.org/ci",
        "https://hooks.example.org:444/ci",
        "https://user@hooks.example.org/ci",
        "https://hooks.example.org.evil.example/ci",
    ):
        with pytest.raises(ValueError, match="allows it no more"):
            address_of(url, allowed)

    def lead_to(address: str) -> None:
        answer = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 443))]
        monkeypatch.setattr(webhooks.socket, "getaddrinfo", lambda *_, **__: answer)

    for address in ("127.0.0.1", "10.1.2.3", "169.254.169.254", "::1", "100.64.0.1"):
        lead_to(address)
        with pytest.raises(ValueError, match="private network"):
            address_of("https://hooks.example.org/ci", allowed)
    lead_to("93.184.215.14")
    assert address_of("https://hooks.example.org/ci", allowed) == "93.184.215.14"
    lead_to("10.0.0.5")
    assert address_of("http://10.0.0.5:8080/x", allowed) == "10.0.0.5"
