"""What the conversion did with each feature of a scene. No bpy here."""

from __future__ import annotations

from collections.abc import Iterator

from dnrpipe.core.scene_records import Finding, FindingKind


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
