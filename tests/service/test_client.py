"""The client and a server that fails for a moment."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from dnrpipe.core.errors import UserError
from dnrpipe.service.client import Client, Refused, Unreachable
from dnrpipe.service.lease_client import LeaseClient
from dnrpipe.service.leases import Beat, BeatAnswer, Lease
from dnrpipe.service.models import Job, JobRequest, Limits

JOB = Job(id=1, state="running", request=JobRequest(command="report", workspace="a"), created=0.0)
LEASE = Lease(id="x" * 16, seconds=30, job=JOB, scene=None, root="/r", settings="", limits=Limits())
Answer = Callable[[BaseHTTPRequestHandler], None]


def _says(status: int, body: str = '{"detail": "not now"}') -> Answer:
    def answer(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(status)
        handler.send_header("Content-Length", str(len(body)))
        handler.end_headers()
        handler.wfile.write(body.encode())

    return answer


@contextmanager
def _server(*answers: Answer) -> Iterator[str]:
    """The address of a server that gives these answers, one a request, and the last one from then on."""
    left: list[Answer] = list(answers)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            (left.pop(0) if len(left) > 1 else left[0])(self)

        do_POST = do_GET

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.parametrize("status", [500, 502, 503, 504, 507, 429])
def test_a_beat_that_the_server_fails_at_is_no_end_of_the_job(status: int) -> None:
    alive = BeatAnswer(cancelled=False)
    with _server(_says(status), _says(200, alive.model_dump_json())) as url, LeaseClient(url, None) as worker:
        assert worker.beat(LEASE, Beat(number=1)) is None
        assert worker.beat(LEASE, Beat(number=1)) == alive


@pytest.mark.parametrize("failures", [[500], [503, 502, 504]])
def test_who_asks_again_gets_the_answer(failures: Sequence[int]) -> None:
    """An idle worker that takes a job, and who submits one."""
    with _server(*map(_says, failures), _says(204, "")) as url, LeaseClient(url, None) as worker:
        assert worker.take("box", "cpu") is None
    with _server(*map(_says, failures), _says(201, JOB.model_dump_json())) as url, Client(url) as client:
        assert client.submit(JOB.request) == JOB


def test_a_server_that_keeps_failing_is_told_of_in_its_words() -> None:
    with (
        _server(_says(500)) as url,
        Client(url, retry_seconds=0.1) as client,
        pytest.raises(Unreachable, match="not now"),
    ):
        client.job(1)
    with _server(_says(507)) as url, Client(url) as client, pytest.raises(Refused, match="not now"):
        client.job(1)  # a full disk stays full


def test_a_quiet_stream_that_breaks_is_taken_up_again() -> None:
    """Longer without an event than the client tries again for; then the server is away for a moment."""

    def quiet(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Length", "1000")  # more than comes
        handler.end_headers()
        handler.wfile.write(b": still here\n\n")
        time.sleep(0.5)
        handler.close_connection = True

    event = 'id: 7\nevent: message\ndata: {"time": 1.0, "text": "on"}\n\nevent: end\ndata: {}\n\n'
    with _server(quiet, _says(503), _says(200, event)) as url, Client(url, retry_seconds=2.0) as client:
        assert [found.id for found in client.events(1)] == [7]
    with _server(quiet, _says(200, event)) as url, Client(url, retry_seconds=0.2) as client:
        assert [found.id for found in client.events(1)] == [7]
    broke = pytest.raises(UserError, match=r"the event stream broke \(not now\)")
    with _server(_says(503)) as url, Client(url, retry_seconds=0.2) as client, broke:
        next(client.events(1))
