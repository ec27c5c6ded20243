"""SIGTERM ends a command as Ctrl-C does."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator


@contextlib.contextmanager
def interrupt_as_keyboard() -> Iterator[None]:
    """SIGTERM ends a run as Ctrl-C does: workers are stopped, the lock is released, exit code 130."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
