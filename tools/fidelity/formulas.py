"""What other exporters' formulas would give: the same bundle with one number changed.

The formulas are those of the existing Blender add-on for Mitsuba, and Mitsuba's own
defaults. Each function edits the parsed XML in place and returns whether it found anything to change.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

Edit = Callable[[ET.Element], bool]


def area_quarter(root: ET.Element) -> bool:
    """Area lamp: radiance P / (4 A) instead of P / (pi A)."""
    changed = False
    for shape in root.iter("shape"):
        if shape.get("type") in ("rectangle", "disk") and (shape.get("id") or "").startswith("light-"):
            for value in shape.iterfind("emitter/rgb"):
                changed |= _scale(value, math.pi / 4)
    return changed


def roughness_squared(root: ET.Element) -> bool:
    """Principled: Mitsuba's ``principled`` with roughness r squared instead of r."""
    changed = False
    for bsdf in _principled(root):
        for value in bsdf.iterfind("float[@name='roughness']"):
            value.set("value", f"{float(value.get('value', '0')) ** 2:.9g}")
            changed = True
    return changed


def no_multiple_scattering(root: ET.Element) -> bool:
    """Rough metal: Mitsuba's ``principled`` as it is, whose metal scatters once only."""
    return bool(_principled(root))


def _principled(root: ET.Element) -> list[ET.Element]:
    """The Principled BSDFs of the bundle; our own plugin is exchanged for Mitsuba's, with the same parameters."""
    found = [bsdf for bsdf in root.iter("bsdf") if bsdf.get("type") in ("principled", "dnr_principled")]
    for bsdf in found:
        bsdf.set("type", "principled")
    return found


def glass_tint_base(root: ET.Element) -> bool:
    """Clear glass: tint the whole base colour at each interface instead of its square root."""
    changed = False
    for bsdf in root.iter("bsdf"):
        if "dielectric" in (bsdf.get("type") or ""):
            for name in ("specular_reflectance", "specular_transmittance"):
                for value in bsdf.iterfind(f"rgb[@name='{name}']"):
                    numbers = [float(x) ** 2 for x in (value.get("value") or "").replace(",", " ").split()]
                    value.set("value", " ".join(f"{x:.9g}" for x in numbers))
                    changed = True
    return changed


def mitsuba_spot_falloff(root: ET.Element) -> bool:
    """Spot: Mitsuba's own linear falloff from (1 - blend) of the cone, no cross-section image. Blend is 0.6."""
    changed = False
    for emitter in root.iter("emitter"):
        if emitter.get("type") == "spot":
            for texture in emitter.findall("texture"):
                emitter.remove(texture)
            cutoff = emitter.find("float[@name='cutoff_angle']")
            beam = emitter.find("float[@name='beam_width']")
            if cutoff is not None and beam is not None:
                beam.set("value", f"{float(cutoff.get('value', '0')) * (1 - 0.6):.9g}")
                changed = True
    return changed


def pink_dummy(root: ET.Element) -> bool:
    """Any node tree that is not understood: a pink diffuse surface."""
    changed = False
    for bsdf in root.findall("bsdf"):
        if next(bsdf.iter("texture"), None) is not None or next(bsdf.iter("ref"), None) is not None:
            identity = bsdf.get("id") or ""
            bsdf.clear()
            bsdf.attrib.update({"type": "diffuse", "id": identity})
            ET.SubElement(bsdf, "rgb", {"name": "reflectance", "value": "1 0 0.5"})
            changed = True
    return changed


FORMULAS: dict[str, tuple[str, Edit]] = {
    "area_quarter": ("area radiance P/4A", area_quarter),
    "roughness_squared": ("Principled roughness r²", roughness_squared),
    "no_multiple_scattering": ("rough metal uncompensated", no_multiple_scattering),
    "glass_tint_base": ("glass tint = base colour", glass_tint_base),
    "mitsuba_spot_falloff": ("Mitsuba's own spot falloff", mitsuba_spot_falloff),
    "pink_dummy": ("pink dummy for unknown nodes", pink_dummy),
}


def write_variant(bundle: Path, name: str) -> Path | None:
    """``scene.<name>.xml`` beside the bundle's XML (relative paths hold); None when the formula changes nothing."""
    root = ET.parse(bundle).getroot()
    if not FORMULAS[name][1](root):
        return None
    path = bundle.with_name(f"{bundle.stem}.{name}.xml")
    path.write_text(ET.tostring(root, encoding="unicode"), encoding="utf-8")
    return path


def _scale(value: ET.Element, factor: float) -> bool:
    numbers = [float(x) * factor for x in (value.get("value") or "").replace(",", " ").split()]
    value.set("value", " ".join(f"{x:.9g}" for x in numbers))
    return True
