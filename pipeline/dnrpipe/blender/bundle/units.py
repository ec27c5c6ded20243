"""Scenes of unusual size: the bundle in units of its own, so that Mitsuba's absolute thresholds do no harm.

Mitsuba moves the origin of a secondary ray by 9e-5 (1 + the largest coordinate) (``math::RayEpsilon``, float32): a
scene of 1e-4 units disappears in that step. Such a bundle is written larger by a power of two, which changes no
digit; ``<default name="unit_scale">`` at its head holds the factor, and `dnrpipe.raytrace.sensors` scales cameras
by it. Radiance does not depend on the unit of length; intensities (W/sr) and extinction do.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np

from . import xmltree

SMALLEST, LARGEST = 0.1, 1e5
"""Radii, in scene units, that are left alone: the step is below 1e-3 of the first, and far_clip beyond the second."""
NAME = "unit_scale"


def unit_scale(radius: float) -> float:
    """Power of two that brings a scene of this radius to about 1; 1 for usual sizes."""
    return 1.0 if SMALLEST <= radius <= LARGEST else 2.0 ** -round(math.log2(radius))


def rescale(root: ET.Element, factor: float) -> None:
    """Multiply every length in the bundle ``root`` by ``factor``, in place, and record it."""
    for element in root:
        kind = element.get("type", "")
        if element.tag == "sensor":
            _move(element, factor)
            _multiply(element, ("near_clip", "far_clip"), factor)
        elif element.tag == "shape" and kind == "sphere":
            _multiply(element, ("center", "radius"), factor)
        elif element.tag == "shape" and kind != "shapegroup":  # a group's instances scale it
            _enlarge(element, factor)
        elif element.tag == "emitter" and kind in ("point", "spot"):
            _move(element, factor)
            _multiply(element, ("position",), factor)
            _multiply(element, ("intensity",), factor**2)
        elif element.tag == "medium":
            _multiply(element, ("scale",), 1 / factor)
            for volume in element.iter("volume"):
                _enlarge(volume, factor)
        for lamp in element.findall("emitter"):
            _multiply(lamp, ("soft",), factor)
    root.insert(0, ET.Element("default", {"name": NAME, "value": f"{factor:.17g}"}))


def _multiply(parent: ET.Element, names: tuple[str, ...], factor: float) -> None:
    for child in parent:
        if child.get("name") not in names:
            continue
        for key in ("value", "x", "y", "z"):
            if key in child.attrib:
                numbers = [float(part) * factor for part in child.attrib[key].split()]
                child.set(key, " ".join(f"{number:.9g}" for number in numbers))


def _transform(parent: ET.Element) -> tuple[ET.Element | None, np.ndarray]:
    """(the ``to_world`` element or None, its 4x4 matrix)."""
    holder = parent.find("transform[@name='to_world']")
    if holder is None:
        return None, np.eye(4)
    (only,) = holder
    return holder, np.array([float(part) for part in only.attrib["value"].split()]).reshape(4, 4)


def _move(parent: ET.Element, factor: float) -> None:
    """Multiply the place in ``to_world``, not its axes."""
    holder, matrix = _transform(parent)
    if holder is not None:
        matrix[:3, 3] *= factor
        parent.remove(holder)
        xmltree.matrix(parent, "to_world", matrix)


def _enlarge(parent: ET.Element, factor: float) -> None:
    """Scale about the world's origin after ``to_world``."""
    holder, matrix = _transform(parent)
    if holder is not None:
        parent.remove(holder)
    xmltree.matrix(parent, "to_world", np.diag([factor, factor, factor, 1.0]) @ matrix)
