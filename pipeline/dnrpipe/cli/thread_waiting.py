"""How torch's threads wait for each other; read when torch is loaded, so it is set before.

Measured on two cores, a training step at 128², ms (`python -m tools.bench_waiting WORKSPACE`):

    spins before sleeping       0    1,000   300,000 (libgomp's default)
    idle machine               86       49        42
    four other processes      288      361       878

One run each. Beside other processes it varies by half; there spinning a little costs some, spinning on costs threefold.
"""

from __future__ import annotations

import sys
from collections.abc import MutableMapping

SPINS = "1000"


def set_thread_waiting(environment: MutableMapping[str, str]) -> None:
    """Spin a little, then sleep. What the user has set stays.

    Torch for Linux comes with GNU's OpenMP, which takes a number of spins; other runtimes only sleep at once or never.
    """
    if "OMP_WAIT_POLICY" in environment or "GOMP_SPINCOUNT" in environment:
        return
    if sys.platform.startswith("linux"):
        environment["GOMP_SPINCOUNT"] = SPINS
    else:
        environment["OMP_WAIT_POLICY"] = "PASSIVE"
