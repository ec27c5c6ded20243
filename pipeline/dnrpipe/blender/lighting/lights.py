"""Blender lamps -> Mitsuba emitters. tests/test_export.py compares their radiometry with Cycles.

Blender's power P of a lamp in watts is the radiant flux of an isotropic source of radiance P / (4 pi^2 r^2);
colours are scene-linear; a lamp shines along its local -Z.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from typing import Any

import bpy
import numpy as np

from ..bundle import xmltree
from ..findings import Findings
from ..shading.materials import MaterialConverter
from ..shading.sockets import Scope, resolve, surface_source
from ..shading.textures import ImageReader, Textured
from ..shading.values import Evaluator

FAR_DISC = 100.0
"""Distance of a soft sun's disc, in radii of the scene."""
WIDEST_SPOT = math.radians(85)
"""Half angle up to which a spot's falloff fits into an image of its cross-section."""
NEAR = 0.03
"""Radius of a lamp, in radii of the scene, from which on its soft falloff is computed."""
NARROWEST = math.radians(0.5)
"""Half of the smallest spread of an area lamp."""
POINT_RADIUS = 1e-3
"""Radius, in radii of the scene, of a sphere that stands for a point."""
SPOT_TEXELS = 513
"""Side of the image that carries a spot's cross-section."""
FEW_BOUNCES = 8
"""Bounces of a lamp's light below which a limit shows in the picture."""
KINDS = {
    "visible_diffuse": "diffuse",
    "visible_glossy": "glossy",
    "visible_transmission": "transmission",
    "visible_volume_scatter": "volume scatter",
    "visible_shadow": "shadow",
}


def export_lights(
    scene: bpy.types.Scene, root: ET.Element, converter: MaterialConverter, center: np.ndarray, radius: float
) -> None:
    """Append all lamps to ``root``. center, radius: bounds of the geometry."""
    ids, findings = xmltree.Ids(), converter.findings
    for obj, matrix in visible_lights(scene):
        light = obj.data
        strength = _strength(light, obj.name, findings)
        if not np.any(strength > 0):
            continue
        if (why := _unplaceable(light, matrix)) is not None:
            findings.add("ignored", f"{light.type.lower()} lamp", f"{why}: left out", object=obj.name)
            continue
        _note_ignored(obj, light, findings)
        identity = ids.take("light", obj.name)
        if light.type == "POINT":
            element = _point(light, matrix, strength, identity, radius)
        elif light.type == "SUN":
            element = _sun(light, matrix, strength, identity, center, radius)
        elif light.type == "SPOT":
            element = _spot(obj, matrix, strength, identity, converter, radius)
        else:
            element = _area(light, matrix, strength, identity)
        root.append(element)


def _unplaceable(light: Any, matrix: np.ndarray) -> str | None:
    """Why a lamp cannot shine from where it is, or None."""
    if not np.isfinite(matrix).all():
        return "its place is not finite (NaN, infinite)"
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if light.type in {"SUN", "SPOT"} and not lengths[2] > 0:
        return "its scale is 0: it has no direction"
    if light.type == "AREA":
        height = light.size_y if light.shape in {"RECTANGLE", "ELLIPSE"} else light.size
        if not (light.size * lengths[0] > 0 and height * lengths[1] > 0):
            return "its area is 0, which gives no light in Cycles either"
    return None


def _strength(light: Any, name: str, findings: Findings) -> np.ndarray:
    """Power (W; W/m2 for a sun) per channel: energy x 2^exposure x colour x temperature x node tree."""
    colour = np.array(light.color, dtype=np.float64)
    if light.use_temperature:
        colour = colour * np.array(light.temperature_color, dtype=np.float64)
    power = float(light.energy) * 2.0 ** float(light.exposure) * colour
    if light.use_nodes and light.node_tree is not None:
        power = power * _node_colour(light.node_tree, name, findings)
    return np.maximum(power, 0.0)


def _node_colour(tree: bpy.types.NodeTree, name: str, findings: Findings) -> np.ndarray:
    """Emission colour x strength of a lamp's node tree; what varies becomes its mean, with a finding."""
    source = surface_source(tree)
    if source is None:
        return np.zeros(3)
    if source.node.type != "EMISSION":
        findings.add("approximated", "lamp nodes", "only an Emission node is understood", object=name)
        return np.ones(3)
    trial = Findings()
    evaluator = Evaluator(None, ImageReader(trial), trial)
    colour = evaluator.colour(source.node.inputs["Color"], source.scope)
    strength = _falloff(source.node.inputs["Strength"], source.scope, name, evaluator, findings)
    if strength is None:
        strength = evaluator.scalar(source.node.inputs["Strength"], source.scope).scalar
    for finding in trial:
        findings.add(finding.kind, f"lamp's {finding.feature}", finding.note, object=name)
    if isinstance(colour, Textured):
        findings.add("approximated", "textured lamp", "its mean colour shines in all directions", object=name)
    return np.asarray(colour.mean, dtype=np.float64) * strength


