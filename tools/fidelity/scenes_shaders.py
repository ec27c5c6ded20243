"""Shader nodes other than Principled: single closures, mixes, volumes."""

from __future__ import annotations

from . import studio as s
from .catalogue import scene

GROUP = "Shader nodes"
VOLUMES = "Volumes"
RED = ("ShaderNodeBsdfDiffuse", {"Color": (0.7, 0.1, 0.08, 1)})
GLOSS = ("ShaderNodeBsdfGlossy", {"Color": (0.8, 0.8, 0.8, 1), "Roughness": 0.2})


@scene("Diffuse", GROUP)
def diffuse_node() -> None:
    s.lit(s.diffuse("Diffuse", s.CLAY))


@scene("Diffuse, roughness 1 (Oren-Nayar)", GROUP)
def diffuse_node_rough() -> None:
    s.lit(s.shader("Rough", "ShaderNodeBsdfDiffuse", Color=(*s.CLAY, 1), Roughness=1.0))


@scene("Glossy, roughness 0.2", GROUP)
def glossy_node() -> None:
    s.lit(s.shader("Glossy", "ShaderNodeBsdfGlossy", Color=(0.7, 0.8, 0.9, 1), Roughness=0.2))


@scene("Glossy, anisotropic", GROUP)
def glossy_anisotropic() -> None:
    material = s.shader("Brushed", "ShaderNodeBsdfGlossy", Color=(0.7, 0.8, 0.9, 1), Roughness=0.3, Anisotropy=0.7)
    tangent = s.node(material, "ShaderNodeTangent")
    tangent.direction_type, tangent.axis = "RADIAL", "Z"
    glossy = next(n for n in material.node_tree.nodes if n.type == "BSDF_GLOSSY")
    s.link(material, tangent.outputs[0], glossy.inputs["Tangent"])
    s.lit(material)


@scene("Metallic (F82)", GROUP)
def metallic_node() -> None:
    material = s.shader("Metal", "ShaderNodeBsdfMetallic", Base_Color=(0.9, 0.6, 0.3, 1), Roughness=0.25)
    next(n for n in material.node_tree.nodes if n.type == "BSDF_METALLIC").fresnel_type = "F82"
    s.lit(material)


@scene("Glass, smooth, tinted", GROUP, formulas=("glass_tint_base",))
def glass_node() -> None:
    s.lit(s.shader("Glass", "ShaderNodeBsdfGlass", Color=(0.8, 0.9, 1.0, 1), Roughness=0.0, IOR=1.45))


@scene("Glass, roughness 0.3", GROUP)
def glass_node_rough() -> None:
    s.lit(s.shader("Glass", "ShaderNodeBsdfGlass", Color=(0.8, 0.9, 1.0, 1), Roughness=0.3, IOR=1.45))


@scene("Refraction, smooth", GROUP)
def refraction_node() -> None:
    s.lit(s.shader("Lens", "ShaderNodeBsdfRefraction", Color=(0.8, 0.9, 1.0, 1), Roughness=0.0, IOR=1.3))


@scene("Refraction, roughness 0.3", GROUP)
def refraction_node_rough() -> None:
    s.lit(s.shader("Lens", "ShaderNodeBsdfRefraction", Color=(0.8, 0.9, 1.0, 1), Roughness=0.3, IOR=1.3))


@scene("Transparent, white", GROUP)
def transparent_clear() -> None:
    s.lit(s.shader("Clear", "ShaderNodeBsdfTransparent", Color=(1, 1, 1, 1)))


@scene("Transparent, tinted", GROUP)
def transparent_tinted() -> None:
    s.lit(s.shader("Gel", "ShaderNodeBsdfTransparent", Color=(0.9, 0.4, 0.2, 1)))


@scene("Translucent", GROUP)
def translucent_node() -> None:
    s.lit(s.shader("Paper", "ShaderNodeBsdfTranslucent", Color=(0.8, 0.7, 0.4, 1)))


@scene("Sheen", GROUP)
def sheen_node() -> None:
    s.lit(s.shader("Velvet", "ShaderNodeBsdfSheen", Color=(0.8, 0.3, 0.5, 1), Roughness=0.5))


@scene("Subsurface Scattering", GROUP)
def subsurface_node() -> None:
    s.lit(s.shader("Wax", "ShaderNodeSubsurfaceScattering", Color=(0.8, 0.6, 0.4, 1), Scale=0.1))


@scene("Emission", GROUP)
def emission_node() -> None:
    s.lit(s.shader("Glow", "ShaderNodeEmission", Color=(0.4, 0.9, 0.6, 1), Strength=0.9))


@scene("Mix Shader, constant factor", GROUP)
def mix_constant() -> None:
    material, mix = s.mixed("Mixed", RED, GLOSS)
    mix.inputs[0].default_value = 0.35
    s.lit(material)


@scene("Mix Shader, image factor", GROUP)
def mix_image() -> None:
    material, mix = s.mixed("Mixed", RED, GLOSS)
    picture = s.node(material, "ShaderNodeTexImage")
    picture.image = s.image("factor", s.chart(), data=True)
    s.link(material, picture.outputs["Color"], mix.inputs[0])
    s.lit(material, floor_material=material)


