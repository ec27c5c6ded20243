"""Blender -> Mitsuba: what Cycles renders is what the exported bundle renders, feature by feature."""

from __future__ import annotations

import json
import math
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from dnrpipe.blender.baking.pending import convert_materials  # noqa: E402
from dnrpipe.blender.bundle.display import (  # noqa: E402
    LUT_K,
    LUT_MAX,
    LUT_SIZE,
    bake_lut,
    display_values,
    export_display,
)
from dnrpipe.blender.bundle.export import export_bundle  # noqa: E402
from dnrpipe.blender.bundle.shapes import closure  # noqa: E402
from dnrpipe.blender.findings import Findings  # noqa: E402
from dnrpipe.blender.geometry.freeze import freeze_scene  # noqa: E402
from dnrpipe.blender.shading.textures import linear_to_srgb  # noqa: E402
from dnrpipe.raytrace.visibility import camera_integrator  # noqa: E402

SIZE, SPP = 64, 256
MITSUBA_SPP = 1024
Rgb = tuple[float, float, float]


# ---------------------------------------------------------------- building scenes


def empty_scene() -> Any:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.location = (0.6, -4.0, 2.2)
    camera.rotation_euler = (math.radians(62), 0.0, math.radians(8.5))
    camera.data.lens = 50
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def principled(name: str, colour: Rgb = (0.8, 0.8, 0.8), **inputs: float) -> Any:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*colour, 1)
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    return material


def shader_material(name: str, kind: str, **inputs: Any) -> Any:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.remove(tree.nodes["Principled BSDF"])
    node = tree.nodes.new(kind)
    for key, value in inputs.items():
        node.inputs[key].default_value = value
    tree.links.new(node.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    return material


def floor(material: Any, size: float = 4.0) -> Any:
    bpy.ops.mesh.primitive_plane_add(size=size)
    bpy.context.object.data.materials.append(material)
    return bpy.context.object


def ball(material: Any, location: Rgb = (0, 0, 0.7), radius: float = 0.7) -> Any:
    bpy.ops.mesh.primitive_uv_sphere_add(segments=96, ring_count=48, radius=radius, location=location)
    bpy.ops.object.shade_smooth()
    bpy.context.object.data.materials.append(material)
    return bpy.context.object


def world(colour: Rgb = (1, 1, 1), strength: float = 1.0) -> Any:
    made = bpy.data.worlds.new("World")
    made.use_nodes = True
    background = made.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*colour, 1)
    background.inputs["Strength"].default_value = strength
    bpy.context.scene.world = made
    return made


def image(name: str, pixels: np.ndarray, *, data: bool = False, is_float: bool = False) -> Any:
    height, width = pixels.shape[:2]
    made = bpy.data.images.new(name, width, height, alpha=True, float_buffer=is_float, is_data=data)
    if is_float:
        made.colorspace_settings.name = "Linear Rec.709"
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., : pixels.shape[2]] = pixels
    made.pixels.foreach_set(rgba.ravel())
    made.pack()
    return made


def image_node(material: Any, picture: Any, socket: str, *, output: str = "Color") -> Any:
    tree = material.node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = picture
    tree.links.new(node.outputs[output], tree.nodes["Principled BSDF"].inputs[socket])
    return node


def quadrants(size: int = 256) -> np.ndarray:
    """Four colours and a ramp: any flip, swap or wrong decoding shows."""
    pixels = np.zeros((size, size, 3), np.float32)
    half = size // 2
    pixels[:half, :half] = (0.8, 0.1, 0.1)
    pixels[:half, half:] = (0.1, 0.7, 0.1)
    pixels[half:, :half] = (0.1, 0.2, 0.9)
    pixels[half:, half:] = np.linspace(0.1, 0.9, half)[None, :, None]
    return pixels


def lamp(kind: str, energy: float, location: Rgb, rotation: Rgb = (0, 0, 0), **fields: Any) -> Any:
    data = bpy.data.lights.new(kind, kind)
    data.energy = energy
    for key, value in fields.items():
        setattr(data, key, value)
    body = bpy.data.objects.new(kind, data)
    body.location, body.rotation_euler = location, rotation
    bpy.context.scene.collection.objects.link(body)
    return body


