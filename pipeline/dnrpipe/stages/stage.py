"""What a stage is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ..core.settings import Settings


@dataclass(frozen=True)
class Outcome:
    """What a stage's run returns: a hash of what it made, and facts for the manifest and ``--json``."""

    output: str
    detail: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage:
    """One stage. ``run`` and ``progress`` are "module:function", imported when called.

    run(workspace, settings, console, run_id) -> Outcome
    progress(workspace, settings) -> (units present, units wanted)
    """

    name: str
    command: str
    does: str
    needs: tuple[str, ...]
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    settings: Callable[[Settings], Any]
    run: str
    progress: str
    version: int = 1
