"""schemathesis: requests that fit the description and requests that break it; the server answers as it says."""

from __future__ import annotations

import re

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from tests.service.harness import Server

CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.mark.parametrize("mode", list(GenerationMode))
def test_no_surprises(server: Server, mode: GenerationMode) -> None:
    """Requests that fit the description, and requests that break it."""
    schema = schemathesis.openapi.from_dict(httpx.get(f"{server.url}/openapi.json").json())
    quick = settings(
        max_examples=6, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    tried = []
    for result in schema.get_all_operations():
        operation = result.ok()
        if mode is GenerationMode.NEGATIVE and not (list(operation.iter_parameters()) or operation.body):
            continue  # nothing that could be wrong

        @quick
        @given(case=operation.as_strategy(mode))
        def attempt(case: schemathesis.Case) -> None:
            case.call_and_validate(base_url=server.url, checks=CHECKS, timeout=60)

        attempt()
        tried.append(operation.label)
    assert len(tried) == (23 if mode is GenerationMode.POSITIVE else 18), tried


def test_metrics_are_prometheus_text(server: Server) -> None:
    answer = httpx.get(f"{server.url}/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    line = re.compile(r'(# (HELP|TYPE) dnrpipe_\w+ .+|dnrpipe_\w+(\{\w+="[^"]*"\})? -?[0-9.]+)')
    lines = answer.text.splitlines()
    assert all(line.fullmatch(text) for text in lines), answer.text
    assert 'dnrpipe_worker_up{device="cpu"} 1' in lines
