"""What the conversion did with each feature of a scene: the user is always told. No bpy here."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Kind = Literal["exact", "approximated", "baked", "ignored", "missing"]


@dataclass(frozen=True)
class Finding:
    """One feature and what became of it.

    kind: exact (converted one to one), approximated (converted, visibly different in general), baked
    (turned into an image), ignored (left out), missing (the scene refers to something that is not there).
    """

    kind: Kind
    object: str | None
    material: str | None
    feature: str
    note: str


def printable(text: str) -> str:
    """``text`` that any terminal and UTF-8 file can take: bytes of paths that are not UTF-8 become \\xNN."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


class Findings:
    """Collector of findings, in order of discovery, without repetitions."""

    def __init__(self) -> None:
        self._found: dict[Finding, None] = {}

    def add(
        self,
        kind: Kind,
        feature: str,
        note: str,
        *,
        object: str | None = None,
        material: str | None = None,
    ) -> None:
        """Record a finding; a repetition is dropped."""
        owner = None if object is None else printable(object)
        shader = None if material is None else printable(material)
        self._found.setdefault(Finding(kind, owner, shader, printable(feature), printable(note)))

    def merge(self, other: Findings) -> None:
        """Add all of another collector's findings."""
        for finding in other._found:
            self._found.setdefault(finding)

    def to_list(self) -> list[dict[str, Any]]:
        """JSON-able list of {"kind", "object", "material", "feature", "note"}."""
        return [asdict(finding) for finding in self._found]

    def __len__(self) -> int:
        return len(self._found)