def _falloff(socket: Any, scope: Scope, name: str, evaluator: Evaluator, findings: Findings) -> float | None:
    """Strength of a Light Falloff node (its quadratic output is how light falls off anyway); None for other nodes."""
    source = resolve(socket, scope)
    if not source.linked or source.node.type != "LIGHT_FALLOFF":
        return None
    if source.socket.name != "Quadratic":
        feature = f"{source.socket.name.lower()} light falloff"
        findings.add("approximated", feature, "falls off with the square of the distance", object=name)
    return evaluator.scalar(source.node.inputs["Strength"], source.scope).scalar


def _note_ignored(obj: Any, light: Any, findings: Findings) -> None:
    if not light.use_shadow:
        findings.add("ignored", "lamp without shadow", "casts shadows", object=obj.name)
    hidden = [ray for ray in ("diffuse", "glossy", "transmission") if not getattr(obj, f"visible_{ray}")]
    if hidden:
        findings.add("ignored", "lamp's ray visibility", f"{', '.join(hidden)} rays see it", object=obj.name)
    if light.cycles.max_bounces < FEW_BOUNCES:
        note = f"its light bounces more than {light.cycles.max_bounces} time(s)"
        findings.add("ignored", "lamp's max bounces", note, object=obj.name)
    if _is_linked(obj):
        findings.add("ignored", "light linking", "the lamp lights everything", object=obj.name)


def _is_linked(obj: Any) -> bool:
    linking = getattr(obj, "light_linking", None)
    return linking is not None and bool(linking.receiver_collection or linking.blocker_collection)


def _point(light: Any, matrix: np.ndarray, power: np.ndarray, identity: str, scene_radius: float) -> ET.Element:
    """Point lamp -> ``point``, I = P / (4 pi), or, with a radius, an emitting ``sphere``, L = P / (4 pi^2 r^2).

    The sphere's intensity is L pi r^2, the same. Soft falloff: emitter ``dnr_lamp``, where the radius matters.
    """
    radius = float(light.shadow_soft_size)
    position = matrix[:3, 3]
    if radius <= 1e-5:
        element = xmltree.plugin("emitter", "point", id=identity)
        xmltree.vector(element, "position", position, "point")
        xmltree.rgb(element, "intensity", power / (4 * math.pi))
        return element
    element = _sphere(position, radius, identity)
    area = 4 * math.pi * radius**2 if light.normalize else 1.0
    softens = _softens(light, scene_radius)
    emitter = _emit(element, power / (math.pi * area), "dnr_lamp" if softens else "area")
    if softens:
        xmltree.text(emitter, "profile", "point")
        xmltree.number(emitter, "soft", radius)
    return element


def _sphere(center: np.ndarray, radius: float, identity: str) -> ET.Element:
    element = xmltree.plugin("shape", "sphere", id=identity)
    xmltree.vector(element, "center", center, "point")
    xmltree.number(element, "radius", radius)
    return element


def _softens(light: Any, scene_radius: float) -> bool:
    """Whether soft falloff makes a difference at distances of about a scene's radius (r^2 / d^2 above 0.1%)."""
    return bool(light.use_soft_falloff) and light.shadow_soft_size > NEAR * scene_radius


def _sun(
    light: Any, matrix: np.ndarray, irradiance: np.ndarray, identity: str, center: np.ndarray, radius: float
) -> ET.Element:
    """Sun -> ``directional`` (angle 0) or a far emitting ``disk`` that subtends the sun's angle.

    irradiance: W/m2 on a surface facing the sun; the disc's radiance is E / (pi sin^2(angle / 2)).
    """
    towards = -_unit(matrix[:3, 2])  # the way light travels: local -Z
    half = 0.5 * min(float(light.angle), math.pi * 0.98)
    if half < 1e-5:
        element = xmltree.plugin("emitter", "directional", id=identity)
        xmltree.vector(element, "direction", towards)
        xmltree.rgb(element, "irradiance", irradiance)
        return element
    return far_disc(towards, 2 * half, irradiance, identity, center, radius)


