"""Findings of the conversion as lines for people: a line for what recurs, with names."""

from __future__ import annotations

from collections.abc import Iterable

from dnrpipe.core.scene_records import Finding

ONE_BY_ONE = 3  # up to so many of a kind get a line each
LISTED = 6  # names per line


def finding_lines(findings: Iterable[Finding]) -> list[str]:
    """One line for a finding; one line for all with the same feature when they are many. Order: first occurrence."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for row in findings:
        groups.setdefault((row.kind, row.feature), []).append(row)
    lines: list[str] = []
    for rows in groups.values():
        if len(rows) <= ONE_BY_ONE:
            lines += [_line(row.feature, [_where(row)], row.note) for row in rows]
        else:
            notes = {row.note for row in rows}
            note = rows[0].note if len(notes) == 1 else f"{rows[0].note}; and alike (--json has each)"
            lines.append(_line(rows[0].feature, [_where(row) for row in rows], note))
    return lines


def _where(row: Finding) -> str:
    return ", ".join(f"{key} '{name}'" for key, name in (("object", row.object), ("material", row.material)) if name)


def _line(feature: str, places: list[str], note: str) -> str:
    named = [place for place in places if place]
    more = f" and {len(named) - LISTED} more" if len(named) > LISTED else ""
    where = f" ({', '.join(named[:LISTED])}{more})" if named else ""
    return f"{feature}{where}: {note}"
