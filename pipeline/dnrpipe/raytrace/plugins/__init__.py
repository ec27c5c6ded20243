"""Mitsuba plugins for what Blender has and Mitsuba has not: small Python textures, BSDFs, emitters and a camera.

The bundle names them in ``scene.xml`` (types ``dnr_*``), so whoever loads a bundle calls `register` after
``mi.set_variant`` and before ``mi.load_file``. In jit variants Dr.Jit compiles them into the render kernel (no
cost to speak of); ``scalar_rgb`` interprets them, some hundred times slower, so the exporters use them only where
a material needs one. One family per file; every class is made for the variant at hand, since its bases are.
"""

from __future__ import annotations

from typing import Any

from .. import paths
from . import cameras, emitters, layers, lookups, normals, refraction, sums, transparency


def register(mi: Any) -> None:
    """Make all ``dnr_*`` plugins known to the current variant of ``mi`` (the mitsuba module, variant set).

    Of jit variants the integrator ``dnr_path``, too. Calling it again for the same variant is harmless.
    """
    import drjit as dr

    if dr.is_jit_v(mi.Float):
        paths.register(mi)
    for family in (lookups, normals, sums, transparency, refraction, emitters, layers, cameras):
        family.register(mi)
