"""How long a task may take before its worker counts as hung."""

from __future__ import annotations

import os

from ..core.errors import UserError
from ..core.units import parse_seconds

TIMEOUT_VARIABLE = "DNRPIPE_TASK_TIMEOUT"
FIRST_LIMIT = 6 * 3600.0
"""Seconds that a task may take while none has ended yet: paper-sized light on two cores is well within."""
LEAST_LIMIT = 600.0
"""Below it nothing counts as hung, however quick the others were: machines swap, and sleep."""
SLOWEST = 30.0
"""A task may take so many times the longest one so far."""


class TaskTimeout:
    """The limit of each task of one run.

    Args:
        fixed: seconds; None: those of DNRPIPE_TASK_TIMEOUT, else SLOWEST times the longest task that ended so far
            (LEAST_LIMIT at least, FIRST_LIMIT before any has).

    Raises UserError: the variable is no number of seconds above 0.
    """

    def __init__(self, fixed: float | None = None) -> None:
        self.fixed = _configured_limit() if fixed is None else fixed
        self.longest: float | None = None

    def limit(self, attempt: int) -> float:
        """Seconds for try number ``attempt`` of a task; further tries get twice as long, unless told otherwise."""
        if self.fixed is not None:
            return self.fixed
        usual = FIRST_LIMIT if self.longest is None else max(LEAST_LIMIT, SLOWEST * self.longest)
        return usual * (1 if attempt == 1 else 2)

    def took(self, seconds: float) -> None:
        """A task ended after so many seconds."""
        self.longest = max(seconds, self.longest or 0.0)

    def reason(self) -> str:
        """What the limit came from."""
        if self.fixed is not None or self.longest is None:
            return ""
        return f"; the longest so far took {self.longest:.0f} s"


def _configured_limit() -> float | None:
    text = os.environ.get(TIMEOUT_VARIABLE, "").strip()
    if not text:
        return None
    try:
        return parse_seconds(text)
    except ValueError:
        raise UserError(f"{TIMEOUT_VARIABLE}={text}: expected a time such as 90, 20m or 2h") from None
