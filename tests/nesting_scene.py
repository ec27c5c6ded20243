"""A ball in nested BSDFs, rendered in a process of its own: ``nesting_scene.py VARIANT FOLDER NAME...``.

NAMEs are BSDFs from the outside in, of `WRAPPERS` and `LEAVES`; each of their inputs is a texture of its own. Prints a
JSON object: the mean of the ball's picture, with ``path`` and, compiled, without caustics; ``direct``: functions that
kernels call without a table.
"""

from __future__ import annotations

import json
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from dnrpipe.core.cameras import look_at_view
from dnrpipe.core.settings import CameraSettings
from dnrpipe.raytrace.engine import Engine

WRAPPERS = ("mask", "dnr_transparent", "blendbsdf", "dnr_add", "dnr_normal", "normalmap", "bumpmap", "twosided")
GLASS = ("dnr_refraction", "dnr_interface")
LEAVES = ("dnr_principled", "dnr_refraction", "dnr_interface", "dnr_translucent", "roughconductor")
RANGES = {"normal": (0.45, 0.55), "normalmap": (0.45, 0.55), "opacity": (0.4, 1), "transmittance": (0.5, 1)}
INPUTS = {
    "mask": ["opacity"],
    "dnr_transparent": ["opacity", "transmittance"],
    "blendbsdf": ["weight"],
    "dnr_normal": ["normal"],
    "normalmap": ["normalmap"],
    "bumpmap": ["bumps"],
    "dnr_principled": ["base_color", "roughness", "metallic", "specular_tint", "coat", "sheen"],
    "dnr_interface": ["roughness"],
    "dnr_translucent": ["color"],
    "roughconductor": ["specular_reflectance"],
}


def texture(parent: ET.Element, name: str, folder: Path, kind: str) -> None:
    """A bitmap of noise below ``parent``; normals lie about the third axis."""
    import mitsuba as mi

    low, high = RANGES.get(name, (0.2, 0.9))
    values = np.random.default_rng(len(list(folder.iterdir()))).uniform(low, high, (8, 8, 3)).astype(np.float32)
    if name in ("normal", "normalmap"):
        values[..., 2] = 1
    path = folder / f"{kind}-{name}-{len(list(folder.iterdir()))}.exr"
    mi.Bitmap(values).write(str(path))
    element = ET.SubElement(parent, "texture", type="bitmap", name=name)
    ET.SubElement(element, "string", name="filename", value=str(path))
    ET.SubElement(element, "boolean", name="raw", value="true")


def bsdf(parent: ET.Element, names: list[str], folder: Path) -> None:
    """The first of ``names`` around the rest; sums and mixtures have a grey diffuse one as their other part."""
    kind, rest = names[0], names[1:]
    element = ET.SubElement(parent, "bsdf", type=kind)
    for name in INPUTS.get(kind, []):
        texture(element, name, folder, kind)
    if kind == "dnr_normal":
        ET.SubElement(element, "string", name="space", value="tangent")
    if kind in GLASS:
        ET.SubElement(element, "float", name="eta", value="1.4")
        glass = ET.SubElement(element, "bsdf", type="roughdielectric")
        ET.SubElement(glass, "float", name="int_ior", value="1.4")
        ET.SubElement(glass, "float", name="ext_ior", value="1")
    if rest:
        bsdf(element, rest, folder)
    if kind in ("blendbsdf", "dnr_add"):
        ET.SubElement(ET.SubElement(element, "bsdf", type="twosided"), "bsdf", type="diffuse")


def main() -> None:
    variant, folder, names = sys.argv[1], Path(sys.argv[2]), sys.argv[3:]
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    scene = ET.Element("scene", version="3.0.0")
    ET.SubElement(ET.SubElement(scene, "emitter", type="constant"), "rgb", name="radiance", value="0.8")
    ball = ET.SubElement(scene, "shape", type="sphere")
    bsdf(ball, names, folder)
    bundle = folder / "scene.xml"
    ET.ElementTree(scene).write(bundle)

    engine = Engine(variant, 0, [bundle])
    view = look_at_view("view", np.array([0, -4.0, 0]), np.zeros(3), 12, CameraSettings(width=8, height=8))
    if engine.compiled:
        dr.set_flag(dr.JitFlag.KernelHistory, True)
    samples = 512 if names[-1] in GLASS else 128  # light caught in glass is noisy
    answer: dict[str, object] = {}
    for kind in ("path", "path-without-caustics") if engine.compiled else ("path",):
        integrator, _ = engine.integrator(bundle, kind, 4)
        image, _ = engine.frame(bundle, integrator, engine.sensor(view), view, samples, 1)
        answer[kind] = float(image[..., :3].mean())
    albedo, normal, lost = engine.auxiliary(bundle, view, 4)
    answer |= {"lost": lost, "albedo": float(albedo.mean()), "normal": float(np.abs(normal).mean())}
    if engine.compiled:
        kernels = [entry["ir"].read() for entry in dr.kernel_history() if "ir" in entry]
        answer["kernels"] = len(kernels)
        answer["direct"] = [call for text in kernels for call in re.findall(r"call fastcc %Ret\S* @(func_\w+)", text)]
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
