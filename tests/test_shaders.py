"""Shaders, volumes, lamps and worlds that need more than Mitsuba's own plugins: Cycles and the bundle agree."""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")


def _helpers() -> Any:
    """tests/test_export.py: its scene builders and renderers."""
    path = Path(__file__).with_name("test_export.py")
    spec = importlib.util.spec_from_file_location("dnr_export_helpers", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


T = _helpers()
SIZE = 32


def material(name: str = "Material") -> Any:
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.node_tree.nodes.remove(made.node_tree.nodes["Principled BSDF"])
    return made


def node(of: Any, kind: str, **inputs: Any) -> Any:
    made = of.node_tree.nodes.new(kind)
    for key, value in inputs.items():
        made.inputs[key].default_value = value
    return made


def output(of: Any, last: Any, socket: str = "Surface") -> None:
    of.node_tree.links.new(last.outputs[0], of.node_tree.nodes["Material Output"].inputs[socket])


def combined(of: Any, kind: str, first: Any, second: Any, factor: Any = None) -> Any:
    made = of.node_tree.nodes.new(kind)
    sockets = [socket for socket in made.inputs if socket.type == "SHADER"]
    of.node_tree.links.new(first.outputs[0], sockets[0])
    of.node_tree.links.new(second.outputs[0], sockets[1])
    if factor is not None:
        of.node_tree.links.new(factor, made.inputs[0])
    return made


def stage(light: Callable[[], Any] = T.hdri) -> None:
    T.empty_scene()
    light()
    T.floor(T.shader_material("Floor", "ShaderNodeBsdfDiffuse", Color=(0.6, 0.5, 0.4, 1)))


def fresnel_mix() -> None:
    T.empty_scene()
    T.hdri()
    made = material()
    diffuse = node(made, "ShaderNodeBsdfDiffuse", Color=(0.7, 0.1, 0.1, 1))
    gloss = node(made, "ShaderNodeBsdfGlossy", Roughness=0.2)
    fresnel = node(made, "ShaderNodeFresnel", IOR=1.6)
    output(made, combined(made, "ShaderNodeMixShader", diffuse, gloss, fresnel.outputs[0]))
    T.ball(made)


def facing_colours() -> None:
    T.empty_scene()
    T.world()
    made = material()
    weight, ramp = node(made, "ShaderNodeLayerWeight", Blend=0.3), node(made, "ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.8, 0.1, 0.05, 1)
    ramp.color_ramp.elements[1].color = (0.05, 0.2, 0.9, 1)
    diffuse = node(made, "ShaderNodeBsdfDiffuse")
    made.node_tree.links.new(weight.outputs["Facing"], ramp.inputs[0])
    made.node_tree.links.new(ramp.outputs[0], diffuse.inputs["Color"])
    output(made, diffuse)
    T.ball(made)


def added_shaders() -> None:
    T.empty_scene()
    T.hdri()
    made = material()
    diffuse = node(made, "ShaderNodeBsdfDiffuse", Color=(0.3, 0.1, 0.1, 1))
    gloss = node(made, "ShaderNodeBsdfGlossy", Color=(0.4, 0.4, 0.5, 1), Roughness=0.3)
    output(made, combined(made, "ShaderNodeAddShader", diffuse, gloss))
    T.ball(made)


def tinted_transparency() -> None:
    stage(T.world)
    made = material()
    output(made, node(made, "ShaderNodeBsdfTransparent", Color=(0.3, 0.8, 0.5, 1)))
    T.ball(made)


def own_glass() -> None:
    """Refraction and Glossy mixed by Fresnel: as many artists build their glass."""
    stage()
    made = material()
    fresnel = node(made, "ShaderNodeFresnel", IOR=1.45)
    through = node(made, "ShaderNodeBsdfRefraction", IOR=1.45, Roughness=0.0)
    mirror = node(made, "ShaderNodeBsdfGlossy", Roughness=0.0)
    output(made, combined(made, "ShaderNodeMixShader", through, mirror, fresnel.outputs[0]))
    T.ball(made)


def translucent_sheet() -> None:
    stage(T.world)
    made = material()
    output(made, node(made, "ShaderNodeBsdfTranslucent", Color=(0.6, 0.7, 0.3, 1)))
    sheet = T.floor(made, 1.2)
    sheet.location, sheet.rotation_euler = (0, 0, 0.7), (0.9, 0, 0)


def coat() -> None:
    T.empty_scene()
    T.hdri()
    T.ball(T.principled("Coat", (0.6, 0.1, 0.1), Roughness=0.6, Coat_Weight=1.0, Coat_Roughness=0.15))


def tinted_specular() -> None:
    T.empty_scene()
    T.hdri()
    made = T.principled("Tint", (0.1, 0.1, 0.1), Roughness=0.3)
    made.node_tree.nodes["Principled BSDF"].inputs["Specular Tint"].default_value = (1, 0.5, 0.2, 1)
    T.ball(made)


def very_rough_metal() -> None:
    T.empty_scene()
    T.hdri()
    T.ball(T.principled("Metal", (0.9, 0.6, 0.3), Metallic=1.0, Roughness=0.9))


def bump() -> None:
    T.empty_scene()
    T.hdri()
    made = T.principled("Bump", (0.5, 0.5, 0.5), Roughness=0.6)
    y, x = np.mgrid[0:128, 0:128] / 128 * 2 * np.pi
    height = (0.5 + 0.25 * np.sin(3 * x) + 0.25 * np.cos(2 * y))[..., None].repeat(3, 2).astype(np.float32)
    picture, bent = node(made, "ShaderNodeTexImage"), node(made, "ShaderNodeBump", Strength=1.0, Distance=0.15)
    picture.image = T.image("height", height, is_float=True)
    links = made.node_tree.links
    links.new(picture.outputs[0], bent.inputs["Height"])
    links.new(bent.outputs[0], made.node_tree.nodes["Principled BSDF"].inputs["Normal"])
    T.floor(made, 2.4)


def absorbing_volume() -> None:
    stage(T.world)
    made = material()
    output(made, node(made, "ShaderNodeVolumeAbsorption", Color=(0.3, 0.6, 0.9, 1), Density=1.5), "Volume")
    T.ball(made)


def scattering_volume() -> None:
    stage(T.world)
    made = material()
    made_of = node(made, "ShaderNodeVolumePrincipled", Color=(0.5, 0.7, 0.4, 1), Density=3.0, Anisotropy=0.3)
    output(made, made_of, "Volume")
    T.ball(made)
    bpy.context.scene.cycles.volume_bounces = 12


def glowing_half_transparent_sheet() -> None:
    stage(lambda: None)
    made = T.principled("Glow", (0, 0, 0), Emission_Strength=6.0, Specular_IOR_Level=0.0, Alpha=0.5)
    sheet = T.floor(made, 0.8)
    sheet.location, sheet.rotation_euler = (0, 0.3, 1.0), (1.2, 0.3, 0)


def wide_spot_with_radius() -> None:
    stage(lambda: None)
    T.lamp("SPOT", 200, (0.5, -0.3, 2.5), (0.15, 0.1, 0), spot_size=1.0, spot_blend=0.4, shadow_soft_size=0.3)
    T.lamp("SPOT", 40, (-0.8, 0.3, 1.0), spot_size=math.radians(178), spot_blend=0.3, shadow_soft_size=0.0)


def area_spread() -> None:
    stage(lambda: None)
    T.lamp("AREA", 30, (0.2, -0.3, 1.6), (0.15, 0.1, 0), size=0.6, spread=math.radians(60))


def soft_point_not_normalised() -> None:
    stage(lambda: None)
    T.lamp("POINT", 60, (0.6, -0.5, 1.2), shadow_soft_size=0.4, use_soft_falloff=True)
    T.lamp("POINT", 8, (-0.6, 0.5, 1.2), shadow_soft_size=0.2, use_soft_falloff=False, normalize=False)


def hidden_from_the_camera() -> None:
    """A ball that only shades, shines and shows in mirrors; a lamp between camera and floor is no obstacle either."""
    stage(lambda: None)
    T.ball(T.principled("Glow", (0, 0, 0), Emission_Strength=0.0), (0, -0.2, 0.5), 0.4).visible_camera = False
    T.lamp("AREA", 60, (0.3, -1.6, 1.2), (1.0, 0, 0), size=0.8)


# Energy within, relative RMSE within (of means over 4 x 4 pixels; a third of it and more is noise).
CASES: list[tuple[Callable[[], None], float, float]] = [
    (fresnel_mix, 0.04, 0.14),
    (facing_colours, 0.01, 0.02),
    (added_shaders, 0.02, 0.05),
    (tinted_transparency, 0.01, 0.02),
    (own_glass, 0.02, 0.05),
    (translucent_sheet, 0.01, 0.03),
    (coat, 0.02, 0.08),
    (tinted_specular, 0.02, 0.08),
    (very_rough_metal, 0.02, 0.06),
    (bump, 0.03, 0.05),
    (absorbing_volume, 0.01, 0.02),
    (scattering_volume, 0.02, 0.03),
    (glowing_half_transparent_sheet, 0.02, 0.03),
    (wide_spot_with_radius, 0.02, 0.03),
    (area_spread, 0.02, 0.03),
    (soft_point_not_normalised, 0.02, 0.02),
    (hidden_from_the_camera, 0.02, 0.04),
]
QUICK = (fresnel_mix, own_glass, translucent_sheet, coat, bump, scattering_volume, area_spread,
         soft_point_not_normalised, hidden_from_the_camera)  # fmt: skip


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba_variant")
@pytest.mark.parametrize(
    ("build", "energy", "rmse"), T.halves(CASES, QUICK), ids=lambda v: getattr(v, "__name__", None)
)
def test_matches_cycles(
    build: Callable[[], None], energy: float, rmse: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("SIZE", SIZE), ("SPP", 256), ("MITSUBA_SPP", 512)):
        monkeypatch.setattr(T, name, value)
    build()
    ratio, error, _ = T.compare(tmp_path)
    assert abs(ratio - 1) < energy
    assert error < rmse


def test_sun_of_a_sky_becomes_a_lamp_of_the_same_light(monkeypatch: pytest.MonkeyPatch) -> None:
    from dnrpipe.blender.lighting import sky_sun, world_images

    T.empty_scene()
    made = T.world()
    sky = made.node_tree.nodes.new("ShaderNodeTexSky")
    sky.sun_elevation, sky.sun_rotation, sky.sun_size = 0.5, 0.4, math.radians(1.0)
    made.node_tree.links.new(sky.outputs[0], made.node_tree.nodes["Background"].inputs[0])
    sun = sky_sun.find_sun(made)
    assert sun is not None
    irradiance = sky_sun.measure(made, sun)
    # The same sun, found in a wider view of the sky with and without its disc.
    size, angle = 96, 0.2
    with_disc = world_images.render_close_up(made, sun.direction, angle, size)
    with sky_sun.without_disc(sun):
        without = world_images.render_close_up(made, sun.direction, angle, size)
    assert sky.sun_disc
    pixel = (2 * math.tan(angle / 2) / size) ** 2
    assert irradiance == pytest.approx((with_disc - without).sum(axis=(0, 1)) * pixel, rel=0.05)
    bright = np.argwhere(with_disc.sum(-1) > 0.5 * with_disc.sum(-1).max()).mean(axis=0)
    assert bright == pytest.approx([size / 2 - 0.5] * 2, abs=1)


def test_light_passes_tinted_leaves_and_their_masks_keep_the_mean_opacity(tmp_path: Path) -> None:
    """Glass faked by Fresnel between Transparent and Glossy: the angle decides while tracing, the mean for alpha."""
    from dnrpipe.blender.findings import Findings
    from dnrpipe.blender.shading.materials import MaterialConverter
    from dnrpipe.blender.shading.textures import Constant, ImageReader, TextureStore

    T.empty_scene()
    made = material()
    clear = node(made, "ShaderNodeBsdfTransparent", Color=(0.6, 0.8, 1, 1))
    gloss = node(made, "ShaderNodeBsdfGlossy", Roughness=0.1)
    fresnel = node(made, "ShaderNodeFresnel", IOR=1.5)
    output(made, combined(made, "ShaderNodeMixShader", clear, gloss, fresnel.outputs[0]))
    findings = Findings()
    converted = MaterialConverter(TextureStore(tmp_path), ImageReader(findings), findings).convert(made)
    assert converted.bsdf.get("type") == "dnr_transparent"
    assert converted.bsdf.find("texture[@type='dnr_view'][@name='opacity']") is not None
    assert isinstance(converted.opacity, Constant)
    assert converted.opacity.scalar == pytest.approx(0.0918, abs=0.002)  # mean Fresnel reflectance at 1.5


def test_lamp_nodes_become_their_colour_and_strength(tmp_path: Path) -> None:
    import xml.etree.ElementTree as ET

    T.empty_scene()
    T.floor(T.principled("Floor"))
    lamp = T.lamp("POINT", 4 * math.pi, (0, 0, 2), shadow_soft_size=0.0)
    lamp.data.use_nodes = True
    tree = lamp.data.node_tree
    colour, falloff = tree.nodes.new("ShaderNodeBlackbody"), tree.nodes.new("ShaderNodeLightFalloff")
    colour.inputs[0].default_value, falloff.inputs["Strength"].default_value = 3000, 0.5
    tree.links.new(colour.outputs[0], tree.nodes["Emission"].inputs["Color"])
    tree.links.new(falloff.outputs["Quadratic"], tree.nodes["Emission"].inputs["Strength"])
    findings = T.export(tmp_path)
    found = ET.parse(tmp_path / "scene.xml").getroot().find("emitter[@type='point']/rgb")
    assert found is not None
    values = [float(v) for v in found.get("value", "").split()]
    assert values == pytest.approx([0.885, 0.422, 0.136], rel=0.01)  # half of 3000 K of luminance 1
    assert not [finding for finding in findings if finding.object == "POINT"]


def test_hair_melanin_becomes_a_colour(tmp_path: Path) -> None:
    from dnrpipe.blender.findings import Findings
    from dnrpipe.blender.shading.materials import MaterialConverter
    from dnrpipe.blender.shading.textures import ImageReader, TextureStore

    T.empty_scene()
    shades = []
    for melanin in (0.2, 0.9):
        made = material()
        hair = node(made, "ShaderNodeBsdfHairPrincipled")
        hair.parametrization = "MELANIN"
        hair.inputs["Melanin"].default_value = melanin
        output(made, hair)
        findings = Findings()
        converted = MaterialConverter(TextureStore(tmp_path), ImageReader(findings), findings).convert(made)
        colour = converted.bsdf.find(".//rgb[@name='reflectance']")
        assert colour is not None and len(findings) == 1
        shades.append([float(v) for v in colour.get("value", "").split()])
    light, dark = np.array(shades)
    assert (light > 2 * dark).all() and light[0] > light[1] > light[2]
