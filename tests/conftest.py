"""Fixtures that several test modules use."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

# As the command line does, before anything loads torch: tests run side by side, and waiting threads that spin take the
# processor from those that work.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

REPO = Path(__file__).resolve().parents[1]
SHARED = REPO.parent / "shared" / "assets"
TOGETHER = ("tests/e2e", "tests/service")
ALONE = ("test_demo.py", "test_queue.py")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Side by side go whole files, so that what a file's tests share is made once.

    Some folders share a finished workspace, or a server, between files, and stay together. (pytest-xdist 3.8's own
    ``--dist loadgroup`` overlooks its marks under pytest 9.)
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.split("::", 1)[0]
            folder, name = file.rsplit("/", 1)
            return folder if folder in TOGETHER and name not in ALONE else file

    return ByFile(config, log)


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
