"""Values of shader sockets: constants, image textures, and colour arithmetic on them.

Nodes that only depend on images of one placement are evaluated texel by texel, exactly. Everything else
(procedural textures, view-dependent nodes) becomes its average, with a finding: never silently.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mathutils import Euler

from .color_nodes import OPERATIONS
from .findings import Findings
from .sockets import Scope, Source, find_input, resolve
from .textures import Constant, ImageReader, Placement, Textured, Value, constant

FRESNEL_AVERAGE = 0.09
"""Cosine-weighted mean of the dielectric Fresnel term at IOR 1.45-1.5 (0.085-0.092)."""
LIGHT_PATH_DEFAULTS = {"Is Camera Ray": 1.0}
"""Light Path outputs taken as constants: a directly seen surface; all other outputs are 0."""
EXTENSIONS = {"REPEAT": "repeat", "EXTEND": "clamp", "CLIP": "clamp", "MIRROR": "mirror"}


@dataclass
class Evaluator:
    """Evaluates sockets of one material."""

    material: str | None
    images: ImageReader
    findings: Findings
    vertex_colour: Callable[[str], tuple[float, float, float] | None]

    def colour(self, socket: Any, scope: Scope = ()) -> Value:
        """Value of a colour socket; textures have 3 channels."""
        value = self._value(socket, scope)
        if isinstance(value, Textured) and value.texels.shape[2] == 1:
            return Textured(np.repeat(value.texels, 3, axis=2), value.srgb, value.placement)
        return value

    def scalar(self, socket: Any, scope: Scope = ()) -> Value:
        """Value of a scalar socket; textures have 1 channel (a colour is converted to luminance)."""
        value = self._value(socket, scope)
        return value.grey() if isinstance(value, Textured) else constant(value.scalar)

    def number(self, socket: Any, scope: Scope = ()) -> float:
        """A scalar for which the target has no texture: the mean, with a finding if textured."""
        value = self.scalar(socket, scope)
        if isinstance(value, Textured):
            self.note("approximated", f"texture on '{socket.name}'", "the mean is used")
        return value.scalar

    def note(self, kind: Any, feature: str, text: str) -> None:
        """Record a finding for this material."""
        self.findings.add(kind, feature, text, material=self.material)

    def _value(self, socket: Any, scope: Scope) -> Value:
        source = resolve(socket, scope)
        if not source.linked:
            default = source.default
            return constant(0.0 if default is None else default)
        return self._node(source)

    def _node(self, source: Source) -> Value:
        node, kind = source.node, source.node.type
        if kind == "RGB" or kind == "VALUE":
            return constant(node.outputs[0].default_value)
        if kind == "TEX_IMAGE":
            return self._image(source)
        if kind in {"VERTEX_COLOR", "ATTRIBUTE"}:
            return self._attribute(source)
        if kind == "FRESNEL":
            self.note("approximated", "Fresnel node", f"view-dependent; the mean {FRESNEL_AVERAGE} is used")
            return constant(FRESNEL_AVERAGE)
        if kind == "LAYER_WEIGHT":
            average = 0.5 if source.socket.name == "Facing" else FRESNEL_AVERAGE
            self.note("approximated", "Layer Weight node", f"view-dependent; the mean {average} is used")
            return constant(average)
        if kind == "LIGHT_PATH":
            fixed = LIGHT_PATH_DEFAULTS.get(source.socket.name, 0.0)
            self.note("approximated", f"Light Path '{source.socket.name}'", f"taken as {fixed:g} for every ray")
            return constant(fixed)
        if kind in OPERATIONS:
            return self._operation(source)
        average = self._procedural_mean(source)
        self.note(
            "approximated",
            f"{node.bl_label} node",
            f"not an image: its average ({', '.join(f'{v:.3g}' for v in average.rgb)}) is used",
        )
        return average

    # ------------------------------------------------------------ arithmetic

    def _operation(self, source: Source) -> Value:
        """Colour node on constants and on textures that share size and placement: exact, per texel."""
        operation = OPERATIONS[source.node.type]
        names = operation.inputs(source.node)
        sockets = [find_input(source.node, *aliases) for aliases in names]
        values = [constant(0.0) if s is None else self._value(s, source.scope) for s in sockets]
        textured = [value for value in values if isinstance(value, Textured)]
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
                    self.note(
                        "approximated",
                        f"{source.node.bl_label} node",
                        "combines images of different size or placement: the mean of the smaller is used",
                    )
                arrays.append(value.mean.reshape(1, 1, 3))
        result = operation.evaluate(source.node, source.socket, arrays)
        if result is None:
            self.note("approximated", f"{source.node.bl_label} node", "this mode is not converted: first input used")
            result = arrays[operation.fallback(source.node)]
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
            alpha_used = any(output.name == "Alpha" and output.is_linked for output in node.outputs)
            if mode in {"STRAIGHT", "PREMUL"} and not alpha_used and texels.dtype == np.uint8:
                weight = texels[..., 3:].astype(np.float32) / 255
                if weight.min() < 1:
                    colour = np.round(colour * weight).astype(np.uint8)
            value = Textured(np.ascontiguousarray(colour), srgb, placement or Placement())
        return constant(value.mean) if placement is None else value

    def _placement(self, node: Any, scope: Scope) -> Placement | None:
        """Placement of an Image Texture node, or None when its coordinates are not an affine map of a UV layer."""
        if node.projection != "FLAT":
            self.note("approximated", f"{node.projection.lower()} image projection", "the image's mean is used")
            return None
        found = self.coordinates(find_input(node, "Vector"), scope)
        if found is None:
            return None
        uv, affine = found
        if node.interpolation in {"Cubic", "Smart"}:
            self.note("approximated", "cubic image interpolation", "bilinear is used")
        if node.extension == "CLIP":
            self.note("approximated", "image extension Clip", "edge texels are repeated")
        return Placement(
            uv=uv,
            to_uv=tuple(tuple(float(v) for v in row) for row in affine),
            filter="nearest" if node.interpolation == "Closest" else "bilinear",
            wrap=EXTENSIONS[node.extension],  # type: ignore[arg-type]
        )

    def coordinates(self, socket: Any, scope: Scope) -> tuple[str | None, np.ndarray] | None:
        """UV layer and 3x3 affine map that an image's Vector input stands for; None (and a finding) if neither."""
        source = resolve(socket, scope)
        node = source.node
        if not source.linked:
            # An unlinked Vector means the render-active UV layer, also inside a group.
            return None, np.eye(3)
        if node.type == "UVMAP" or (node.type == "TEX_COORD" and source.socket.name == "UV"):
            return (node.uv_map or None) if node.type == "UVMAP" else None, np.eye(3)
        if node.type == "ATTRIBUTE" and source.socket.name == "Vector":
            return node.attribute_name or None, np.eye(3)
        if node.type == "MAPPING":
            below = self.coordinates(find_input(node, "Vector"), source.scope)
            affine = self._mapping(node, source.scope)
            if below is None or affine is None:
                return None
            return below[0], affine @ below[1]
        what = f"'{source.socket.name}' coordinates" if node.type == "TEX_COORD" else f"{node.bl_label} node"
        self.note("approximated", f"image placed by {what}", "not a UV layer: the image's mean is used")
        return None

    def _mapping(self, node: Any, scope: Scope) -> np.ndarray | None:
        """Mapping node as a planar affine map (Blender manual: Mapping; z of a UV is 0)."""
        parts = {}
        for name in ("Location", "Rotation", "Scale"):
            socket = find_input(node, name)
            value = constant((0, 0, 0)) if socket is None else self._value(socket, scope)
            if isinstance(value, Textured):
                self.note("approximated", "textured Mapping node", "the mean is used")
            parts[name] = value.mean.astype(np.float64)
        rotation = np.array(Euler(parts["Rotation"]).to_matrix(), dtype=np.float64)
        size = parts["Scale"]
        if node.vector_type == "TEXTURE":
            if (np.abs(size) < 1e-12).any():
                return None
            linear = np.diag(1 / size) @ rotation.T
            shift = -(linear @ parts["Location"])
        elif node.vector_type in {"POINT", "VECTOR"}:
            linear = rotation @ np.diag(size)
            shift = parts["Location"] if node.vector_type == "POINT" else np.zeros(3)
        else:
            self.note("approximated", "Mapping node of type Normal", "the image's mean is used")
            return None
        affine = np.eye(3)
        affine[:2, :2] = linear[:2, :2]
        affine[:2, 2] = shift[:2]
        return affine

    # ------------------------------------------------------------ averages

    def _attribute(self, source: Source) -> Value:
        node = source.node
        name = node.layer_name if node.type == "VERTEX_COLOR" else node.attribute_name
        if source.socket.name == "Alpha":
            return constant(1.0)
        average = self.vertex_colour(name)
        if average is None:
            self.note("missing", f"attribute '{name}'", "not found on the mesh: black, as Cycles renders it")
            return constant(0.0)
        self.note("approximated", f"colour attribute '{name}'", "its mean over the mesh is used")
        return constant(average)

    def _procedural_mean(self, source: Source) -> Constant:
        """Average of a texture node's output over space, as well as it is known."""
        node = source.node
        if node.type in {"TEX_CHECKER", "TEX_BRICK"} and source.socket.name == "Color":
            pair = [find_input(node, "Color1"), find_input(node, "Color2")]
            means = [self._value(socket, source.scope).mean for socket in pair if socket is not None]
            return constant(np.mean(means, axis=0))
        if node.type == "BLACKBODY" or node.type == "WAVELENGTH":
            return constant(1.0)
        if source.socket.type in {"RGBA", "VECTOR", "VALUE"} and node.type.startswith("TEX_"):
            return constant(0.5)
        own = next((s for s in node.inputs if s.type in {"RGBA", "VALUE"} and s.enabled), None)
        return constant(0.5) if own is None else constant(self._value(own, source.scope).mean)
