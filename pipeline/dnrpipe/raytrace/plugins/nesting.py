"""What plugins share: finding the objects nested in them, numbers as data, one evaluation for value and density."""

from __future__ import annotations

from typing import Any


def nested(props: Any, kind: Any) -> list[Any]:
    """Objects of class ``kind`` (such as ``mi.Texture``) among a plugin's properties, in the file's order.

    Marks them as used, as Mitsuba refuses plugins with unused properties.
    """
    found = [props[name] for name in props.keys()]  # noqa: SIM118 (no mapping: iterating it is not defined)
    return [value for value in found if isinstance(value, kind)]


def only(props: Any, kind: Any, name: str) -> Any:
    """The one nested object of class ``kind``. Raises RuntimeError (as Mitsuba's own plugins do) otherwise."""
    found = nested(props, kind)
    if len(found) != 1:
        raise RuntimeError(f"{name}: needs exactly one nested {kind.__name__}, found {len(found)}")
    return found[0]


def parameter(mi: Any, value: float) -> Any:
    """A number of a plugin, kept out of the compiled code: instances that differ in numbers alone then share it.

    Thirty materials with numbers of their own took twenty times as long to compile as one.
    """
    import drjit as dr

    return dr.opaque(mi.Float, value) if dr.is_jit_v(mi.Float) else value


def evaluated_once(mi: Any) -> Any:
    """Base class of BSDFs that define ``eval_pdf``: what asks for one half leaves the other to the compiler to drop."""

    class EvaluatedOnce(mi.BSDF):
        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

    return EvaluatedOnce
