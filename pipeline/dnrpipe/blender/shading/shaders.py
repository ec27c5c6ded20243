"""Blender's shader nodes -> Mitsuba BSDFs: the walk over a material's shader tree.

One method per node, by family: `lobes` (what reflects), `interfaces` (what transmits), `principled`, `mixing`,
`volumes` (what fills a mesh); `normals` bends their normals. Whatever is not converted exactly is recorded as a finding
with the material's name.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from .mixing import MixShaders
from .principled import PrincipledShader
from .sockets import Source, surface_source
from .surface import Surface
from .textures import constant
from .volumes import VolumeShaders


class ShaderWalker(PrincipledShader, MixShaders, VolumeShaders):
    """Walks the shader tree of one material."""

    def material(self) -> Surface:
        tree = self.blender.node_tree
        if tree is None:
            return self._viewport_material()
        source = surface_source(tree)
        if source is None and surface_source(tree, "Volume") is not None:
            return Surface(None, opacity=constant(0.0))
        if source is None:
            self.note("exact", "no surface shader", "renders black, as in Cycles")
            return Surface(None)
        return self._displaced(surface_source(tree, "Displacement"), self.shader(source))

    def inside(self) -> ET.Element | None:
        """The medium that fills a mesh of this material; None where it is empty."""
        tree = self.blender.node_tree
        return None if tree is None else self.medium(surface_source(tree, "Volume"))

    def shader(self, source: Source) -> Surface:
        """Convert the shader that ends in ``source``."""
        handlers = {
            "BSDF_PRINCIPLED": self._principled,
            "BSDF_DIFFUSE": self._diffuse,
            "BSDF_GLOSSY": self._glossy,
            "BSDF_ANISOTROPIC": self._glossy,
            "BSDF_METALLIC": self._metallic,
            "BSDF_GLASS": self._glass,
            "BSDF_REFRACTION": self._refraction,
            "BSDF_TRANSPARENT": self._transparent,
            "BSDF_TRANSLUCENT": self._translucent,
            "BSDF_SHEEN": self._sheen,
            "BSDF_VELVET": self._sheen,
            "SUBSURFACE_SCATTERING": self._subsurface,
            "BSDF_HAIR_PRINCIPLED": self._hair,
            "HOLDOUT": self._holdout,
            "EMISSION": self._emission,
            "BACKGROUND": self._emission,
            "MIX_SHADER": self._mix,
            "ADD_SHADER": self._add,
        }
        return handlers.get(source.node.type, self._as_diffuse)(source.node, source.scope)