@scene("Mix Shader, Fresnel factor", GROUP)
def mix_fresnel() -> None:
    material, mix = s.mixed("Varnish", RED, GLOSS)
    factor = s.node(material, "ShaderNodeFresnel", IOR=1.6)
    s.link(material, factor.outputs[0], mix.inputs[0])
    s.lit(material)


@scene("Mix Shader, Layer Weight (Fresnel)", GROUP)
def mix_layer_fresnel() -> None:
    material, mix = s.mixed("Varnish", RED, GLOSS)
    factor = s.node(material, "ShaderNodeLayerWeight", Blend=0.4)
    s.link(material, factor.outputs["Fresnel"], mix.inputs[0])
    s.lit(material)


@scene("Mix Shader, Layer Weight (Facing)", GROUP)
def mix_layer_facing() -> None:
    material, mix = s.mixed("Varnish", RED, GLOSS)
    factor = s.node(material, "ShaderNodeLayerWeight", Blend=0.6)
    s.link(material, factor.outputs["Facing"], mix.inputs[0])
    s.lit(material)


@scene("Mix Shader, Fresnel through ColorRamp", GROUP)
def mix_fresnel_ramp() -> None:
    material, mix = s.mixed("Varnish", RED, GLOSS)
    factor, ramp = s.node(material, "ShaderNodeFresnel", IOR=1.5), s.node(material, "ShaderNodeValToRGB")
    ramp.color_ramp.elements[1].position = 0.4
    s.link(material, factor.outputs[0], ramp.inputs[0])
    s.link(material, ramp.outputs[0], mix.inputs[0])
    s.lit(material)


@scene("Add Shader, two closures", GROUP)
def add_closures() -> None:
    material = s.shader("Sum", "ShaderNodeBsdfDiffuse", Color=(0.35, 0.08, 0.06, 1))
    tree = material.node_tree
    add, gloss = tree.nodes.new("ShaderNodeAddShader"), s.add_shader(material, GLOSS[0], Color=(0.3, 0.3, 0.3, 1))
    gloss.inputs["Roughness"].default_value = 0.2
    s.link(material, tree.nodes["Diffuse BSDF"].outputs[0], add.inputs[0])
    s.link(material, gloss.outputs[0], add.inputs[1])
    s.link(material, add.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    s.lit(material)


@scene("Add Shader, closure and emission", GROUP)
def add_emission() -> None:
    material = s.shader("Sum", "ShaderNodeBsdfDiffuse", Color=(*s.CLAY, 1))
    tree = material.node_tree
    add, glow = tree.nodes.new("ShaderNodeAddShader"), s.add_shader(material, "ShaderNodeEmission", Strength=0.3)
    s.link(material, tree.nodes["Diffuse BSDF"].outputs[0], add.inputs[0])
    s.link(material, glow.outputs[0], add.inputs[1])
    s.link(material, add.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    s.lit(material)


@scene("Glass that lets shadow rays through (Light Path)", GROUP)
def light_path_shadow() -> None:
    material, mix = s.mixed(
        "Glass",
        ("ShaderNodeBsdfGlass", {"Color": (0.9, 1, 0.95, 1), "Roughness": 0.0, "IOR": 1.45}),
        ("ShaderNodeBsdfTransparent", {}),
    )
    path = s.node(material, "ShaderNodeLightPath")
    s.link(material, path.outputs["Is Shadow Ray"], mix.inputs[0])
    s.lit(material)


@scene("Volume Absorption", VOLUMES, samples=2)
def volume_absorption() -> None:
    material = s.shader("Ink", "ShaderNodeBsdfTransparent")
    s.add_shader(material, "ShaderNodeVolumeAbsorption", "Volume", Color=(0.3, 0.7, 0.9, 1), Density=2.0)
    s.lit(material)


@scene("Volume Scatter", VOLUMES, samples=2)
def volume_scatter() -> None:
    material = s.shader("Smoke", "ShaderNodeBsdfTransparent")
    s.add_shader(material, "ShaderNodeVolumeScatter", "Volume", Color=(0.9, 0.8, 0.7, 1), Density=2.0, Anisotropy=0.3)
    s.lit(material)


@scene("Principled Volume", VOLUMES, samples=2)
def volume_principled() -> None:
    material = s.shader("Fog", "ShaderNodeBsdfTransparent")
    s.add_shader(material, "ShaderNodeVolumePrincipled", "Volume", Color=(0.6, 0.8, 0.9, 1), Density=1.5)
    s.lit(material)


@scene("glass filled with absorption", VOLUMES, samples=2)
def volume_in_glass() -> None:
    material = s.shader("Drink", "ShaderNodeBsdfGlass", Roughness=0.0, IOR=1.33)
    s.add_shader(material, "ShaderNodeVolumeAbsorption", "Volume", Color=(0.9, 0.4, 0.1, 1), Density=1.5)
    s.lit(material)
