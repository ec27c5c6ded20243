"""Who gets in, what they can name, how much they can send. Raw sockets where a client would tidy up."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from tests.service.harness import Server, empty_workspace
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from dnrpipe.core.errors import UserError
from dnrpipe.service.client import Refused
from dnrpipe.service.models import JobRequest
from dnrpipe.service.root import ServiceRoot, UnknownName
from dnrpipe.service.users import read_token

TOKEN = "correct-horse-battery-staple"


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that others can reach, with a token; uploads of 1 MiB at most, and few requests at once."""
    folder = tmp_path_factory.mktemp("closed")
    token = folder / "token"
    token.write_text(TOKEN + "\n")
    token.chmod(0o600)
    server = Server(
        folder / "root", "--host", "0.0.0.0", "--token-file", str(token), "--upload-mb", "1", "--rate", "15"
    )
    server.url = server.url.replace("0.0.0.0", "127.0.0.1")
    yield server
    server.stop()


def _raw(server: Server, request: bytes) -> tuple[int, bytes]:
    """(status, whole answer) of bytes that no client would send."""
    place = urlsplit(server.url)
    with socket.create_connection((place.hostname, place.port or 80), timeout=30) as connection:
        connection.sendall(request)
        answer = b""
        while part := connection.recv(65536):
            answer += part
    return int(answer.split()[1]), answer


def test_token(closed: Server) -> None:
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": f"Basic {TOKEN}"}):
        answer = httpx.get(f"{closed.url}/jobs", headers=headers)
        assert answer.status_code == 401 and "www-authenticate" in answer.headers
    assert httpx.get(f"{closed.url}/jobs?token={TOKEN}&access_token={TOKEN}").status_code == 401
    with closed.client(TOKEN) as client:
        assert list(client.jobs()) == []
    with closed.client("wrong-but-long-enough") as client, pytest.raises(Refused, match="token"):
        client.submit(JobRequest(command="report", workspace="a"))
    for path in ("/", "/healthz", "/static/app.js"):  # hold no data; the page asks for the token
        assert httpx.get(closed.url + path).status_code == 200
    for path in ("/openapi.json", "/metrics", "/workspaces", "/scenes"):
        assert httpx.get(closed.url + path).status_code == 401
    log = closed.log.read_text()
    assert '"status": 401' in log and TOKEN not in log and "wrong-but-long" not in log


def test_websocket_wants_the_token_too(closed: Server) -> None:
    url = closed.url.replace("http", "ws") + "/workspaces/none/live"
    with pytest.raises(InvalidStatus) as refused:
        connect(url, subprotocols=["dnrpipe.live"])  # type: ignore[list-item]
    assert refused.value.response.status_code == 403
    with connect(url, subprotocols=["dnrpipe.live", f"dnrpipe.token.{TOKEN}"]) as live:  # type: ignore[list-item]
        assert live.subprotocol == "dnrpipe.live"
        assert "no such workspace" in str(live.recv(timeout=30))


def test_no_token_for_others_no_server(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="--token-file"):
        Server(tmp_path / "root", "--host", "0.0.0.0")
    for text, mode, word in ((TOKEN, 0o644, "chmod 600"), ("short", 0o600, "16 to 256"), ("x y" * 9, 0o600, "letters")):
        file = tmp_path / "token"
        file.write_text(text)
        file.chmod(mode)
        with pytest.raises(UserError, match=word):
            read_token(file)


def test_oversize(closed: Server) -> None:
    headers = {"Authorization": f"Bearer {TOKEN}"}
    big = b"x" * (2 << 20)
    assert httpx.put(f"{closed.url}/scenes/big.blend", content=big, headers=headers).status_code == 413
    pieces = (big[: 1 << 18] for _ in range(8))  # no length is said beforehand
    assert httpx.put(f"{closed.url}/scenes/big.blend", content=pieces, headers=headers).status_code == 413
    assert httpx.post(f"{closed.url}/jobs", content=big, headers=headers).status_code == 413
    assert httpx.put(f"{closed.url}/scenes/none.blend", content=b"", headers=headers).status_code == 422
    assert [path.name for path in (closed.root / "scenes").iterdir()] == []


