"""Parts of a BSDF: its diffuse lobes apart from those that mirror and refract."""

from __future__ import annotations

from typing import Any

IGNORE_CONTEXT = "Principled BSDF :"
"""How Mitsuba's BSDFs ``principled`` and ``principledthin`` print themselves. They do not split into lobes, so all of
what they do, or what they are nested in does, is taken for diffuse, but for what passes straight on."""


WIDE = 1.0
"""Density, 1/sr, below which a lobe is wide."""


def bsdfs_of(scene: Any) -> list[Any]:
    """The scene's BSDFs, each once."""
    return list({id(b): b for b in [shape.bsdf() for shape in scene.shapes()] if b is not None}.values())


def media_of(scene: Any) -> list[Any]:
    """The media inside the scene's shapes, each once."""
    inner = [shape.interior_medium() for shape in scene.shapes() if shape.is_medium_transition()]
    return list({id(medium): medium for medium in inner if medium is not None}.values())


def lets_through(mi: Any, scene: Any) -> bool:
    """Whether a surface of the scene passes light straight on."""
    return any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs_of(scene))


def ignores_context(bsdf: Any) -> bool:
    """Whether the BSDF, or one nested in it, evaluates all its lobes whatever it is asked for."""
    return IGNORE_CONTEXT in str(bsdf)


def context_of(mi: Any, *flags: Any) -> Any:
    """Context of the lobes that have any of the flags."""
    context = mi.BSDFContext()
    context.type_mask = 0
    for flag in flags:
        context.type_mask |= int(flag)
    return context


def diffuse_context(mi: Any) -> Any:
    """Context of the diffuse lobes alone."""
    return context_of(mi, mi.BSDFFlags.Diffuse)


def specular_context(mi: Any) -> Any:
    """Context of the lobes that mirror and refract, sharp or rough."""
    return context_of(mi, mi.BSDFFlags.Glossy, mi.BSDFFlags.Delta)


def is_rough(mi: Any, bsdf: Any, context: Any, si: Any, active: Any) -> Any:
    """Whether the lobes of ``context`` are one wide glossy reflection: from roughness 0.5 of GGX on.

    By the density of a direction from the middle of the lobe seen straight on, whatever ``si.wi`` is: baked light and
    views must agree.
    """
    import drjit as dr

    glossy = mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection)
    others = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.GlossyTransmission)
    active = active & glossy & ((bsdf.flags() & others) == 0)
    ahead = mi.SurfaceInteraction3f(si)
    ahead.wi = mi.Vector3f(0, 0, dr.select(si.wi.z < 0, -1.0, 1.0))
    middle, _ = bsdf.sample(context, ahead, 0.5, mi.Point2f(0.5, 0.5), active)
    return active & (middle.pdf > 0) & (middle.pdf < WIDE)


def mean_of(colour: Any) -> Any:
    """Mean over the colours. ``dr.mean`` writes the number of lanes into the kernel: one to compile for each size."""
    import drjit as dr

    return dr.sum(colour) / len(colour)


def reflectance(mi: Any, bsdf: Any, context: Any, si: Any, active: Any, translucent: bool = True) -> Any:
    """rho of the notation, per colour. ``si.wi`` decides which layers above attenuate it.

    translucent: False where no surface of the scene transmits diffusely, which spares half the work.
    """
    import drjit as dr

    same = mi.Vector3f(0, 0, dr.select(si.wi.z < 0, -1.0, 1.0))
    value = bsdf.eval(context, si, same, active)
    if translucent:
        value += bsdf.eval(context, si, -same, active)
    return value * dr.pi


def mirrors_and_refracts(mi: Any, flags: Any) -> Any:
    """Of a BSDF's flags: whether it has lobes other than diffuse both of reflection and of transmission."""
    mirrors = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.GlossyReflection)
    refracts = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)
    return ((flags & mirrors) != 0) & ((flags & refracts) != 0)


def is_among(mi: Any, bsdf: Any, members: list[Any]) -> Any:
    """Whether ``bsdf`` is one of ``members``, lane by lane."""
    found = mi.Mask(False)
    for member in members:
        found |= bsdf == mi.BSDFPtr(member)
    return found
