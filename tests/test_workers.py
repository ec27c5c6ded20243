"""The tests' own machinery: what a crash of one of pytest-xdist's workers costs."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

FILES = 16
CRASHES = 9


def test_a_crashed_worker_costs_one_test_and_the_rest_runs_once(tmp_path: Path) -> None:
    """With xdist's own scheduler the others wait for ever."""
    tests = tmp_path / "tests"
    tests.mkdir()
    shutil.copy(Path(__file__).with_name("conftest.py"), tests / "conftest.py")
    log = tmp_path / "log"
    for number in range(FILES):
        count = 1 + number % 3
        (tests / f"test_{number:02}.py").write_text(
            "import os, pytest\n"
            f"@pytest.mark.parametrize('i', range({count}))\n"
            "def test_it(i):\n"
            f"    with open({str(log)!r}, 'a') as log: log.write('{number} %d\\n' % i)\n"
            f"    if ({number}, i) == ({CRASHES}, 0): os.abort()\n"
        )
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
    done = subprocess.run(
        [*command, "-p", "no:cacheprovider", "tests"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    every = sorted((number, i) for number in range(FILES) for i in range(1 + number % 3))
    assert f"1 failed, {len(every) - 1} passed" in done.stdout, done.stdout[-2000:]
    assert sorted(tuple(map(int, line.split())) for line in log.read_text().splitlines()) == every
