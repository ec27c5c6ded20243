"""Fixtures that several test modules use."""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

# As the command line does, before anything loads torch: tests run side by side, and waiting threads that spin take the
# processor from those that work.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

REPO = Path(__file__).resolve().parents[1]
SHARED = REPO.parent / "shared" / "assets"
TOGETHER = ("tests/service",)
ALONE = ("test_queue.py",)
LONG = (
    "tests/e2e/test_demo.py",
    "tests/e2e/test_pipeline.py",
    "tests/service/",
    "tests/test_bench_select.py",
    "tests/test_export.py",
    "tests/test_planning.py",
    "tests/e2e/test_damage.py",
    "tests/test_frontier.py",
    "tests/e2e/test_targets.py",
)
"""What takes longest begins first, so that no process is left with it when the others have ended."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; the others stay as they are."""

    def place(item: pytest.Item) -> int:
        return next((i for i, name in enumerate(LONG) if item.nodeid.startswith(name)), len(LONG))

    items.sort(key=place)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Side by side go whole files, so that what a file's tests share is made once.

    Some folders share a server between files, and stay together. (pytest-xdist 3.8's own
    ``--dist loadgroup`` overlooks its marks under pytest 9.)
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        """xdist's, which after the crash of a worker assigns what that had done again: units with nothing to do, on
        which the others wait for ever."""

        def remove_node(self, node: Any) -> str | None:
            units = self.assigned_work.pop(node)
            crashed = next((test for unit in units.values() for test, done in unit.items() if not done), None)
            if crashed is None:
                return None
            for scope, unit in units.items():
                left = {test: False for test, done in unit.items() if not done and test != crashed}
                if left:
                    self.workqueue[scope] = left
            for other in self.assigned_work:
                self._reschedule(other)
            return crashed

        def _reschedule(self, node: Any) -> None:
            # A worker begins its last test only when it knows that none follows, so one test is not enough.
            while self.workqueue and not node.shutting_down and self._pending_of(self.assigned_work[node]) <= 2:
                self._assign_work_unit(node)
            if not self.workqueue and not node.shutting_down:
                node.shutdown()

        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.split("::", 1)[0]
            folder, name = file.rsplit("/", 1)
            return folder if folder in TOGETHER and name not in ALONE else file

    return ByFile(config, log)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """``made_once(name, build)``: a folder that ``build(folder)`` fills once, for all processes of this run.

    Whoever comes first builds, the others wait. Tests only read it; those that write copy it.
    """
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent

    def make(name: str, build: Callable[[Path], object]) -> Path:
        folder, done = root / name, root / f"{name}.done"
        with FileLock(root / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                build(folder)
                done.touch()
        return folder

    return make


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


@pytest.fixture
def mitsuba_variant() -> Iterator[str]:
    """The best variant of Mitsuba, set in this process, with the plugins; the collector rests during the test.

    (Freeing another test's scene while plugins are being recorded kills the process: dnrpipe.raytrace.recorded.)
    """
    mi = pytest.importorskip("mitsuba")
    from dnrpipe.raytrace import plugins
    from dnrpipe.raytrace.recorded import without_collection
    from dnrpipe.raytrace.variants import choose_variant

    chosen = choose_variant("auto")
    os.environ.update(chosen.environment)
    mi.set_variant(chosen.variant)
    plugins.register(mi)
    gc.collect()
    with without_collection():
        yield chosen.variant


@pytest.fixture(autouse=True)
def _no_outer_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings in the developer's environment must not leak into tests."""
    import os

    for name in list(os.environ):
        if name.startswith("DNRPIPE_") and name != "DNRPIPE_CACHE":
            monkeypatch.delenv(name)
