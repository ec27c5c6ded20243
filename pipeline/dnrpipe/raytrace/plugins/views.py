"""Texture ``dnr_view``: a value that depends on the angle of view (Fresnel, Layer Weight and what is made of them)."""

from __future__ import annotations

from typing import Any

from .nesting import only, wrapped_texture


def register(mi: Any) -> None:
    """``dnr_view`` for the current variant."""
    import drjit as dr

    class ViewTable(wrapped_texture(mi)):
        """One nested texture, looked up by the cosine between view and normal instead of by UV.

        The nested image has ``size`` columns, cosine 0 at the centre of the first and 1 at that of the last, and
        two rows: seen from the front, seen from behind. The exporter evaluates Blender's formulas into it.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.size = int(props["size"])
            self.inner = only(props, mi.Texture, "dnr_view")

        def _moved(self, si: Any) -> Any:
            cosine = mi.Frame3f.cos_theta(si.wi)
            moved = mi.SurfaceInteraction3f(si)
            along = (dr.minimum(dr.abs(cosine), 1) * (self.size - 1) + 0.5) / self.size
            moved.uv = mi.Point2f(along, dr.select(cosine >= 0, 0.25, 0.75))
            return moved

        def eval(self, si: Any, active: Any = True) -> Any:
            return self.inner.eval(self._moved(si), active)

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return self.inner.eval_1(self._moved(si), active)

        def eval_3(self, si: Any, active: Any = True) -> Any:
            return self.inner.eval_3(self._moved(si), active)

        def to_string(self) -> str:
            return f"dnr_view[size={self.size}]"

    mi.register_texture("dnr_view", ViewTable)
