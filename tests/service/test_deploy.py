"""The recipe for nginx (`deploy/nginx.conf`), before a server, over real sockets and TLS."""

from __future__ import annotations

import re
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from tests.service.harness import Server, empty_workspace
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from dnrpipe.service.guard import MAX_BODY

REPO = Path(__file__).resolve().parents[2]
PLACES = (f"{REPO}/.cache/nginx/usr/sbin", "/usr/sbin")  # unpacked by `make browser`, or installed
NGINX = shutil.which("nginx") or shutil.which("nginx", path=":".join(PLACES))
RECIPE = REPO / "deploy" / "nginx.conf"
NAME, TOKEN = "render.example.org", "a-token-of-some-length"
SELF_SIGNED = f"req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN={NAME} -addext subjectAltName=DNS:{NAME}"

pytestmark = pytest.mark.skipif(NGINX is None or shutil.which("openssl") is None, reason="no nginx or no openssl")


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


class Proxied:
    """A server, nginx by the recipe in front of it, and clients that know it by its public name."""

    def __init__(self, folder: Path) -> None:
        token = folder / "token"
        token.write_text(TOKEN)
        token.chmod(0o600)
        self.port = _free_port()
        self.url = f"https://{NAME}:{self.port}"
        behind = ("--trusted-proxy", "127.0.0.1", "--public-url", self.url)
        self.server = Server(folder / "root", "--token-file", str(token), *behind)
        key, self.certificate = folder / "key.pem", folder / "cert.pem"
        files = ["-keyout", str(key), "-out", str(self.certificate)]
        subprocess.run(["openssl", *SELF_SIGNED.split(), *files], check=True, capture_output=True)
        recipe = RECIPE.read_text(encoding="utf-8")
        for wanted, here in (
            (r"listen 80;", f"listen 127.0.0.1:{_free_port()};"),
            (r"listen 443", f"listen 127.0.0.1:{self.port}"),
            (r"127\.0\.0\.1:8420", f"127.0.0.1:{self.server.port}"),
            (r"/etc/letsencrypt/live/\S+/fullchain\.pem", str(self.certificate)),
            (r"/etc/letsencrypt/live/\S+/privkey\.pem", str(key)),
            (r"\$host;", f"$host:{self.port};"),  # the public port is no default here
        ):
            recipe, count = re.subn(wanted, here, recipe)
            assert count, wanted
        paths = "".join(
            f"{kind}_temp_path {folder / kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        whole = folder / "nginx.conf"
        whole.write_text(
            f"daemon off; pid {folder / 'pid'}; error_log {folder / 'error.log'};\n"
            f"events {{}}\nhttp {{ access_log off; {paths}\n{recipe}\n}}\n"
        )
        assert NGINX is not None
        self.log = folder / "error.log"
        self.nginx = subprocess.Popen([NGINX, "-c", str(whole), "-p", str(folder), "-e", str(self.log)])
        deadline = time.monotonic() + 20
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
                break
            except OSError:
                assert time.monotonic() < deadline and self.nginx.poll() is None, self.log.read_text()
                time.sleep(0.05)

    def tls(self) -> ssl.SSLContext:
        return ssl.create_default_context(cafile=str(self.certificate))

    def client(self, **headers: str) -> httpx.Client:
        """Looks the public name up at this machine."""
        return httpx.Client(
            base_url=f"https://127.0.0.1:{self.port}",
            headers={"Host": f"{NAME}:{self.port}", "Authorization": f"Bearer {TOKEN}", **headers},
            verify=self.tls(),
            timeout=30,
            event_hooks={"request": [lambda request: request.extensions.update(sni_hostname=NAME)]},
        )

    def stop(self) -> None:
        self.nginx.terminate()
        self.nginx.wait(timeout=30)
        self.server.stop()


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxied]:
    found = Proxied(tmp_path_factory.mktemp("proxied"))
    yield found
    found.stop()


def test_pages_jobs_uploads_and_events_come_through(proxied: Proxied) -> None:
    with proxied.client(Origin=proxied.url) as client:
        assert "dnrpipe" in client.get("/").text
        assert client.get("/jobs", headers={"Authorization": "Bearer wrong"}).status_code == 401
        large = b"x" * (8 * MAX_BODY)
        sent = client.put("/scenes/large.obj", content=large)
        assert sent.status_code in (200, 201), sent.text
        assert client.get("/scenes").json()[0]["size"] == len(large)
        empty_workspace(proxied.server.root, "proxied")
        job = client.post("/jobs", json={"command": "select", "workspace": "proxied"}).json()["id"]
        with client.stream("GET", f"/jobs/{job}/events") as events:  # each as it happens, to the end
            assert events.headers["content-type"].startswith("text/event-stream")
            assert any("failed" in line for line in events.iter_lines())


def test_the_viewers_socket_comes_through(proxied: Proxied) -> None:
    empty_workspace(proxied.server.root, "seen")
    address = f"wss://{NAME}:{proxied.port}/workspaces/seen/live"
    subprotocols = [Subprotocol("dnrpipe.live"), Subprotocol(f"dnrpipe.token.{TOKEN}")]
    with ExitStack() as stack:
        link = stack.enter_context(socket.create_connection(("127.0.0.1", proxied.port)))
        with connect(
            address, sock=link, ssl=proxied.tls(), origin=Origin(proxied.url), subprotocols=subprotocols
        ) as viewer:
            assert "seen" in str(viewer.recv(timeout=30))  # that it has not been prepared
        other = stack.enter_context(socket.create_connection(("127.0.0.1", proxied.port)))
        with pytest.raises(InvalidStatus, match="403"):
            connect(
                address, sock=other, ssl=proxied.tls(), origin=Origin("https://evil.example"), subprotocols=subprotocols
            )


def test_other_names_other_pages_and_forged_addresses(proxied: Proxied) -> None:
    with proxied.client() as client:
        assert client.get("/jobs", headers={"Origin": "https://evil.example"}).status_code == 403
        with pytest.raises(httpx.RemoteProtocolError):  # nginx hangs up
            client.get("/healthz", headers={"Host": "evil.example"})
        forged = {"X-Forwarded-For": "203.0.113.99", "X-Forwarded-Host": "evil.example", "X-Forwarded-Proto": "http"}
        assert client.get("/jobs", headers=forged).status_code == 200
        assert "203.0.113.99" not in proxied.server.log.read_text()
        strict = client.get("/healthz").headers["strict-transport-security"]
        assert int(strict.partition("=")[2]) >= 31_536_000
