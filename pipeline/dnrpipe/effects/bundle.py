"""The Mitsuba bundle as XML: which effects it holds, and the same bundle with some left out. No mitsuba here.

What leaving out means
    refraction    glass is seen straight through (``thindielectric``); Principled glass turns opaque
    subsurface    Principled ``flatness`` 0: plain diffuse
    alpha         masks and tinted transparency turn opaque
    environment, area-lights, point-lights, glow    those emitters are gone
    hair          the strands are gone
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection
from pathlib import Path

from dnrtrain.atomic import write_text

from ..core.errors import UserError

LAMP_PREFIX = "light-"
ENVIRONMENTS = {"envmap", "constant", "sunsky", "sky"}
DIELECTRICS = {"dielectric", "roughdielectric"}
AROUND_DIELECTRICS = {"dnr_interface", "dnr_refraction"}
MASKS = {"mask", "dnr_transparent"}
STRANDS_PREFIX = "hair-"
THIN_KEEPS = {"int_ior", "ext_ior", "specular_transmittance", "specular_reflectance"}


def bundle_facts(path: Path) -> dict[str, list[str]]:
    """Ids of the elements that carry each effect, effect name -> ids; effects that are not there are absent.

    ``null`` (no effect of its own): surfaces that light passes without noticing.

    Raises UserError when the file is missing or damaged.
    """
    root = _read(path)
    facts: dict[str, list[str]] = {}

    def note(effect: str, element: ET.Element) -> None:
        facts.setdefault(effect, []).append(element.get("id") or element.get("type", "?"))

    for bsdf in root.iter("bsdf"):
        if _refracts(bsdf):
            note("refraction", bsdf)
        if bsdf.get("type") in MASKS:
            note("alpha", bsdf)
        if bsdf.get("type") == "null":
            note("null", bsdf)
        if bsdf.find("*[@name='flatness']") is not None:
            note("subsurface", bsdf)
    for medium in root.iter("medium"):
        note("volumes", medium)
    for emitter in root.findall("emitter"):
        note("environment" if emitter.get("type") in ENVIRONMENTS else "point-lights", emitter)
    for shape in root.iter("shape"):
        if shape.get("id", "").startswith(STRANDS_PREFIX):
            note("hair", shape)
        if shape.find("emitter") is not None:
            note("area-lights" if _is_lamp(shape) else "glow", shape)
    return facts


def write_without(path: Path, left_out: Collection[str], target: Path) -> None:
    """Write the bundle ``path`` without some effects as ``target``, a file in the same folder."""
    root = _read(path)
    if "refraction" in left_out:
        for bsdf in list(root.iter("bsdf")):
            if bsdf.get("type") in AROUND_DIELECTRICS and (inner := bsdf.find("bsdf")) is not None:
                _replace(bsdf, inner)
        for bsdf in list(root.iter("bsdf")):
            if _refracts(bsdf):
                _straight_through(bsdf)
    if "subsurface" in left_out:
        for bsdf in root.iter("bsdf"):
            _drop(bsdf, "flatness")
    if "alpha" in left_out:
        for bsdf in list(root.iter("bsdf")):
            if bsdf.get("type") in MASKS:
                _opaque(bsdf)
    for emitter in root.findall("emitter"):
        if ("environment" if emitter.get("type") in ENVIRONMENTS else "point-lights") in left_out:
            root.remove(emitter)
    shapes = [(above, below) for above in root.iter() for below in above.findall("shape")]
    for parent, shape in shapes:
        emitter = shape.find("emitter")
        lamp = emitter is not None and _is_lamp(shape)
        strands = shape.get("id", "").startswith(STRANDS_PREFIX)
        if (strands and "hair" in left_out) or (lamp and "area-lights" in left_out):
            parent.remove(shape)
        elif emitter is not None and not lamp and "glow" in left_out:
            shape.remove(emitter)
    _remove_dangling(root)
    write_text(target, ET.tostring(root, encoding="unicode") + "\n")


def _read(path: Path) -> ET.Element:
    try:
        return ET.parse(path).getroot()
    except FileNotFoundError:
        raise UserError(f"{path}: is missing; run `dnrpipe prepare --force`") from None
    except ET.ParseError as error:
        raise UserError(f"{path}: damaged ({error}); run `dnrpipe prepare --force`") from None


def _drop(element: ET.Element, name: str) -> None:
    found = element.find(f"*[@name='{name}']")
    if found is not None:
        element.remove(found)


def _remove_dangling(root: ET.Element) -> None:
    """Shape groups that hold nothing any more, and instances of groups that are gone."""
    for group in root.findall("shape[@type='shapegroup']"):
        if group.find("shape") is None:
            root.remove(group)
    groups = {group.get("id") for group in root.findall("shape[@type='shapegroup']")}
    for shape in root.findall("shape[@type='instance']"):
        reference = shape.find("ref")
        if reference is not None and reference.get("id") not in groups:
            root.remove(shape)


def _is_lamp(shape: ET.Element) -> bool:
    return (shape.get("id") or "").startswith(LAMP_PREFIX)


def _refracts(bsdf: ET.Element) -> bool:
    if bsdf.get("type") in DIELECTRICS:
        return True
    share = bsdf.find("*[@name='spec_trans']")
    return share is not None and (share.tag != "float" or float(share.get("value", "0")) > 0)


def _straight_through(bsdf: ET.Element) -> None:
    if bsdf.get("type") not in DIELECTRICS:
        _drop(bsdf, "spec_trans")
        return
    bsdf.set("type", "thindielectric")
    for child in list(bsdf):
        if child.get("name") not in THIN_KEEPS:
            bsdf.remove(child)


def _opaque(bsdf: ET.Element) -> None:
    """The nested BSDF in place of its mask; where there is none inline, a mask that lets nothing through."""
    inner = bsdf.find("bsdf")
    if inner is None:
        _drop(bsdf, "opacity")
        ET.SubElement(bsdf, "float", {"name": "opacity", "value": "1"})
        return
    _replace(bsdf, inner)


def _replace(bsdf: ET.Element, inner: ET.Element) -> None:
    """``inner`` in place of ``bsdf``, under its name."""
    outer = {key: value for key, value in bsdf.attrib.items() if key in ("id", "name")}
    tag_attributes, children, text = dict(inner.attrib), list(inner), inner.text
    bsdf.clear()
    bsdf.attrib.update({**tag_attributes, **outer})
    bsdf.text = text
    bsdf.extend(children)