def far_disc(
    towards: np.ndarray, angle: float, irradiance: np.ndarray, identity: str, center: np.ndarray, radius: float
) -> ET.Element:
    """Emitting ``disk`` far away: light travels along ``towards`` (unit, [3]) from a disc of ``angle`` radians.

    Radiance E / (pi sin^2(angle / 2)), E the irradiance [3] of a surface that faces it. center, radius: of the scene.
    """
    half = angle / 2
    distance = FAR_DISC * max(radius, 1e-3)
    placed = np.eye(4)
    placed[:3, :3] = _frame(towards) * (distance * math.tan(half))
    placed[:3, 3] = center - towards * distance
    element = xmltree.plugin("shape", "disk", id=identity)
    xmltree.matrix(element, "to_world", placed)
    _emit(element, irradiance / (math.pi * math.sin(half) ** 2))
    return element


def _spot(
    obj: Any, matrix: np.ndarray, power: np.ndarray, identity: str, converter: MaterialConverter, scene_radius: float
) -> ET.Element:
    """Spot without radius -> ``spot`` whose cross-section image carries Cycles' falloff (Mitsuba's own is 0.117 off).

    Cycles: smoothstep((cos t - cos h) / ((1 - cos h) blend)), h half the cone. On axis I = P / (4 pi).
    With a radius r, or too wide for an image (then r is tiny): a ``sphere`` of L = P / (4 pi^2 r^2) whose emitter
    ``dnr_lamp`` has that falloff.
    """
    light, findings = obj.data, converter.findings
    if light.use_square:
        findings.add("ignored", "square spot", "its cone is round, as in Cycles", object=obj.name)
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    if np.ptp(scales) > 1e-3 * scales.max():
        findings.add("approximated", "stretched spot", "its cone is round", object=obj.name)
    half = 0.5 * float(light.spot_size)
    direction = -_unit(matrix[:3, 2])
    radius = float(light.shadow_soft_size)
    if radius > 1e-5 or half > WIDEST_SPOT:
        radius = radius if radius > 1e-5 else POINT_RADIUS * scene_radius
        area = 4 * math.pi * radius**2 if light.normalize or light.shadow_soft_size <= 1e-5 else 1.0
        element = _sphere(matrix[:3, 3], radius, identity)
        emitter = _emit(element, power / (math.pi * area), "dnr_lamp")
        xmltree.text(emitter, "profile", "spot")
        xmltree.vector(emitter, "axis", direction)
        xmltree.number(emitter, "cutoff", math.cos(half))
        xmltree.number(emitter, "span", max((1 - math.cos(half)) * float(light.spot_blend), 1e-4))
        if _softens(light, scene_radius):
            xmltree.number(emitter, "soft", radius)
        return element
    placed = np.eye(4)
    placed[:3, :3] = _frame(direction)
    placed[:3, 3] = matrix[:3, 3]
    element = xmltree.plugin("emitter", "spot", id=identity)
    xmltree.matrix(element, "to_world", placed)
    xmltree.rgb(element, "intensity", power / (4 * math.pi))
    xmltree.number(element, "cutoff_angle", math.degrees(half))
    # No falloff of Mitsuba's own: full strength up to the edge.
    xmltree.number(element, "beam_width", math.degrees(half) * 0.9999)
    texture = xmltree.plugin("texture", "bitmap", name="texture")
    section = spot_section(half, float(light.spot_blend))
    xmltree.text(texture, "filename", converter.store.save(section, False, f"{obj.name}-spot"))
    xmltree.flag(texture, "raw", True)
    xmltree.text(texture, "wrap_mode", "clamp")
    element.append(texture)
    return element


def spot_section(half: float, blend: float) -> np.ndarray:
    """Falloff over the plane z = 1 inside the square around a cone of half angle ``half``, float32 [N, N, 3]."""
    axis = ((np.arange(SPOT_TEXELS) + 0.5) / SPOT_TEXELS * 2 - 1) * math.tan(half)
    x, y = np.meshgrid(axis, axis)
    cosine = 1 / np.sqrt(1 + x * x + y * y)
    span = max((1 - math.cos(half)) * blend, 1e-4)
    t = np.clip((cosine - math.cos(half)) / span, 0, 1)
    return np.repeat((t * t * (3 - 2 * t))[..., None], 3, axis=2).astype(np.float32)