def test_rate(tmp_path: Path) -> None:
    """After a burst requests are turned away, with the time to wait; who waits is let in again."""
    server = Server(tmp_path / "root", "--rate", "1")
    try:
        with httpx.Client() as client:
            answers = [client.get(f"{server.url}/healthz") for _ in range(40)]
        assert answers[0].status_code == 200
        turned_away = [answer for answer in answers if answer.status_code == 429]
        assert turned_away and int(turned_away[0].headers["retry-after"]) >= 1
        with server.client() as patient:
            assert list(patient.jobs()) == []
    finally:
        server.stop()


def test_guessing_tokens_is_slowed_down(closed: Server) -> None:
    codes = []
    for number in range(40):
        codes.append(httpx.get(f"{closed.url}/jobs", headers={"Authorization": f"Bearer guess-{number}"}).status_code)
        if codes[-1] == 429:
            break
    assert set(codes) == {401, 429}
    with closed.client(TOKEN) as client:  # who has the token is not locked out with them
        assert list(client.jobs()) == []


@pytest.mark.robustness  # half a minute of waiting for the server's patience to end
def test_slow_senders_are_hung_up_on(server: Server) -> None:
    """Half a head, half a head after an answer, a body that does not come: each ends, and others are answered."""
    host = urlsplit(server.url).netloc
    whole = f"GET /healthz HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()
    half = b"GET /jobs HTTP/1.1\r\nX-Slow: "
    bodiless = f"POST /jobs HTTP/1.1\r\nHost: {host}\r\nContent-Length: 100\r\n\r\n".encode()
    place = urlsplit(server.url)
    slow = []
    for first in (half, whole, bodiless) * 10:
        connection = socket.create_connection((place.hostname, place.port or 80), timeout=90)
        connection.sendall(first)
        if first is whole:
            assert connection.recv(65536).startswith(b"HTTP/1.1 200")
            connection.sendall(half)
        slow.append(connection)
    assert httpx.get(f"{server.url}/healthz").status_code == 200
    for connection in slow:
        while connection.recv(65536):  # an answer may come before the end
            pass
        connection.close()


def test_a_proxy_is_believed_where_it_is_named(closed: Server, tmp_path: Path) -> None:
    """X-Forwarded-For decides neither the log nor the rate, unless its sender is trusted."""
    public, token = "https://render.example.org", {"Authorization": f"Bearer {TOKEN}"}
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    with pytest.raises(AssertionError, match="--token-file"):
        Server(tmp_path / "open", "--public-url", public)
    for options in (("--public-url", "https://a:b:c"), ("--trusted-proxy", "*")):
        with pytest.raises(AssertionError, match=f"{options[0]} .*: expected"):
            Server(tmp_path / "refused", "--token-file", str(file), *options)
    behind = Server(
        tmp_path / "behind", "--token-file", str(file), "--trusted-proxy", "127.0.0.1", "--public-url", public
    )
    try:
        forged = token | {"X-Forwarded-For": "203.0.113.7"}
        assert httpx.get(f"{closed.url}/healthz", headers=forged).status_code == 200
        assert httpx.get(f"{behind.url}/healthz", headers=forged).status_code == 200
        for _ in range(200):  # the line is written once the answer is sent
            if "203.0.113.7" in behind.log.read_text():
                break
            time.sleep(0.05)
        assert "203.0.113.7" not in closed.log.read_text() and "203.0.113.7" in behind.log.read_text()
        for headers, status in (
            ({"X-Forwarded-Host": "render.example.org", "Origin": public}, 200),
            ({"Host": "render.example.org", "Origin": public}, 200),
            ({"Host": "render.example.org", "Origin": "http://render.example.org:81"}, 403),
            ({"X-Forwarded-Host": "evil.example"}, 421),
            ({"Origin": "https://evil.example"}, 403),
            ({"Host": "evil_host.x"}, 421),
        ):
            assert httpx.get(f"{behind.url}/jobs", headers=token | headers).status_code == status, headers
    finally:
        behind.stop()


def test_a_preview_leads_nowhere(server: Server, tmp_path: Path) -> None:
    empty_workspace(server.root, "led")
    (tmp_path / "secret.json").write_text('{"split": "val", "view": "secret", "epoch": 1, "epochs": 1, "files": {}}')
    preview = server.root / "led.dnr" / "preview"
    preview.mkdir()
    (preview / "preview.json").symlink_to(tmp_path / "secret.json")
    answer = httpx.get(f"{server.url}/workspaces/led/preview")
    assert answer.status_code == 404 and "secret" not in answer.text


