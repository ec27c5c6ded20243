"""Values of shader sockets: constants, image textures, and colour arithmetic on them.

Nodes that only depend on images of one placement are evaluated texel by texel, exactly. A plain colour attribute is
kept at the corners. Cycles bakes everything else over the scene atlas (`baking.cache`). What cannot be baked becomes
its average. Baking and averaging are findings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import bpy
import numpy as np

from ..baking.cache import BakeCache
from ..baking.regions import Part
from ..baking.trees import ACTIVE_COLOUR
from ..findings import Findings
from ..geometry.corner_colours import colour_corners
from ..tasks import ValueKind
from .color_nodes import OPERATIONS
from .filtering import finer
from .placing import image_placement
from .sheets import on_region
from .sockets import Scope, Source, find_input, resolve
from .textures import Constant, ImageReader, Placement, Textured, Value, constant
from .view_dependent import fresnel_node, layer_weight_facing, layer_weight_fresnel

LIGHT_PATH_DEFAULTS = {"Is Camera Ray": 1.0}
"""Light Path outputs taken as constants: a directly seen surface; all other outputs are 0."""


NUMBERS = {"VALUE", "INT", "BOOLEAN"}
"""Types of sockets that take a number."""


class Inexact(Exception):
    """A value that textures and constants cannot hold exactly: (feature, what is used where it is not baked)."""


@dataclass
class Evaluator:
    """Evaluates sockets of one material.

    material: its full name, None outside of materials. bakes: where baked values come from; None: averages only.
    exact: raise Inexact rather than taking an average (used inside).
    """

    material: str | None
    images: ImageReader
    findings: Findings
    bakes: BakeCache | None = None
    exact: bool = False
    _known: dict[tuple[int | str, ...], Value] = field(default_factory=dict)
    """Values of nodes during one evaluation: a tree whose branches meet again and again has 2^n ways through it."""

    def colour(self, socket: Any, scope: Scope = ()) -> Value:
        """Value of a colour socket; textures have 3 channels."""
        value = self._evaluated(socket, scope, "colour")
        if isinstance(value, Textured) and value.texels.shape[2] == 1:
            return replace(value, texels=np.repeat(value.texels, 3, axis=2))
        return value

    def scalar(self, socket: Any, scope: Scope = ()) -> Value:
        """Value of a scalar socket; textures have 1 channel (a colour is converted to luminance)."""
        value = self._evaluated(socket, scope, "scalar")
        return value.grey() if isinstance(value, Textured) else constant(value.scalar)

    def number(self, socket: Any, scope: Scope = ()) -> float:
        """A scalar for which the target has no texture: the mean, with a finding if textured."""
        value = self.scalar(socket, scope)
        if isinstance(value, Textured):
            self.note("approximated", f"texture on '{socket.name}'", "the mean is used")
        return value.scalar

    def normal(self, socket: Any, scope: Scope = ()) -> Textured | None:
        """World-space normals that a Normal input receives, n * 0.5 + 0.5, baked; None where that cannot be."""
        source = resolve(socket, scope)
        if self.bakes is None or self.material is None or not source.linked:
            return None
        return self.bakes.value(self.material, "normal", source, socket.name, self.findings)

    def plain(self, socket: Any, scope: Scope = ()) -> Value | None:
        """Value of a socket that plain images and constants hold exactly; None for any other: nothing is baked."""
        try:
            value = replace(self, exact=True, _known={})._value(socket, scope)
        except Inexact:
            return None
        return None if isinstance(value, Textured) and not value.placement.plain else value

    def flat(self, value: Textured) -> Textured:
        """The same value over the material's region of the scene atlas (see `sheets.on_region`)."""
        if self.bakes is None or self.material is None:
            return value
        self.bakes.used_atlas = True
        self.bakes.materials.add(self.material)
        return on_region(self.bakes.atlas, self.material, value)

    def _evaluated(self, socket: Any, scope: Scope, kind: ValueKind) -> Value:
        """The value: exactly where that is possible, else baked, else averaged."""
        if self.bakes is None or self.material is None:
            return self._fresh(socket, scope)
        trial = replace(self, findings=Findings(), exact=True, _known={})
        try:
            value = trial._value(socket, scope)
            if kind == "scalar" and isinstance(value, Textured) and value.placement.corners is not None:
                raise Inexact("colour attribute as a number", "its mean over the mesh is used")
        except Inexact:
            baked = self.bakes.value(self.material, kind, resolve(socket, scope), socket.name, self.findings)
            return self._fresh(socket, scope) if baked is None else baked
        self.findings.merge(trial.findings)
        return value

    def _fresh(self, socket: Any, scope: Scope) -> Value:
        return replace(self, _known={})._value(socket, scope)

    def _inexact(self, feature: str, text: str) -> None:
        """Say that ``text`` is done about ``feature``; or raise, for the value to be baked instead."""
        if self.exact:
            raise Inexact(feature, text)
        self.note("approximated", feature, text)

    def note(self, kind: Any, feature: str, text: str) -> None:
        self.findings.add(kind, feature, text, material=self.material)

    def _value(self, socket: Any, scope: Scope) -> Value:
        source = resolve(socket, scope)
        if not source.linked:
            return constant(source.number if socket.type in NUMBERS else source.colour)
        key = (source.socket.as_pointer(), *(group.as_pointer() for group in source.scope))
        if key not in self._known:
            self._known[key] = self._node(source)
        return self._known[key]

    def _node(self, source: Source) -> Value:
        node, kind = source.node, source.node.type
        if kind == "RGB" or kind == "VALUE":
            return constant(node.outputs[0].default_value)
        if kind == "TEX_IMAGE":
            return self._image(source)
        if kind in {"VERTEX_COLOR", "ATTRIBUTE"}:
            return self._attribute(source)
        if kind == "BLACKBODY":
            temperature = self._value(find_input(node, "Temperature"), source.scope)
            if isinstance(temperature, Constant):
                return constant(blackbody_colour(temperature.scalar))
        if kind in {"FRESNEL", "LAYER_WEIGHT"}:
            return self._view_dependent(source)
        if kind == "LIGHT_PATH":
            fixed = LIGHT_PATH_DEFAULTS.get(source.socket.name, 0.0)
            self.note("approximated", f"Light Path '{source.socket.name}'", f"taken as {fixed:g} for every ray")
            return constant(fixed)
        if kind in OPERATIONS:
            return self._operation(source)
        if self.exact:
            raise Inexact(f"{node.bl_label} node", "its average is used")
        average = procedural_mean(source, self._value)
        means = ", ".join(f"{v:.3g}" for v in average.rgb)
        self.note("approximated", f"{node.bl_label} node", f"not an image: its average ({means}) is used")
        return average

    def _view_dependent(self, source: Source) -> Value:
        node = source.node
        normal = find_input(node, "Normal")
        if normal is not None and resolve(normal, source.scope).linked:
            self.note("approximated", f"{node.bl_label} node's Normal input", "the surface's own normal is used")
        if node.type == "FRESNEL":
            return fresnel_node(self.number(find_input(node, "IOR"), source.scope))
        blend = self.number(find_input(node, "Blend"), source.scope)
        return layer_weight_facing(blend) if source.socket.name == "Facing" else layer_weight_fresnel(blend)

    # ------------------------------------------------------------ arithmetic

    def _operation(self, source: Source) -> Value:
        """Colour node on constants and on textures that share size and placement: exact, per texel."""
        operation = OPERATIONS[source.node.type]
        names = operation.inputs(source.node)
        sockets = [find_input(source.node, *aliases) for aliases in names]
        values = [constant(0.0) if s is None else self._value(s, source.scope) for s in sockets]
        textured = [value for value in values if isinstance(value, Textured)]
        if any(value.placement.corners is not None for value in textured):
            self._inexact("colour attribute in colour arithmetic", "the operation is done at the corners")
        lead = max(textured, key=lambda value: value.texels.size, default=None)
        arrays: list[np.ndarray] = []
        for value in values:
            fits = (
                isinstance(value, Textured)
                and lead is not None
                and value.texels.shape[:2] == lead.texels.shape[:2]
                and value.placement == lead.placement
            )
            if isinstance(value, Textured) and fits:
                arrays.append(np.broadcast_to(value.linear(), (*value.texels.shape[:2], 3)))
            else:
                if isinstance(value, Textured):
                    feature = f"{source.node.bl_label} node"
                    self._inexact(feature, "combines images of different size or placement: the mean of one is used")
                arrays.append(value.mean.reshape(1, 1, 3))
        result = operation.evaluate(source.node, source.socket, arrays)
        if result is None:
            self._inexact(f"{source.node.bl_label} node", "this mode is not converted: first input used")
            result = arrays[operation.fallback]
        result = np.asarray(result, dtype=np.float32)
        if lead is None:
            return constant(result.reshape(-1, result.shape[-1])[0] * np.ones(3, dtype=np.float32))
        full = np.broadcast_to(result, (*lead.texels.shape[:2], result.shape[-1]))
        # Through the lead's own storage, so that 8-bit images stay 8-bit.
        return lead.map(lambda _: full)

    # ------------------------------------------------------------ images

    def _image(self, source: Source) -> Value:
        node = source.node
        if node.image is None:
            self.note("missing", "Image Texture node", "no image chosen; magenta stands for it")
            return constant((1.0, 0.0, 1.0))
        if self.exact and node.image.source in {"TILED", "MOVIE", "SEQUENCE"} and _is_split(node.image):
            raise Inexact(f"{node.image.source.lower()} image", "one tile or frame is used")
        texels, srgb = self.images.read(node.image, self.material)
        placement = self._placement(node, source.scope)
        mode = node.image.alpha_mode
        if source.socket.name == "Alpha":
            alpha = texels[..., 3:]
            flat = (alpha == alpha.flat[0]).all()
            if mode == "NONE" or flat:
                top = 255 if alpha.dtype == np.uint8 else 1
                return constant(1.0 if mode == "NONE" else float(alpha.flat[0]) / top)
            value = Textured(np.ascontiguousarray(alpha), False, placement or Placement())
        else:
            colour = texels[..., :3]
            # Cycles multiplies by alpha unless the node's Alpha output is in use (it then un-multiplies).
            if mode in {"STRAIGHT", "PREMUL"} and not _alpha_in_use(node) and texels.dtype == np.uint8:
                weight = texels[..., 3:].astype(np.float32) / 255
                if weight.min() < 1:
                    colour = np.round(colour * weight).astype(np.uint8)
            value = Textured(np.ascontiguousarray(colour), srgb, placement or Placement())
        if placement is None:
            return constant(value.mean)
        if node.interpolation == "Closest":
            return value
        kernel = "linear" if node.interpolation == "Linear" else "cubic"
        resampled, coded = finer(value.texels, value.srgb, placement.wrap, kernel)
        return replace(value, texels=resampled, srgb=coded)

    def _placement(self, node: Any, scope: Scope) -> Placement | None:
        """Placement of an Image Texture node, or None when its coordinates are not an affine map of a UV layer."""
        placement = image_placement(node, scope, self._affine, self._inexact)
        if placement is not None and placement.uv is not None and self._is_active(placement.uv):
            placement = replace(placement, uv=None)
        if placement is not None and placement.uv is not None and self._is_other_attribute(placement.uv):
            self._inexact(f"image placed by attribute '{placement.uv}'", "not a UV layer: the image's mean is used")
            return None
        if placement is None or node.extension != "CLIP" or self._stays_inside(placement):
            return placement
        self._inexact("image extension Clip", "edge texels are repeated")
        return placement

    @property
    def _parts(self) -> list[Part]:
        """The triangles that carry the material; none where nothing is baked."""
        return [] if self.bakes is None or self.material is None else self.bakes.atlas.parts(self.material)

    def _is_active(self, layer: str) -> bool:
        """Whether a named UV layer is the active one on all of the material's surface."""
        return bool(self._parts) and all(part.mesh.active_uv == layer for part in self._parts)

    def _is_other_attribute(self, name: str) -> bool:
        """Whether ``name`` is a mesh attribute, but no UV layer."""
        layers = any(name in part.mesh.uv_layers for part in self._parts)
        return not layers and any(name in part.mesh.colors for part in self._parts)

    def _affine(self, socket: Any, scope: Scope) -> np.ndarray:
        """Mean of a vector socket of a Mapping node."""
        value = self._value(socket, scope)
        if isinstance(value, Textured):
            self._inexact("textured Mapping node", "the mean is used")
        return value.mean.astype(np.float64)

    def _stays_inside(self, placement: Placement) -> bool:
        """Whether the material's surface uses nothing beyond the image's edges."""
        if self.bakes is None or self.material is None:
            return False
        affine = np.asarray(placement.to_uv)
        for part in self._parts:
            layer = part.mesh.uv_layers.get(placement.uv or part.mesh.active_uv or "")
            if layer is not None:
                uv = layer[part.corners] @ affine[:2, :2].T + affine[:2, 2]
                if uv.min(initial=0) < -1e-4 or uv.max(initial=1) > 1 + 1e-4:
                    return False
        return True

    # ------------------------------------------------------------ attributes

    def _attribute(self, source: Source) -> Value:
        """Colour attribute: its values at the mesh's corners, which Mitsuba interpolates as Cycles does."""
        node = source.node
        named = node.type == "VERTEX_COLOR"
        name = node.layer_name if named else node.attribute_name
        if not named and node.attribute_type != "GEOMETRY":
            self._inexact(f"attribute '{name}' of the {node.attribute_type.lower()}", "black is used")
            return constant(0.0)
        values = colour_corners(self.bakes, self.material, name) if self.bakes and self.material else None
        if values is None:
            if self.exact and any(name in part.mesh.uv_layers for part in self._parts):
                raise Inexact(f"UV layer '{name}' as a colour", "black is used")
            self.note("missing", f"attribute '{name}'", "not found on the mesh: black, as Cycles renders it")
            return constant(0.0)
        if source.socket.name == "Fac":
            self._inexact(f"attribute '{name}' as a number", "its mean over the surface is used")
            return constant(values[:, :3].mean())
        part = values[:, 3:] if source.socket.name == "Alpha" else values[:, :3]
        if np.ptp(part, axis=0).max(initial=0.0) < 1e-6:
            return constant(part[0] if part.shape[1] == 3 else float(part[0, 0]))
        if part.shape[1] == 1:
            self._inexact(f"alpha of attribute '{name}'", "its mean is used")
            return constant(float(part.mean()))
        return Textured(np.ascontiguousarray(part[:, None, :]), False, Placement(corners=name or ACTIVE_COLOUR))


