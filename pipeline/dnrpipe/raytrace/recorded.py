"""``dr.freeze`` that Python's garbage collector does not disturb."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any


class Recorded:
    """A function of Dr.Jit arrays, recorded at its first call and replayed afterwards.

    Dr.Jit 1.x aborts the process, or reads freed memory, when the collector happens to free an older scene or kernel
    while a function is being recorded. So there is no collection during a call.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        import drjit as dr

        self.frozen = dr.freeze(function)

    @property
    def n_recordings(self) -> int:
        """How often it was recorded: more than once where something that varies came in other than as data."""
        return self.frozen.n_recordings

    def __call__(self, *arguments: Any) -> Any:
        collecting = gc.isenabled()
        gc.disable()
        try:
            return self.frozen(*arguments)
        finally:
            if collecting:
                gc.enable()
