"""What the command lines of `ablate` and `bench-select` ask for."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...core.errors import UserError
from ...core.settings import Settings, merge, parse_assignment


@dataclass(frozen=True, kw_only=True)
class StudyRequest:
    """What to run. base: settings of all cells. seconds: of training, None: the preset's epochs.

    Raises UserError: an amount of work that is none, or ``out`` is a file.
    """

    scenes: list[Path]
    seeds: int
    base: Settings
    seconds: float | None
    out: Path
    jobs: int

    def __post_init__(self) -> None:
        if self.seconds is not None and not self.seconds > 0:
            raise UserError(f"--seconds {self.seconds:g}: must be more than 0")
        if self.seeds < 1 or self.jobs < 0:
            raise UserError(f"--seeds {self.seeds} --jobs {self.jobs}: at least 1 seed; jobs from 0 (one per core)")
        if self.out.exists() and not self.out.is_dir():
            raise UserError(f"--out {self.out}: is a file; name a folder")


def merged(layers: Sequence[Mapping[str, Any]], assignments: Sequence[str]) -> dict[str, Any]:
    """Nested settings, later ones first; ``assignments``, KEY=VALUE, before all."""
    found: dict[str, Any] = {}
    for layer in (*layers, *map(parse_assignment, assignments)):
        found = merge(found, layer)
    return found


def choose_names(
    option: str,
    kind: str,
    text: str,
    names: Collection[str],
    groups: Mapping[str, Collection[str]],
) -> list[str]:
    """``"vanilla,dnr"``, or groups, in the order of ``names``.

    Args:
        option: the flag, for messages. kind: what is named, likewise: ``row``.
        text: what was given.
        names: all there are.
        groups: of names.

    Raises UserError: an unknown name, or none.
    """
    found: set[str] = set()
    for name in filter(None, (part.strip() for part in text.split(","))):
        if name not in groups and name not in names:
            near = difflib.get_close_matches(name, [*names, *groups], n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"groups: {', '.join(groups)}"
            raise UserError(f"{option} {name}: no such {kind} or group; {hint} ({option[2:]}: {', '.join(names)})")
        found.update(groups.get(name, (name,)))
    if not found:
        raise UserError(f"{option}: names no {kind}; choose of {', '.join([*groups, *names])}")
    return [name for name in names if name in found]
