"""Texture ``dnr_uv_layer``: another texture, looked up by another UV layer than the shape's own."""

from __future__ import annotations

from typing import Any

from .nesting import only, wrapped_texture


def register(mi: Any) -> None:
    """``dnr_uv_layer`` for the current variant."""

    class UvLayer(wrapped_texture(mi)):
        """``attribute``: string, a vertex attribute of 3 floats (u, v, unused). One nested texture.

        ``channel``: -1 for the colour (default), or 0 to 2: that channel of the nested texture as a scalar.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.attribute = props["attribute"]
            self.channel = int(props.get("channel", -1))
            self.inner = only(props, mi.Texture, "dnr_uv_layer")

        def _moved(self, si: Any, active: Any) -> Any:
            uv = si.shape.eval_attribute_3(self.attribute, si, active)
            moved = mi.SurfaceInteraction3f(si)
            moved.uv = mi.Point2f(uv.x, uv.y)
            return moved

        def eval(self, si: Any, active: Any = True) -> Any:
            if self.channel >= 0:
                return mi.UnpolarizedSpectrum(self.eval_1(si, active))
            return self.inner.eval(self._moved(si, active), active)

        def eval_1(self, si: Any, active: Any = True) -> Any:
            moved = self._moved(si, active)
            if self.channel >= 0:
                return self.inner.eval_3(moved, active)[self.channel]
            return self.inner.eval_1(moved, active)

        def eval_3(self, si: Any, active: Any = True) -> Any:
            if self.channel >= 0:
                return mi.Color3f(self.eval_1(si, active))
            return self.inner.eval_3(self._moved(si, active), active)

        def to_string(self) -> str:
            return f"dnr_uv_layer[attribute={self.attribute}, channel={self.channel}]"

    mi.register_texture("dnr_uv_layer", UvLayer)