def _area(light: Any, matrix: np.ndarray, power: np.ndarray, identity: str) -> ET.Element:
    """Area lamp -> emitting ``rectangle`` or ``disk``; radiance P / (pi A), A with the object's scale.

    A spread below 180 degrees: emitter ``dnr_lamp``, radiance times (tan h - tan t) / (tan h - h), h half the spread,
    t the angle to the normal.
    """
    round_ = light.shape in {"DISK", "ELLIPSE"}
    size_x = float(light.size)
    size_y = float(light.size_y) if light.shape in {"RECTANGLE", "ELLIPSE"} else size_x
    # Mitsuba's shapes span [-1, 1] and face +Z: turn about X so that they face Blender's -Z.
    local = np.diag([size_x / 2, size_y / 2, 1.0, 1.0]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    placed = matrix @ local
    placed[:3, 2] = _unit(np.cross(placed[:3, 0], placed[:3, 1]))
    if np.dot(placed[:3, 2], -matrix[:3, 2]) < 0:  # a mirrored object: keep facing -Z
        placed[:3, 0] *= -1
        placed[:3, 2] *= -1
    area = float(np.linalg.norm(np.cross(placed[:3, 0], placed[:3, 1]))) * (math.pi if round_ else 4.0)
    element = xmltree.plugin("shape", "disk" if round_ else "rectangle", id=identity)
    xmltree.matrix(element, "to_world", placed)
    half = max(0.5 * float(light.spread), NARROWEST)
    wide = half > math.pi / 2 - 1e-3
    emitter = _emit(element, power / (math.pi * (area if light.normalize else 1.0)), "area" if wide else "dnr_lamp")
    if not wide:
        xmltree.text(emitter, "profile", "spread")
        xmltree.number(emitter, "tangent", math.tan(half))
        xmltree.number(emitter, "scale", 1 / (math.tan(half) - half))
    return element


def _emit(shape: ET.Element, radiance: np.ndarray, kind: str = "area") -> ET.Element:
    emitter = xmltree.plugin("emitter", kind)
    xmltree.rgb(emitter, "radiance", radiance)
    shape.append(emitter)
    return emitter


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-20)


def _frame(axis: np.ndarray) -> np.ndarray:
    """Right-handed rotation whose third column is ``axis``."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = _unit(np.cross(helper, axis))
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def is_portal(light: Any) -> bool:
    """Whether a lamp is a portal: it shows Cycles where light enters, and does not shine."""
    return light.type == "AREA" and bool(light.cycles.is_portal)


def visible_lights(scene: bpy.types.Scene) -> Iterator[tuple[Any, np.ndarray]]:
    """Lamp objects that renders see, instances included, with their world matrices (float64 [4, 4])."""
    layer = next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])
    hidden = _hidden_objects(layer.layer_collection)
    depsgraph = layer.depsgraph if layer.depsgraph is not None else bpy.context.evaluated_depsgraph_get()
    for obj in sorted(layer.objects, key=lambda o: o.name):
        if obj.type == "LIGHT" and not obj.hide_render and obj.name not in hidden and not is_portal(obj.data):
            evaluated = obj.evaluated_get(depsgraph)
            yield evaluated, np.array(evaluated.matrix_world, dtype=np.float64)
    for instance in depsgraph.object_instances:
        if instance.is_instance and instance.object.type == "LIGHT" and instance.show_self:
            if is_portal(instance.object.data):
                continue
            parent = instance.parent
            if parent is not None and (parent.hide_render or parent.name in hidden):
                continue
            yield instance.object, np.array(instance.matrix_world, dtype=np.float64)


def _hidden_objects(collection: bpy.types.LayerCollection) -> set[str]:
    """Names of objects that only lie in excluded or render-hidden collections."""
    shown: set[str] = set()
    masked: set[str] = set()

    def visit(layer: bpy.types.LayerCollection, above: bool) -> None:
        off = above or layer.collection.hide_render
        target = masked if off or layer.exclude else shown
        target.update(obj.name for obj in layer.collection.objects)
        for child in layer.children:
            visit(child, off)

    visit(collection, False)
    return masked - shown


def report_ray_visibility(names: Iterable[str], findings: Findings) -> None:
    """A finding for each object that is hidden from some rays, a shadow catcher, or has linked light.

    names: objects of the frozen scene. Camera rays are not among them: those are obeyed.
    """
    objects = {obj.name_full: obj for obj in bpy.data.objects}
    for name in sorted(set(names) & set(objects)):
        obj = objects[name]
        hidden = [kind for flag, kind in KINDS.items() if not getattr(obj, flag, True)]
        if hidden:
            findings.add("ignored", "ray visibility", f"{', '.join(hidden)} rays see it", object=name)
        if obj.is_shadow_catcher:
            findings.add("ignored", "shadow catcher", "an ordinary surface", object=name)
        if _is_linked(obj):
            findings.add("ignored", "light linking", "it lights and shades everything", object=name)
