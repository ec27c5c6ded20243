"""Principled BSDF, one input at a time."""

from __future__ import annotations

import math

import bpy

from . import studio as s
from .catalogue import scene

GROUP = "Principled BSDF"
GOLD = (0.95, 0.68, 0.32)


@scene("diffuse only (specular level 0)", GROUP)
def principled_diffuse() -> None:
    s.lit(s.matte())


@scene("plastic, roughness 0.1", GROUP, formulas=("roughness_squared",))
def plastic_r01() -> None:
    s.lit(s.principled("Plastic", Roughness=0.1))


@scene("plastic, roughness 0.3", GROUP, formulas=("roughness_squared",))
def plastic_r03() -> None:
    s.lit(s.principled("Plastic", Roughness=0.3))


@scene("plastic, roughness 0.6", GROUP, formulas=("roughness_squared",))
def plastic_r06() -> None:
    s.lit(s.principled("Plastic", Roughness=0.6))


@scene("specular IOR level 1, IOR 1.6", GROUP)
def specular_level() -> None:
    s.lit(s.principled("Shiny", (0.1, 0.2, 0.4), Roughness=0.25, Specular_IOR_Level=1.0, IOR=1.6))


@scene("specular tint", GROUP)
def specular_tint() -> None:
    s.lit(s.principled("Tinted", (0.15, 0.15, 0.15), Roughness=0.25, Specular_Tint=(1.0, 0.35, 0.1, 1)))


@scene("metal, roughness 0", GROUP)
def metal_r00() -> None:
    s.lit(s.principled("Metal", GOLD, Metallic=1.0, Roughness=0.0))


@scene("metal, roughness 0.1", GROUP, formulas=("roughness_squared",))
def metal_r01() -> None:
    s.lit(s.principled("Metal", GOLD, Metallic=1.0, Roughness=0.1))


@scene("metal, roughness 0.3", GROUP, formulas=("roughness_squared",))
def metal_r03() -> None:
    s.lit(s.principled("Metal", GOLD, Metallic=1.0, Roughness=0.3))


@scene("metal, roughness 0.6", GROUP, formulas=("roughness_squared", "no_multiple_scattering"))
def metal_r06() -> None:
    s.lit(s.principled("Metal", GOLD, Metallic=1.0, Roughness=0.6))


@scene("metal, roughness 1", GROUP, formulas=("no_multiple_scattering",))
def metal_r10() -> None:
    s.lit(s.principled("Metal", GOLD, Metallic=1.0, Roughness=1.0))


@scene("half metallic", GROUP)
def metallic_half() -> None:
    s.lit(s.principled("Half", GOLD, Metallic=0.5, Roughness=0.3))


@scene("transmission, clear, tinted", GROUP, formulas=("glass_tint_base",))
def transmission_clear() -> None:
    s.lit(s.principled("Glass", (0.7, 0.9, 0.8), Transmission_Weight=1.0, Roughness=0.0, IOR=1.45))


@scene("transmission, roughness 0.3", GROUP)
def transmission_rough() -> None:
    s.lit(s.principled("Frosted", (0.7, 0.9, 0.8), Transmission_Weight=1.0, Roughness=0.3, IOR=1.45))


@scene("transmission 0.5 (mixed with diffuse)", GROUP)
def transmission_half() -> None:
    s.lit(s.principled("Half", (0.7, 0.9, 0.8), Transmission_Weight=0.5, Roughness=0.2, IOR=1.45))


@scene("coat on rough plastic", GROUP)
def coat() -> None:
    s.lit(s.principled("Coated", (0.5, 0.03, 0.03), Roughness=0.7, Coat_Weight=1.0, Coat_Roughness=0.05))


@scene("sheen", GROUP)
def sheen() -> None:
    s.lit(s.principled("Velvet", (0.15, 0.05, 0.2), Roughness=0.9, Sheen_Weight=1.0, Sheen_Roughness=0.5))


@scene("alpha 0.5", GROUP)
def alpha_constant() -> None:
    s.lit(s.principled("Half", s.CLAY, Roughness=1.0, Specular_IOR_Level=0.0, Alpha=0.5))


@scene("alpha 0.5 under a sun and an area lamp", GROUP)
def alpha_lamps() -> None:
    s.floor()
    s.subjects(s.principled("Half", s.CLAY, Roughness=0.4, Alpha=0.5))
    s.lamp("SUN", 2.0, (1.5, -1.0, 3.0), angle=0.02)
    s.lamp("AREA", 60, (-2.0, -1.0, 2.0), size=0.5)


@scene("emission colour and strength", GROUP)
def principled_emission() -> None:
    material = s.principled("Glow", (0.1, 0.1, 0.1), Roughness=1.0, Specular_IOR_Level=0.0, Emission_Strength=0.8)
    material.node_tree.nodes["Principled BSDF"].inputs["Emission Color"].default_value = (1.0, 0.4, 0.1, 1)
    s.lit(material)


@scene("subsurface weight 1, radius 0.1", GROUP)
def subsurface() -> None:
    material = s.principled("Skin", (0.8, 0.5, 0.4), Roughness=0.5, Subsurface_Weight=1.0, Subsurface_Scale=0.1)
    s.lit(material)


@scene("subsurface weight 1, radius 0.3, thin parts", GROUP)
def subsurface_deep() -> None:
    s.sky()
    s.floor()
    s.lamp("AREA", 100, (0.5, 2.5, 2.0), size=0.5)
    bpy.ops.mesh.primitive_monkey_add(size=1.5, location=(0, 0, 0.75))
    s.smooth(bpy.context.object).data.materials.append(
        s.principled("Skin", (0.8, 0.5, 0.4), Roughness=0.5, Subsurface_Weight=1.0, Subsurface_Scale=0.3)
    )


@scene("anisotropic metal", GROUP)
def anisotropic() -> None:
    material = s.principled("Brushed", GOLD, Metallic=1.0, Roughness=0.35, Anisotropic=0.8)
    tangent = s.node(material, "ShaderNodeTangent")
    tangent.direction_type, tangent.axis = "RADIAL", "Z"
    s.into(material, tangent.outputs[0], "Tangent")
    s.lit(material)


@scene("thin film, 500 nm", GROUP)
def thin_film() -> None:
    s.lit(s.principled("Film", (0.02, 0.02, 0.02), Roughness=0.1, Thin_Film_Thickness=500.0, Thin_Film_IOR=1.33))


@scene("diffuse roughness 1 (Oren-Nayar)", GROUP)
def diffuse_roughness() -> None:
    s.lit(s.principled("Dust", Roughness=1.0, Specular_IOR_Level=0.0, Diffuse_Roughness=1.0))


@scene("smooth-shaded low polygon count", GROUP)
def smooth_low_poly() -> None:
    s.sky()
    s.floor()
    material = s.principled("Plastic", Roughness=0.3)
    import bpy

    bpy.ops.mesh.primitive_monkey_add(size=1.5, location=(0, 0, 0.75), rotation=(-0.6, 0, math.radians(20)))
    s.smooth(bpy.context.object).data.materials.append(material)