def _is_split(image: Any) -> bool:
    return image.source != "TILED" or [tile.number for tile in image.tiles] != [1001]


def _alpha_in_use(node: Any) -> bool:
    """Whether the Alpha output of an Image Texture node, or of a node like it, is linked.

    Cycles merges nodes that compute the same: what counts is the merged node.
    """

    def content(other: Any) -> tuple[Any, ...]:
        links = [(link.from_node.name, link.from_socket.identifier) for link in other.inputs[0].links]
        return other.image, other.interpolation, other.projection, other.extension, links

    return any(
        other.outputs["Alpha"].is_linked
        for other in node.id_data.nodes
        if other.type == "TEX_IMAGE" and not other.mute and content(other) == content(node)
    )


def procedural_mean(source: Source, evaluate: Callable[[Any, Scope], Value]) -> Constant:
    """Average of a node's output over space; ``evaluate(socket, scope)`` gives its inputs."""
    node = source.node
    if node.type in {"TEX_CHECKER", "TEX_BRICK"} and source.socket.name == "Color":
        pair = [find_input(node, "Color1"), find_input(node, "Color2")]
        means = [evaluate(socket, source.scope).mean for socket in pair if socket is not None]
        return constant(np.mean(means, axis=0))
    if node.type == "BLACKBODY" or node.type == "WAVELENGTH":
        return constant(1.0)
    if source.socket.type in {"RGBA", "VECTOR", "VALUE"} and node.type.startswith("TEX_"):
        return constant(0.5)
    own = next((s for s in node.inputs if s.type in {"RGBA", "VALUE"} and s.enabled), None)
    return constant(0.5) if own is None else constant(evaluate(own, source.scope).mean)


def blackbody_colour(kelvin: float) -> np.ndarray:
    """Linear Rec.709 colour of luminance 1 (Blackbody node; a lamp's temperature), float64 [3], not below 0."""
    lamp = bpy.data.lights.new("dnrpipe.blackbody", "POINT")
    try:
        lamp.use_temperature = True
        lamp.temperature = kelvin
        return np.maximum(np.array(lamp.temperature_color, dtype=np.float64), 0.0)
    finally:
        bpy.data.lights.remove(lamp)
