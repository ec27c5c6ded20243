"""Fixtures that several test modules use."""

from __future__ import annotations

from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]
SHARED = REPO.parent / "shared" / "assets"
SHARED_FIXTURES = ("tiny", "server")
"""Fixtures that take long and that several files use."""


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Side by side go whole files, not single tests, so that what a file's tests share is made once.

    Some files share a finished workspace, or a server.
    """
    shared = {
        item.path: name for item in items for name in SHARED_FIXTURES if name in getattr(item, "fixturenames", ())
    }
    for item in items:
        name = shared.get(item.path, f"{item.path.parent.name}/{item.path.stem}")
        item.add_marker(pytest.mark.xdist_group(name))


@pytest.fixture(scope="session")
def demo_blend() -> Path:
    """The committed demo scene."""
    return REPO / "blender_scenes" / "demo.blend"


@pytest.fixture(scope="session")
def shared_assets() -> Path:
    """Scenes that stand beside our checkouts; absent at users', so tests on them skip there."""
    if not SHARED.is_dir():
        pytest.skip("../shared/assets is not here; the same check runs on the demo scene")
    return SHARED


@pytest.fixture(autouse=True)
def _no_outer_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings in the developer's environment must not leak into tests."""
    import os

    for name in list(os.environ):
        if name.startswith("DNRPIPE_") and name != "DNRPIPE_CACHE":
            monkeypatch.delenv(name)
