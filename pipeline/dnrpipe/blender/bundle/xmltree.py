"""Elements of Mitsuba's scene format (version 3): small constructors over xml.etree. No bpy here."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import numpy as np

LONGEST_NAME = 80
"""Characters: file systems allow 255 bytes in a file name, and several names may be joined."""


def safe_name(name: str) -> str:
    """``name`` with everything but letters, digits, '_' and '-' replaced, and cut: for ids and file names."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:LONGEST_NAME] or "unnamed"


class Ids:
    """Stable, readable, unique ids: the first taker of a name keeps it, later ones get -2, -3, ..."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def take(self, prefix: str, name: str) -> str:
        base = f"{prefix}-{safe_name(name)}"
        candidate, number = base, 1
        while candidate.lower() in self._taken:
            number += 1
            candidate = f"{base}-{number}"
        self._taken.add(candidate.lower())
        return candidate


def plugin(tag: str, kind: str, *, name: str | None = None, id: str | None = None) -> ET.Element:
    """A plugin element such as ``<bsdf type="principled">``."""
    attributes = {"type": kind}
    if id is not None:
        attributes["id"] = id
    if name is not None:
        attributes["name"] = name
    return ET.Element(tag, attributes)


def number(parent: ET.Element, name: str, value: float) -> None:
    """``<float>``."""
    ET.SubElement(parent, "float", {"name": name, "value": _text(value)})


def integer(parent: ET.Element, name: str, value: int) -> None:
    """``<integer>``."""
    ET.SubElement(parent, "integer", {"name": name, "value": str(int(value))})


def flag(parent: ET.Element, name: str, value: bool) -> None:
    """``<boolean>``."""
    ET.SubElement(parent, "boolean", {"name": name, "value": "true" if value else "false"})


def text(parent: ET.Element, name: str, value: str) -> None:
    """``<string>``."""
    ET.SubElement(parent, "string", {"name": name, "value": value})


def rgb(parent: ET.Element, name: str, value: Iterable[float]) -> None:
    """``<rgb>``, linear Rec.709."""
    ET.SubElement(parent, "rgb", {"name": name, "value": " ".join(_text(v) for v in value)})


def matrix(parent: ET.Element, name: str, value: np.ndarray) -> None:
    """``<transform>`` holding one row-major 4x4 matrix."""
    holder = ET.SubElement(parent, "transform", {"name": name})
    ET.SubElement(holder, "matrix", {"value": " ".join(_text(v) for v in np.asarray(value).ravel())})


def vector(parent: ET.Element, name: str, value: Iterable[float], tag: str = "vector") -> None:
    """``<vector>``, or ``<point>``."""
    x, y, z = (_text(v) for v in value)
    ET.SubElement(parent, tag, {"name": name, "x": x, "y": y, "z": z})


def reference(parent: ET.Element, id: str, name: str | None = None) -> None:
    """``<ref>`` to an element defined earlier."""
    ET.SubElement(parent, "ref", {"id": id} if name is None else {"id": id, "name": name})


def _text(value: float) -> str:
    number_ = float(value)
    if not np.isfinite(number_):
        raise ValueError(f"{value} cannot be written to a Mitsuba scene")
    return f"{number_:.9g}"
