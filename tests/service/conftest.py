"""Servers that the tests of the service share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.service.harness import TINY, Server

from dnrpipe.service.models import JobRequest


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with high rate limits. Tests use names of their own in it."""
    server = Server(tmp_path_factory.mktemp("service") / "root", "--rate", "2000")
    yield server
    server.stop()


@pytest.fixture(scope="session")
def trained(server: Server) -> str:
    """Name of a workspace that the server made of an uploaded scene; it was killed with -9 while it trained.

    The test of that is `test_killed_while_it_trains`; the others look at what came out.
    """
    blend = Path(__file__).parents[2] / "blender_scenes" / "hard" / "emissive_only.blend"
    with server.client() as client:
        scene = client.upload(blend, "lamp.blend")
        job = client.submit(JobRequest(command="run", workspace="lamp", scene=scene.name, settings=TINY))
        epochs = 0
        for event in client.events(job.id):
            epochs += event.kind == "epoch" and event.data["stage"] == "finetune"
            assert event.data.get("state") not in ("done", "failed"), client.log(job.id).text
            if epochs == 3:
                break
    server.kill()
    server.start()
    with server.client() as client:
        for _ in client.events(job.id):
            pass
        assert client.job(job.id).state == "done", client.log(job.id).text
    return "lamp"
