"""Textures that look another one up elsewhere: ``dnr_uv_layer`` by another UV layer than the shape's own, ``dnr_view``
by the angle of view (Fresnel, Layer Weight and what is made of them).
"""

from __future__ import annotations

from typing import Any

from .nesting import only


def register(mi: Any) -> None:
    """``dnr_uv_layer`` and ``dnr_view`` for the current variant."""
    import drjit as dr

    class Moved(mi.Texture):
        """One nested texture, ``self.inner``, looked up at `_uv`."""

        def eval(self, si: Any, active: Any = True) -> Any:
            return self.inner.eval(self._moved(si, active), active)

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return self.inner.eval_1(self._moved(si, active), active)

        def eval_3(self, si: Any, active: Any = True) -> Any:
            return self.inner.eval_3(self._moved(si, active), active)

        def _moved(self, si: Any, active: Any) -> Any:
            moved = mi.SurfaceInteraction3f(si)
            moved.uv = self._uv(si, active)
            return moved

        def mean(self) -> Any:
            return self.inner.mean()

        def is_spatially_varying(self) -> bool:
            return True

        def traverse(self, callback: Any) -> None:
            callback.put("inner", self.inner, mi.ParamFlags.Differentiable)

    class UvLayer(Moved):
        """``attribute``: string, a vertex attribute of 3 floats (u, v, unused)."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.attribute = props["attribute"]
            self.inner = only(props, mi.Texture, "dnr_uv_layer")

        def _uv(self, si: Any, active: Any) -> Any:
            uv = si.shape.eval_attribute_3(self.attribute, si, active)
            return mi.Point2f(uv.x, uv.y)

        def to_string(self) -> str:
            return f"dnr_uv_layer[attribute={self.attribute}]"

    class ViewTable(Moved):
        """The nested image has ``size`` columns, the cosine between view and normal 0 at the centre of the first and 1
        at that of the last, and two rows: seen from the front, seen from behind. The exporter evaluates Blender's
        formulas into it.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.size = int(props["size"])
            self.inner = only(props, mi.Texture, "dnr_view")

        def _uv(self, si: Any, active: Any) -> Any:
            del active
            cosine = mi.Frame3f.cos_theta(si.wi)
            along = (dr.minimum(dr.abs(cosine), 1) * (self.size - 1) + 0.5) / self.size
            return mi.Point2f(along, dr.select(cosine >= 0, 0.25, 0.75))

        def to_string(self) -> str:
            return f"dnr_view[size={self.size}]"

    mi.register_texture("dnr_uv_layer", UvLayer)
    mi.register_texture("dnr_view", ViewTable)
