"""What the conversion did with each feature of a scene, and lines about it for people. No bpy here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from dnrpipe.core.scene_records import Finding, FindingKind

ONE_BY_ONE = 3  # up to so many findings of a feature get a line each
LISTED = 6  # names per line


def printable(text: str) -> str:
    """``text`` that any terminal and UTF-8 file can take: bytes of paths that are not UTF-8 become \\xNN."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


class Findings:
    """Collector of findings, in order of discovery, without repetitions."""

    def __init__(self) -> None:
        self._found: dict[Finding, None] = {}

    def add(
        self,
        kind: FindingKind,
        feature: str,
        note: str,
        *,
        object: str | None = None,
        material: str | None = None,
    ) -> None:
        """Record a finding, unless it is known."""
        owner = None if object is None else printable(object)
        shader = None if material is None else printable(material)
        found = Finding(kind=kind, object=owner, material=shader, feature=printable(feature), note=printable(note))
        self._found.setdefault(found)

    def merge(self, other: Findings) -> None:
        """Add all of another collector's findings."""
        for finding in other:
            self._found.setdefault(finding)

    def __iter__(self) -> Iterator[Finding]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


def first_of(names: Sequence[str], shown: int, separator: str = ", ") -> str:
    """The first ``shown`` names, and how many more there are."""
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return f"{separator.join(names[:shown])}{more}"


def finding_lines(findings: Iterable[Finding]) -> list[str]:
    """One line for a finding; one line for all with the same feature when they are many. Order: first occurrence."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for row in findings:
        groups.setdefault((row.kind, row.feature), []).append(row)
    lines: list[str] = []
    for rows in groups.values():
        if len(rows) <= ONE_BY_ONE:
            lines += [_line([row], row.note) for row in rows]
        else:
            alike = len({row.note for row in rows}) == 1
            lines.append(_line(rows, rows[0].note if alike else f"{rows[0].note}; and alike (--json has each)"))
    return lines


def _line(rows: Sequence[Finding], note: str) -> str:
    owners = [(("object", row.object), ("material", row.material)) for row in rows]
    places = [", ".join(f"{key} '{name}'" for key, name in pair if name) for pair in owners]
    named = [place for place in places if place]
    where = f" ({first_of(named, LISTED)})" if named else ""
    return f"{rows[0].feature}{where}: {note}"
