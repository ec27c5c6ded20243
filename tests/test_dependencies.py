"""Every dependency is pinned, and its version and licence stand in the page."""

from __future__ import annotations

import pytest
from tools import dependencies


def test_all_are_pinned_and_listed() -> None:
    assert dependencies.problems() == []


def test_the_check_can_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = dependencies.pinned()
    monkeypatch.setattr(dependencies, "pinned", lambda: versions | {"click": "0"})
    assert dependencies.problems() == ["click 0: not in dependencies.md"]
    del versions["click"]
    monkeypatch.setattr(dependencies, "pinned", lambda: versions)
    assert dependencies.problems() == ["click: not in constraints.txt"]