def sky_pixels() -> np.ndarray:
    """Dark sky with one coloured soft box off centre: a wrong rotation or mirroring shows."""
    v, u = np.mgrid[0:64, 0:128]
    pixels = np.full((64, 128, 3), 0.15, np.float32)
    pixels[..., 2] += 0.2 * v / 64
    box = (np.abs(u - 40) < 9) & (np.abs(v - 46) < 7)
    pixels[box] = (9.0, 6.0, 3.0)
    return pixels


def hdri(rotation: Rgb = (0, 0, 0), kind: str = "POINT", strength: float = 1.0) -> None:
    made = world(strength=strength)
    tree = made.node_tree
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image("sky", sky_pixels(), is_float=True)
    mapping, coordinates = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
    mapping.vector_type = kind
    mapping.inputs["Rotation"].default_value = rotation
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])


# ---------------------------------------------------------------- rendering both


def export(folder: Path) -> Findings:
    findings = Findings()
    meshes = freeze_scene(bpy.context.scene).meshes
    export_bundle(meshes, convert_materials(meshes, folder, findings, None))
    return findings


def cycles(path: Path) -> np.ndarray:
    """Linear RGBA [SIZE, SIZE, 4], box filter, no clamping, no denoising."""
    scene = bpy.context.scene
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x = render.resolution_y = SIZE
    render.resolution_percentage = 100
    render.film_transparent = True
    settings = scene.cycles
    settings.device, settings.samples = "CPU", SPP
    settings.use_denoising = settings.use_adaptive_sampling = False
    settings.pixel_filter_type = "BOX"
    settings.sample_clamp_direct = settings.sample_clamp_indirect = settings.blur_glossy = 0
    settings.caustics_reflective = settings.caustics_refractive = True
    for field in ("max", "diffuse", "glossy", "transmission"):
        setattr(settings, f"{field}_bounces", 11)
    settings.transparent_max_bounces = 11
    output = render.image_settings
    output.file_format, output.color_mode, output.color_depth = "OPEN_EXR", "RGBA", "32"
    render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    import OpenEXR

    with OpenEXR.File(str(path)) as file:
        return np.asarray(file.channels()["RGBA"].pixels, np.float32)


def mitsuba(folder: Path) -> np.ndarray:
    """The bundle's picture from the scene's camera, linear RGBA [SIZE, SIZE, 4]."""
    mi = pytest.importorskip("mitsuba")
    scene = mi.load_file(str(folder / "scene.xml"), parallel=False)
    camera = bpy.context.scene.camera
    pose = np.array(camera.matrix_world)
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(camera.data.angle),
            "to_world": mi.ScalarTransform4f(pose @ np.diag([-1.0, 1.0, -1.0, 1.0])),
            "film": {
                "type": "hdrfilm",
                "width": SIZE,
                "height": SIZE,
                "pixel_format": "rgba",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": MITSUBA_SPP},
        }
    )
    kind = "volpath" if scene.integrator().class_name().startswith("Vol") else "path"
    integrator, _ = camera_integrator(mi, scene, 12, kind)
    return np.array(mi.render(scene, sensor=sensor, spp=MITSUBA_SPP, integrator=integrator))


