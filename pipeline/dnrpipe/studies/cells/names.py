"""Names that a command line gives: of rows, of policies, and of their groups."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping

from ...core.errors import UserError


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