def test_nothing_is_announced_before_it_is_there(server: Server, tmp_path: Path) -> None:
    """A port in use: one error line, and no word of serving."""
    command = [sys.executable, "-m", "dnrpipe.cli", "serve", "--root", str(tmp_path / "r"), "--port", str(server.port)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "serving" not in done.stdout and "cannot be listened on" in done.stderr


@pytest.mark.parametrize(
    "path",
    [
        "/workspaces/../../etc/passwd",
        "/workspaces/..%2f..%2fetc%2fpasswd",
        "/workspaces/%2e%2e",
        "/workspaces/outside",
        "/workspaces/a%00b",
        "/workspaces/outside/report",
        "/workspaces/outside/pictures/0000/truth",
        "/workspaces/halfway/pictures/..%2f..%2fmanifest/truth",
        "/static/../server.py",
        "/static/..%2fserver.py",
        "/static/%2fetc%2fpasswd",
        "/static/",
        "/.service/queue.sqlite",
        "/scenes/..%2f.service%2fqueue.sqlite",
        "/jobs/..%2f..%2fetc/logs",
        "//etc/passwd",
    ],
)
def test_nothing_outside_the_root(server: Server, path: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Names, dots, links: nothing leads out, and nothing is listed."""
    link = server.root / "outside.dnr"
    if not link.is_symlink():
        outside = tmp_path_factory.mktemp("outside")
        empty_workspace(outside, "secret")
        link.symlink_to(outside / "secret.dnr")
    host = urlsplit(server.url).netloc
    status, answer = _raw(server, f"GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
    assert status in (404, 405, 422), answer
    assert b"root:" not in answer and b"SQLite" not in answer and b"secret" not in answer


def test_jobs_name_nothing_outside(server: Server) -> None:
    empty_workspace(server.root, "mine")
    post = f"{server.url}/jobs"
    for change in (
        {"workspace": "../mine"},
        {"workspace": "/etc"},
        {"workspace": "outside"},
        {"workspace": "none"},
        {"scene": "../../etc/passwd"},
        {"command": "run", "scene": "none.blend"},
        {"command": "rm"},
        {"settings": {"cameras.source": "/etc/passwd"}},
        {"settings": {"device": "cuda"}},
        {"settings": {"no.such": 1}},
        {"settings": {"--force": 1}},
        {"preset": "/etc/passwd"},
        {"surprise": 1},
    ):
        answer = httpx.post(post, json={"command": "report", "workspace": "mine"} | change)
        assert answer.status_code in (404, 422), (change, answer.text)
        assert isinstance(answer.json()["detail"], str)


def test_names(tmp_path: Path) -> None:
    root = ServiceRoot(tmp_path / "root").create()
    for name in ("", ".", "..", "a/b", "a\\b", "a\0", "a\n", "-w", ".service", "a" * 65, "ä"):
        with pytest.raises(UnknownName):
            root.workspace(name, must_exist=False)
        with pytest.raises(UnknownName):
            root.scene(f"{name}.blend", must_exist=False)
    assert root.workspace("a-b_C9", must_exist=False).parent == root.folder


def test_other_sites_pages_are_kept_out(server: Server) -> None:
    """What a web page that the user visits could send to the loopback interface."""
    host = urlsplit(server.url).netloc
    for headers, status in (
        ({"Host": "evil.example"}, 421),
        ({"Host": f"{host}.evil.example"}, 421),
        ({"Origin": "https://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://["}, 403),
        ({"Origin": server.url}, 200),
    ):
        assert httpx.get(f"{server.url}/jobs", headers=headers).status_code == status
    body = '{"command": "report", "workspace": "mine"}'
    simple = {"Content-Type": "text/plain", "Origin": "https://evil.example"}  # what needs no preflight
    assert httpx.post(f"{server.url}/jobs", content=body, headers=simple).status_code == 403
    with pytest.raises(InvalidStatus):
        connect(server.url.replace("http", "ws") + "/workspaces/mine/live", origin="https://evil.example")  # type: ignore[arg-type]


def test_headers(server: Server) -> None:
    for path in ("/", "/jobs", "/static/viewer.html", "/none", "/healthz"):
        headers = httpx.get(server.url + path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff" and headers["x-frame-options"] == "DENY"
        assert headers["referrer-policy"] == "no-referrer" and "server" not in headers