def compare(folder: Path) -> tuple[float, float, Findings]:
    """Energy ratio Mitsuba / Cycles, relative RMSE of covered 4 x 4 block means (noise averages out), findings."""
    bundle = folder / "bundle"
    findings = export(bundle)
    moved = folder / "moved" / "elsewhere"
    shutil.move(bundle, moved)  # portable: nothing may point to where it was made
    expected, found = cycles(folder / "cycles.exr"), mitsuba(moved)
    assert np.isfinite(found).all()

    def blocks(picture: np.ndarray) -> np.ndarray:
        return picture[..., :3].reshape(SIZE // 4, 4, SIZE // 4, 4, 3).mean(axis=(1, 3))

    a, b = blocks(expected), blocks(found)
    seen = expected[..., 3].reshape(SIZE // 4, 4, SIZE // 4, 4).mean(axis=(1, 3)) > 0
    ratio = float(b.mean() / a.mean())
    rmse = float(np.sqrt(((a - b)[seen] ** 2).mean()) / a[seen].mean())
    print(f"energy {ratio:.4f} relative RMSE {rmse:.4f}")
    return ratio, rmse, findings


# ---------------------------------------------------------------- one feature each


def textured_plane() -> None:
    empty_scene()
    world()
    material = principled("Textured", Roughness=0.6)
    image_node(material, image("quadrants", quadrants()), "Base Color")
    floor(material, 2.4)


def mapped_texture() -> None:
    """Mapping (Point: shift, turn, scale), nearest texels, a gamma node, through a node group and a reroute."""
    empty_scene()
    world()
    material = principled("Mapped", Roughness=1.0, Specular_IOR_Level=0.0)
    tree = material.node_tree
    picture = image_node(material, image("quadrants", quadrants()), "Base Color")
    picture.interpolation = "Closest"
    mapping, coordinates = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
    mapping.inputs["Location"].default_value = (0.2, 0.1, 0)
    mapping.inputs["Rotation"].default_value = (0, 0, math.radians(30))
    mapping.inputs["Scale"].default_value = (1.5, 0.8, 1)
    tree.links.new(coordinates.outputs["UV"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], picture.inputs["Vector"])
    group = bpy.data.node_groups.new("Darken", "ShaderNodeTree")
    group.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    group.interface.new_socket("Result", in_out="OUTPUT", socket_type="NodeSocketColor")
    inside, outside = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    gamma = group.nodes.new("ShaderNodeGamma")
    gamma.inputs["Gamma"].default_value = 1.6
    group.links.new(inside.outputs[0], gamma.inputs["Color"])
    group.links.new(gamma.outputs[0], outside.inputs[0])
    node, reroute = tree.nodes.new("ShaderNodeGroup"), tree.nodes.new("NodeReroute")
    node.node_tree = group
    tree.links.new(picture.outputs["Color"], reroute.inputs[0])
    tree.links.new(reroute.outputs[0], node.inputs[0])
    tree.links.new(node.outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"])
    floor(material, 2.4)


def metal() -> None:
    empty_scene()
    hdri()
    ball(principled("Metal", (0.9, 0.6, 0.3), Metallic=1.0, Roughness=0.3))


def rough_metal() -> None:
    empty_scene()
    hdri()
    ball(principled("Metal", (0.9, 0.6, 0.3), Metallic=1.0, Roughness=0.6))


def glossy() -> None:
    empty_scene()
    hdri()
    ball(shader_material("Glossy", "ShaderNodeBsdfGlossy", Color=(0.7, 0.8, 0.9, 1), Roughness=0.25))


def lacquer() -> None:
    empty_scene()
    hdri()
    ball(principled("Lacquer", (0.5, 0.02, 0.02), Roughness=0.1))


def clear_glass() -> None:
    empty_scene()
    world((0.9, 1.0, 1.1))
    floor(principled("Floor", (0.4, 0.5, 0.6), Roughness=0.9))
    ball(principled("Glass", (0.9, 0.95, 1.0), Roughness=0.0, IOR=1.45, Transmission_Weight=1.0))


def glass_node() -> None:
    empty_scene()
    world()
    floor(principled("Floor", (0.4, 0.5, 0.6), Roughness=0.9))
    ball(shader_material("Glass", "ShaderNodeBsdfGlass", Color=(0.9, 0.95, 1, 1), Roughness=0.3, IOR=1.45))


def area_light() -> None:
    empty_scene()
    floor(principled("Floor", (0.6, 0.5, 0.4), Roughness=1.0))
    ball(shader_material("Ball", "ShaderNodeBsdfDiffuse", Color=(0.3, 0.5, 0.7, 1)), radius=0.4)
    body = lamp("AREA", 60, (0.8, -0.6, 2.0), (0.3, 0.2, 0.1), shape="RECTANGLE", size=0.8, size_y=0.4)
    body.scale = (1.5, 0.7, 1.0)


def disc_light() -> None:
    empty_scene()
    floor(principled("Floor", (0.6, 0.5, 0.4), Roughness=1.0))
    lamp("AREA", 40, (0.4, 0.2, 1.6), shape="DISK", size=1.0, color=(1.0, 0.6, 0.3), exposure=1.0)


def sun() -> None:
    empty_scene()
    floor(shader_material("Floor", "ShaderNodeBsdfDiffuse", Color=(0.6, 0.5, 0.4, 1)))
    ball(shader_material("Ball", "ShaderNodeBsdfDiffuse", Color=(0.3, 0.5, 0.7, 1)), radius=0.4)
    lamp("SUN", 3.0, (0, 0, 5), (0.6, 0.4, 0.0), angle=math.radians(12))


def point() -> None:
    empty_scene()
    floor(shader_material("Floor", "ShaderNodeBsdfDiffuse", Color=(0.6, 0.5, 0.4, 1)))
    ball(shader_material("Ball", "ShaderNodeBsdfDiffuse", Color=(0.3, 0.5, 0.7, 1)), radius=0.4)
    # Soft falloff (the default) blends Cycles' sphere into a disc; off, it is a true sphere light.
    lamp("POINT", 120, (0.9, -0.5, 1.8), shadow_soft_size=0.2, use_soft_falloff=False)
    lamp("POINT", 30, (-0.9, 0.4, 1.0), shadow_soft_size=0.0, use_temperature=True, temperature=3500)


def spot() -> None:
    empty_scene()
    floor(shader_material("Floor", "ShaderNodeBsdfDiffuse", Color=(0.6, 0.5, 0.4, 1)))
    lamp(
        "SPOT",
        200,
        (0.5, -0.3, 2.5),
        (0.15, 0.1, 0),
        spot_size=math.radians(50),
        spot_blend=0.6,
        shadow_soft_size=0.0,
    )


def turned_sky() -> None:
    empty_scene()
    hdri((0, 0, math.radians(70)), strength=1.5)
    floor(shader_material("Floor", "ShaderNodeBsdfDiffuse", Color=(0.6, 0.5, 0.4, 1)))
    ball(shader_material("Mirror", "ShaderNodeBsdfGlossy", Color=(0.8, 0.8, 0.8, 1), Roughness=0.15))


def tilted_sky() -> None:
    empty_scene()
    hdri((math.radians(35), math.radians(-20), math.radians(110)), kind="TEXTURE")
    ball(shader_material("Mirror", "ShaderNodeBsdfGlossy", Color=(0.8, 0.8, 0.8, 1), Roughness=0.15))


def node_sky() -> None:
    """A world of nodes (gradient): rendered once into an environment image."""
    empty_scene()
    made = world()
    tree = made.node_tree
    gradient, coordinates = tree.nodes.new("ShaderNodeTexGradient"), tree.nodes.new("ShaderNodeTexCoord")
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (1.0, 0.1, 0.05, 1)
    ramp.color_ramp.elements[1].color = (0.05, 0.3, 2.0, 1)
    tree.links.new(coordinates.outputs["Generated"], gradient.inputs["Vector"])
    tree.links.new(gradient.outputs["Fac"], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    ball(shader_material("Ball", "ShaderNodeBsdfDiffuse", Color=(0.7, 0.7, 0.7, 1)))


def normal_map() -> None:
    empty_scene()
    hdri()
    material = principled("Bumpy", (0.5, 0.5, 0.5), Roughness=0.4)
    tree = material.node_tree
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    slope = np.stack([0.5 * np.sin(2 * x), 0.35 * np.sin(3 * y), np.ones_like(x)], -1)
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image("normals", (slope * 0.5 + 0.5).astype(np.float32), data=True)
    bend = tree.nodes.new("ShaderNodeNormalMap")
    bend.inputs["Strength"].default_value = 0.7
    tree.links.new(node.outputs["Color"], bend.inputs["Color"])
    tree.links.new(bend.outputs["Normal"], tree.nodes["Principled BSDF"].inputs["Normal"])
    floor(material, 2.4)


def textured_roughness() -> None:
    empty_scene()
    hdri()
    material = principled("Patchy", (0.7, 0.7, 0.7), Metallic=1.0)
    node = image_node(material, image("rough", 0.1 + 0.3 * quadrants(), data=True), "Roughness")
    assert node
    floor(material, 2.4)


def alpha_cutout() -> None:
    empty_scene()
    world()
    material = principled("Cut", (0.2, 0.6, 0.3), Roughness=1.0)
    pixels = np.ones((16, 16, 4), np.float32)
    pixels[:, :8, 3] = 0.25
    image_node(material, image("alpha", pixels), "Alpha", output="Alpha")
    sheet = floor(material, 1.6)
    sheet.location.z = 0.4
    floor(shader_material("Floor", "ShaderNodeBsdfDiffuse", Color=(0.8, 0.4, 0.2, 1)))


def mixed_shaders() -> None:
    """Mix of diffuse and glossy by an image."""
    empty_scene()
    hdri()
    material = shader_material("Mixed", "ShaderNodeBsdfDiffuse", Color=(0.8, 0.2, 0.1, 1))
    tree = material.node_tree
    gloss, mix = tree.nodes.new("ShaderNodeBsdfGlossy"), tree.nodes.new("ShaderNodeMixShader")
    gloss.inputs["Roughness"].default_value = 0.2
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image("factor", quadrants(), data=True)
    diffuse = tree.nodes["Diffuse BSDF"]
    tree.links.new(node.outputs["Color"], mix.inputs[0])
    tree.links.new(diffuse.outputs[0], mix.inputs[1])
    tree.links.new(gloss.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    floor(material, 2.4)


def emissive_ball() -> None:
    """Light from a mesh; the camera looks past it (hide_emitters hides the mesh itself)."""
    empty_scene()
    floor(shader_material("Floor", "ShaderNodeBsdfDiffuse", Color=(0.6, 0.5, 0.4, 1)), 2.4)
    material = principled("Lamp", (0, 0, 0), Emission_Strength=20.0, Specular_IOR_Level=0.0)
    material.node_tree.nodes["Principled BSDF"].inputs["Emission Color"].default_value = (1, 0.7, 0.3, 1)
    ball(material, (0, 0, 3.2), 0.3)


# Energy within, relative RMSE within. Wider where the two lobes differ by nature.
CASES: list[tuple[Callable[[], None], float, float]] = [
    (textured_plane, 0.05, 0.06),
    (mapped_texture, 0.05, 0.06),
    (metal, 0.03, 0.07),
    (rough_metal, 0.05, 0.12),
    (glossy, 0.03, 0.06),
    (lacquer, 0.05, 0.12),
    (clear_glass, 0.03, 0.06),
    (glass_node, 0.05, 0.06),
    (area_light, 0.05, 0.06),
    (disc_light, 0.05, 0.07),
    (sun, 0.03, 0.05),
    (point, 0.03, 0.05),
    (spot, 0.03, 0.05),
    (turned_sky, 0.03, 0.06),
    (tilted_sky, 0.03, 0.06),
    (node_sky, 0.03, 0.04),
    (normal_map, 0.05, 0.08),
    (textured_roughness, 0.04, 0.06),
    (alpha_cutout, 0.05, 0.06),
    (mixed_shaders, 0.03, 0.06),
    (emissive_ball, 0.03, 0.05),
]
QUICK = (textured_plane, metal, lacquer, glass_node, area_light, sun, point, turned_sky, normal_map, alpha_cutout,
         mixed_shaders)  # fmt: skip


def halves(cases: list[tuple[Any, ...]], quick: tuple[Any, ...]) -> list[Any]:
    """The cases, all but the quick ones marked for the slow half."""
    return [case if case[0] in quick else pytest.param(*case, marks=pytest.mark.robustness) for case in cases]


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba_variant")
@pytest.mark.parametrize(("build", "energy", "rmse"), halves(CASES, QUICK), ids=lambda v: getattr(v, "__name__", None))
def test_matches_cycles(build: Callable[[], None], energy: float, rmse: float, tmp_path: Path) -> None:
    build()
    ratio, error, _ = compare(tmp_path)
    assert abs(ratio - 1) < energy
    assert error < rmse


# ---------------------------------------------------------------- what is not converted is said


def _kinds(findings: Findings) -> set[tuple[str, str]]:
    return {(finding.kind, finding.feature) for finding in findings}


def test_procedural_and_unsupported_features_are_reported(tmp_path: Path) -> None:
    empty_scene()
    material = principled("Procedural", Subsurface_Weight=0.3, Sheen_Weight=0.5)
    tree = material.node_tree
    noise, bump = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeBump")
    shader = tree.nodes["Principled BSDF"]
    tree.links.new(noise.outputs["Color"], shader.inputs["Base Color"])
    tree.links.new(noise.outputs["Fac"], bump.inputs["Height"])
    tree.links.new(bump.outputs["Normal"], shader.inputs["Normal"])
    floor(material).visible_shadow = False
    lamp("POINT", 10, (0, 0, 2), use_shadow=False)
    lamp("SPOT", 10, (1, 0, 2)).scale = (1.0, 2.0, 1.0)
    findings = export(tmp_path)
    expected = {
        ("approximated", "Noise Texture node"),
        ("approximated", "subsurface scattering"),
        ("approximated", "sheen"),
        ("ignored", "Bump node"),
        ("ignored", "lamp without shadow"),
        ("ignored", "ray visibility"),
        ("approximated", "stretched spot"),
    }
    assert expected <= _kinds(findings)
    assert {f.material for f in findings if f.feature == "Bump node"} == {"Procedural"}
    json.dumps([finding.data() for finding in findings])


def test_missing_image_is_magenta_and_reported(tmp_path: Path) -> None:
    empty_scene()
    (tmp_path / "gone.png").write_bytes(b"not an image")
    broken = bpy.data.images.load(str(tmp_path / "gone.png"))
    (tmp_path / "gone.png").unlink()
    material = principled("Lost", Roughness=1.0, Specular_IOR_Level=0.0)
    image_node(material, broken, "Base Color")
    floor(material)
    findings = export(tmp_path / "bundle")
    assert ("missing", "image 'gone.png'") in _kinds(findings)
    assert not list((tmp_path / "bundle").glob("textures/*.png"))
    file = next((tmp_path / "bundle" / "textures").iterdir())
    import OpenEXR

    with OpenEXR.File(str(file)) as opened:
        texel = np.asarray(opened.channels()["RGB"].pixels, np.float32)[0, 0]
    assert texel[1] == 0 and texel[0] > 0.8 and texel[2] > 0.8


def test_second_uv_layer_is_looked_up_and_a_mesh_without_is_reported(tmp_path: Path) -> None:
    empty_scene()
    material = principled("Two")
    tree = material.node_tree
    for socket, layer in (("Base Color", "UVMap"), ("Roughness", "Second")):
        node = image_node(material, image(layer, quadrants(8), data=socket == "Roughness"), socket)
        chosen = tree.nodes.new("ShaderNodeUVMap")
        chosen.uv_map = layer
        tree.links.new(chosen.outputs[0], node.inputs["Vector"])
    body = floor(material)
    body.data.uv_layers.new(name="Second")
    bare = ball(material)
    while bare.data.uv_layers:
        bare.data.uv_layers.remove(bare.data.uv_layers[0])
    findings = export(tmp_path)
    assert {kind for kind, _ in _kinds(findings)} == {"missing"}
    assert {("missing", "UV layer 'UVMap'"), ("missing", "UV layer 'Second'")} <= _kinds(findings)
    lookups = ET.parse(tmp_path / "scene.xml").getroot().findall(".//texture[@type='dnr_uv_layer']")
    assert [(e.get("name"), e.find("string").get("value")) for e in lookups] == [("roughness", "vertex_uv1")]
    assert b"property float uv1_x" in (tmp_path / "meshes" / "Plane.ply").read_bytes()[:1000]


def test_bundle_is_relative_deduplicated_and_stable(tmp_path: Path) -> None:
    empty_scene()
    picture = image("shared", quadrants(16))
    for index, name in enumerate(("One/µ", "One µ")):
        material = principled(name)
        image_node(material, picture, "Base Color")
        floor(material).location.x = 5.0 * index
    export(tmp_path / "a")
    export(tmp_path / "b")
    text = (tmp_path / "a" / "scene.xml").read_text()
    assert text == (tmp_path / "b" / "scene.xml").read_text()
    assert str(tmp_path) not in text
    root = ET.fromstring(text)
    assert root.get("version", "").startswith("3.")
    ids = [element.get("id") for element in root.iter() if element.tag != "ref" and element.get("id")]
    assert len(ids) == len(set(ids))
    references = {element.get("id") for element in root.iter("ref")}
    assert references <= set(ids) and len(references) == 2
    files = [e.get("value", "") for e in root.iter("string") if e.get("name") == "filename"]
    assert all((tmp_path / "a" / name).is_file() for name in files)
    assert len(list((tmp_path / "a" / "textures").iterdir())) == 1
    assert {e.get("type") for e in root.iter("integrator")} == {"path"}


def test_dark_world_and_no_world_have_no_emitter(tmp_path: Path) -> None:
    empty_scene()
    floor(principled("Floor"))
    export(tmp_path / "none")
    world((0, 0, 0))
    export(tmp_path / "black")
    for name in ("none", "black"):
        assert "<emitter" not in (tmp_path / name / "scene.xml").read_text()


def test_excluded_and_hidden_lamps_are_left_out(tmp_path: Path) -> None:
    scene = empty_scene()
    floor(principled("Floor"))
    lamp("POINT", 10, (0, 0, 2)).name = "Kept"
    lamp("POINT", 10, (0, 0, 2)).hide_render = True
    outside = lamp("POINT", 10, (0, 0, 2))
    folder = bpy.data.collections.new("Excluded")
    scene.collection.children.link(folder)
    scene.collection.objects.unlink(outside)
    folder.objects.link(outside)
    bpy.context.view_layer.layer_collection.children["Excluded"].exclude = True
    export(tmp_path)
    root = ET.parse(tmp_path / "scene.xml").getroot()
    lamps = [e.get("id") for e in root if (e.get("id") or "").startswith("light-")]
    assert lamps == ["light-Kept"]


def test_closure_tells_open_from_closed_and_outward_from_inward() -> None:
    empty_scene()
    cube = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)  # a tetrahedron, faces outward
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    balance, volume = closure(cube[faces.ravel()])
    assert balance < 1e-6 and volume == pytest.approx(1 / 6)
    assert closure(cube[faces[:, ::-1].ravel()])[1] == pytest.approx(-1 / 6)
    assert closure(cube[faces[:3].ravel()])[0] > 0.1


# ---------------------------------------------------------------- display transform


def _lookup(lut: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Trilinear lookup as a consumer does it. colours: [N, 3] linear."""
    t = np.log2(1 + LUT_K * colours) / np.log2(1 + LUT_K * LUT_MAX) * (LUT_SIZE - 1)
    low = np.clip(np.floor(t).astype(int), 0, LUT_SIZE - 2)
    f = t - low
    out = np.zeros_like(colours)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner), f, 1 - f), axis=1)
        i = low + np.array(corner)
        out += weight[:, None] * lut[i[:, 0], i[:, 1], i[:, 2]]
    return out


def test_standard_needs_no_lut(tmp_path: Path) -> None:
    scene = empty_scene()
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.exposure = 0.5
    assert export_display(scene, tmp_path) == {
        "exposure": 0.5,
        "gamma": 1.0,
        "view_transform": "Standard",
        "display_lut": None,
    }
    assert not list(tmp_path.iterdir())


def test_baked_standard_is_the_srgb_curve() -> None:
    scene = empty_scene()
    scene.view_settings.view_transform = "Standard"
    colours = np.random.default_rng(0).random((2000, 3)) ** 2 * 1.5
    expected = linear_to_srgb(np.clip(colours, 0, 1))
    assert np.abs(_lookup(bake_lut(scene), colours) - expected).max() < 3e-3


def test_agx_with_exposure_and_look_is_baked(tmp_path: Path) -> None:
    scene = empty_scene()
    view = scene.view_settings
    view.view_transform, view.exposure, view.gamma = "AgX", 0.7, 1.1
    view.look = "AgX - Medium High Contrast"
    before = scene.render.image_settings.file_format, scene.render.dither_intensity
    fields = export_display(scene, tmp_path)
    assert (scene.render.image_settings.file_format, scene.render.dither_intensity) == before
    assert fields == {"exposure": 0.0, "gamma": 1.0, "view_transform": "AgX", "display_lut": "display.npz"}
    with np.load(tmp_path / "display.npz") as data:
        lut = data["lut"]
        assert (float(data["max"]), float(data["k"])) == (LUT_MAX, LUT_K)
    assert lut.shape == (LUT_SIZE,) * 3 + (3,) and lut.dtype == np.float32
    colours = np.concatenate([[[0.18, 0.18, 0.18]], np.random.default_rng(1).random((200, 3)) ** 3 * 8])
    direct = display_values(scene, colours[None].astype(np.float32))[0]
    error = np.abs(_lookup(lut, colours) - direct)
    assert error.mean() < 1e-3 and np.quantile(error, 0.99) < 0.01 and error.max() < 0.03
    assert np.abs(_lookup(lut, colours[:1]) - direct[:1]).max() < 2e-3
    assert lut.min() >= 0 and lut.max() <= 1
    assert abs(direct[0, 0] - linear_to_srgb(np.array(0.18 * 2**0.7))) > 0.01  # it is not the sRGB curve
