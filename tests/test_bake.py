"""Baking: what Cycles bakes into the atlas is what the nodes compute, once per content, for every coordinate space."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mathutils import Euler, Matrix  # noqa: E402

from dnrpipe.blender.baking import bake as baking  # noqa: E402
from dnrpipe.blender.baking.cache import BakeCache  # noqa: E402
from dnrpipe.blender.baking.mesh import object_positions, object_random  # noqa: E402
from dnrpipe.blender.baking.regions import Atlas  # noqa: E402
from dnrpipe.blender.findings import Findings  # noqa: E402
from dnrpipe.blender.geometry.atlas import build_atlas  # noqa: E402
from dnrpipe.blender.geometry.freeze import freeze_scene  # noqa: E402
from dnrpipe.blender.geometry.frozen import ATLAS_LAYER, FrozenMesh, save_geometry  # noqa: E402
from dnrpipe.blender.shading.colour_spaces import decode  # noqa: E402
from dnrpipe.blender.shading.filtering import finer  # noqa: E402
from dnrpipe.blender.shading.sheets import on_region  # noqa: E402
from dnrpipe.blender.shading.sockets import resolve  # noqa: E402
from dnrpipe.blender.shading.textures import Constant, ImageReader, Placement, Textured  # noqa: E402
from dnrpipe.blender.shading.values import Evaluator  # noqa: E402
from dnrpipe.blender.tasks import BakeTask, PendingBakes  # noqa: E402
from dnrpipe.core.console import Console  # noqa: E402
from dnrpipe.core.settings import Settings  # noqa: E402
from dnrpipe.core.workspace import Source, Workspace  # noqa: E402
from dnrpipe.stages.prepare import BAKES, bake  # noqa: E402
from dnrpipe.stages.stage import Run  # noqa: E402

SIZE = 128
FULL = baking.SAMPLES
PLACE = Matrix.Translation((1, 2, 0.5)) @ Euler((0.3, 0.5, 0.2)).to_matrix().to_4x4() @ Matrix.Diagonal((1, -2, 0.5, 1))
"""Rotated, mirrored and stretched: object, generated and world coordinates all differ."""


def scene_of(*materials: Any) -> list[FrozenMesh]:
    """One cube per material, the first at PLACE; frozen, with an atlas."""
    for number, material in enumerate(materials):
        bpy.ops.mesh.primitive_cube_add(size=1.0)
        cube = bpy.context.object
        cube.name = f"cube{number}"
        cube.matrix_world = PLACE if number == 0 else Matrix.Translation((4 * number, 0, 0))
        cube.data.materials.append(material)
    meshes = freeze_scene(bpy.context.scene).meshes
    build_atlas(meshes)
    return meshes


def material_of(name: str, build: Callable[[Any], Any], socket: str = "Base Color") -> Any:
    """A Principled material; ``build(tree)`` returns the output linked to ``socket``."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True
    tree: Any = material.node_tree
    tree.links.new(build(tree), tree.nodes["Principled BSDF"].inputs[socket])
    return material


def add_node(tree: Any, kind: str, **inputs: Any) -> Any:
    node = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in inputs.items():
        node.inputs[name].default_value = value
    return node


def source_of(material: Any, socket: str = "Base Color") -> Any:
    return resolve(material.node_tree.nodes["Principled BSDF"].inputs[socket])


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty file; bakes of one point per texel, its centre, where the value is known exactly."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    monkeypatch.setattr(baking, "SAMPLES", 1)


class Bench:
    """A book over a folder, and baking of what it misses, in this process."""

    def __init__(self, meshes: list[FrozenMesh], folder: Path) -> None:
        self.meshes, self.folder = meshes, folder
        folder.mkdir(exist_ok=True)
        self.book = BakeCache(Atlas(meshes, SIZE), folder)

    def evaluator(self, material: Any) -> tuple[Evaluator, Findings]:
        findings = Findings()
        return Evaluator(material.name_full, ImageReader(findings), findings, self.book), findings

    def bake(self) -> None:
        source, geometry = self.folder / "scene.blend", self.folder / "geometry.npz"
        bpy.ops.wm.save_as_mainfile(filepath=str(source))
        save_geometry(geometry, self.meshes)
        common = {
            "source": str(source),
            "geometry": str(geometry),
            "folder": str(self.folder),
            "frame": 1,
            "size": SIZE,
            "threads": 1,
        }
        worker = baking.Worker(common)
        for layer in self.book.layers():
            worker(BakeTask(layer=tuple(layer), output=self.folder).data())
        self.book = BakeCache(Atlas(self.meshes, SIZE), self.folder)

    def baked(self, name: str, socket: str, kind: str) -> np.ndarray:
        """The baked value [N, C] of a Principled socket; bakes first where it is missing."""
        for _ in range(2):
            material = bpy.data.materials[name]
            value = self.book.value(name, kind, source_of(material, socket), socket, Findings())  # type: ignore[arg-type]
            assert value is not None
            if not self.book.missing:
                assert value.placement == Placement(uv=ATLAS_LAYER, wrap="clamp", region=name)
                return value.texels[:, 0]
            self.bake()
        raise AssertionError("baked twice and still missing")

    def expected(self, name: str, corners: Callable[[FrozenMesh], np.ndarray]) -> np.ndarray:
        """A per-corner quantity at the texels of a material's region, [N, C]."""
        values = {id(mesh): corners(mesh) for mesh in self.meshes}
        width = next(iter(values.values())).shape[1]
        return self.book.atlas.region(name).interpolate(self.book.atlas.stacked(name, values, width))


def generated(mesh: FrozenMesh) -> np.ndarray:
    location, size = (np.array(part) for part in mesh.texture_space)
    return (object_positions(mesh) - location) / (2 * size) + 0.5


def test_coordinates_baked_in_every_space(tmp_path: Path) -> None:
    def coordinates(output: str) -> Callable[[Any], Any]:
        return lambda tree: add_node(tree, "TexCoord").outputs[output]

    def position(tree: Any) -> Any:
        return add_node(tree, "NewGeometry").outputs["Position"]

    def object_info(tree: Any) -> Any:
        return add_node(tree, "ObjectInfo").outputs["Random"]

    made = {
        "object": (coordinates("Object"), lambda mesh: object_positions(mesh)),
        "generated": (coordinates("Generated"), generated),
        "world": (position, lambda mesh: mesh.positions),
        "random": (object_info, lambda mesh: np.full((len(mesh.positions), 3), object_random(mesh.object_name))),
    }
    bench = Bench(scene_of(*(material_of(name, build) for name, (build, _) in made.items())), tmp_path / "bakes")
    # In the order of the cubes only "object" is rotated; turn the others in turn by sharing its mesh.
    for name in made:
        bench.book.value(name, "colour", source_of(bpy.data.materials[name]), "Base Color", Findings())
    assert len(bench.book.layers()) == 1, "values of different materials share one bake"
    bench.bake()
    for name, (_, corners) in made.items():
        assert not bench.book.missing
        values = bench.baked(name, "Base Color", "colour")
        np.testing.assert_allclose(values, bench.expected(name, corners), atol=4e-3)  # half floats up to 12


@pytest.mark.parametrize("averaged", [True, False])
def test_what_is_finer_than_a_texel_is_averaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, averaged: bool
) -> None:
    """A checker of a thousand squares a side is grey; from one point per texel it would be black and white."""
    monkeypatch.setattr(baking, "SAMPLES", FULL if averaged else 1)
    checker = {"Scale": 1000.0, "Color1": (0, 0, 0, 1), "Color2": (1, 1, 1, 1)}
    bench = Bench(
        scene_of(material_of("fine", lambda tree: add_node(tree, "TexChecker", **checker).outputs["Color"])),
        tmp_path / "bakes",
    )
    values = bench.baked("fine", "Base Color", "colour")
    grey = float(((values > 0.1) & (values < 0.9)).mean())
    assert grey > 0.8 if averaged else grey < 0.05


def test_groups_scalars_and_normals(tmp_path: Path) -> None:
    """Values inside nested groups come out; three scalars share a bake; the flat normal of a bump is the surface's."""
    inner = bpy.data.node_groups.new("inner", "ShaderNodeTree")
    inner.interface.new_socket(name="Value", in_out="OUTPUT", socket_type="NodeSocketFloat")
    x = inner.nodes.new("ShaderNodeSeparateXYZ")
    inner.links.new(inner.nodes.new("ShaderNodeTexCoord").outputs["Generated"], x.inputs[0])
    inner.links.new(x.outputs["X"], inner.nodes.new("NodeGroupOutput").inputs[0])

    def grouped(tree: Any) -> Any:
        group = tree.nodes.new("ShaderNodeGroup")
        group.node_tree = inner
        return group.outputs[0]

    material = material_of("m", grouped, "Roughness")
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    tree.links.new(grouped(tree), shader.inputs["Metallic"])
    checker = add_node(tree, "TexChecker", Scale=0.001)
    tree.links.new(checker.outputs["Fac"], shader.inputs["Alpha"])
    bump = add_node(tree, "Bump")
    tree.links.new(add_node(tree, "TexWave", Scale=0.0).outputs["Fac"], bump.inputs["Height"])
    tree.links.new(bump.outputs["Normal"], shader.inputs["Normal"])
    bench = Bench(scene_of(material), tmp_path / "bakes")
    for socket in ("Roughness", "Metallic", "Alpha"):
        bench.book.value("m", "scalar", source_of(material, socket), socket, Findings())
    bench.book.value("m", "normal", source_of(material, "Normal"), "Normal", Findings())
    assert [len(entry.taps) for layer in bench.book.layers() for entry in layer] in ([3, 1], [2, 1])
    bench.bake()
    x_values = bench.expected("m", lambda mesh: generated(mesh)[:, :1])
    np.testing.assert_allclose(bench.baked("m", "Roughness", "scalar"), x_values, atol=2e-3)
    assert np.ptp(bench.baked("m", "Alpha", "scalar")) == 0
    normals = bench.baked("m", "Normal", "normal") * 2 - 1
    np.testing.assert_allclose(normals, bench.expected("m", lambda mesh: mesh.normals), atol=5e-3)


def test_cached_by_content(tmp_path: Path) -> None:
    """The same content is baked once; an edit bakes again what it touches, and nothing else."""

    def noise(tree: Any) -> Any:
        return add_node(tree, "TexNoise", Scale=2.0).outputs["Fac"]

    edited, kept = material_of("edited", noise), material_of("kept", noise)
    bench = Bench(scene_of(edited, kept), tmp_path / "bakes")
    first = bench.baked("edited", "Base Color", "colour")
    bench.baked("kept", "Base Color", "colour")
    assert np.ptp(first) > 0.1
    edited, kept = bpy.data.materials["edited"], bpy.data.materials["kept"]
    edited.node_tree.nodes["Noise Texture"].inputs["Scale"].default_value = 3.0
    edited.node_tree.nodes["Noise Texture"].location.x += 50
    kept.node_tree.nodes["Noise Texture"].location.x += 50
    again = BakeCache(Atlas(bench.meshes, SIZE), bench.folder)
    again.value("kept", "colour", source_of(kept), "Base Color", Findings())
    assert not again.missing
    again.value("edited", "colour", source_of(edited), "Base Color", Findings())
    assert [material for material, _ in again.missing.values()] == ["edited"]
    refused = BakeCache(Atlas(bench.meshes, SIZE), bench.folder, frozenset(again.missing))
    findings = Findings()
    value = Evaluator("edited", ImageReader(findings), findings, refused).colour(
        source_of(edited).socket.links[0].to_socket
    )
    assert isinstance(value, Constant)
    assert [finding.kind for finding in findings] == ["approximated"]


def test_what_is_exact_is_not_baked(tmp_path: Path) -> None:
    """Images, a plain colour attribute and constants stay as they are; arithmetic on the attribute is baked."""
    picture = bpy.data.images.new("picture", 8, 8)

    def image(tree: Any) -> Any:
        node = add_node(tree, "TexImage")
        node.image = picture
        return node.outputs["Color"]

    def attribute(tree: Any) -> Any:
        node = add_node(tree, "VertexColor")
        node.layer_name = "Col"
        return node.outputs["Color"]

    def inverted(tree: Any) -> Any:
        node = add_node(tree, "Invert")
        tree.links.new(attribute(tree), node.inputs["Color"])
        return node.outputs[0]

    materials = [material_of("image", image), material_of("plain", attribute), material_of("inverted", inverted)]
    meshes = scene_of(*materials)
    rng = np.random.default_rng(0)
    for mesh in meshes:
        mesh.colors["Col"] = rng.random((len(mesh.positions), 4), np.float32)
    bench = Bench(meshes, tmp_path / "bakes")

    def colour(material: Any) -> Any:
        evaluator, _ = bench.evaluator(material)
        return evaluator.colour(material.node_tree.nodes["Principled BSDF"].inputs["Base Color"])

    assert colour(materials[0]).placement == Placement()
    plain = colour(materials[1])
    mesh = next(mesh for mesh in meshes if mesh.materials == ["plain"])
    np.testing.assert_array_equal(plain.texels[:, 0], mesh.colors["Col"][:, :3])
    assert not bench.book.missing
    colour(materials[2])
    assert [material for material, _ in bench.book.missing.values()] == ["inverted"]
    bench.bake()
    other = next(mesh for mesh in meshes if mesh.materials == ["inverted"])
    expected = 1 - bench.expected("inverted", lambda m: m.colors["Col"] if m is other else m.colors["Col"] * 0)
    near = np.isclose(bench.baked("inverted", "Base Color", "colour"), expected[:, :3], atol=2e-3)
    assert near.mean() > 0.97  # a texel's centre on the edge of two triangles belongs to either


def test_images_and_corners_on_the_region(tmp_path: Path) -> None:
    """An image taken to the atlas equals its bilinear lookup by the artist's UVs."""
    meshes = scene_of(material_of("m", lambda tree: add_node(tree, "RGB").outputs[0]))
    bench = Bench(meshes, tmp_path / "bakes")
    texels = np.linspace(0, 1, 16, dtype=np.float32)[None, :, None].repeat(4, axis=0)
    turned = ((-1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    value = Textured(texels, False, Placement(to_uv=turned, wrap="clamp"))
    result = on_region(bench.book.atlas, "m", value).texels[:, 0, 0]
    u = bench.expected("m", lambda mesh: mesh.uv_layers["UVMap"])[:, 0]
    np.testing.assert_allclose(result, np.clip((1 - u) * 16 - 0.5, 0, 15) / 15, atol=1e-5)


def test_attributes_of_geometry_nodes_are_kept_where_materials_name_them() -> None:
    def named(tree: Any) -> Any:
        node = add_node(tree, "Attribute")
        node.attribute_name = "height"
        return node.outputs["Fac"]

    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    cube.data.materials.append(material_of("m", named))
    for name in ("height", "other"):
        attribute = cube.data.attributes.new(name, "FLOAT", "POINT")
        attribute.data.foreach_set("value", [vertex.co.z for vertex in cube.data.vertices])
    (mesh,) = freeze_scene(bpy.context.scene).meshes
    assert list(mesh.colors) == ["height"]
    np.testing.assert_allclose(mesh.colors["height"][:, :3], np.repeat(mesh.positions[:, 2:], 3, axis=1))


def test_unfolded_layers_are_told_from_overlapping_ones(tmp_path: Path) -> None:
    (mesh,) = meshes = scene_of(material_of("m", lambda tree: add_node(tree, "RGB").outputs[0]))
    atlas = Bench(meshes, tmp_path / "bakes").book.atlas
    assert atlas.is_unfolded("m", None)
    mesh.uv_layers["folded"] = np.tile(np.array([(0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1)], np.float32), (6, 1))
    mesh.uv_layers["repeated"] = mesh.uv_layers["UVMap"] * 2
    assert not atlas.is_unfolded("m", "folded")
    assert not atlas.is_unfolded("m", "repeated")


def test_images_are_interpolated_before_they_are_decoded() -> None:
    """Half way between black and white sRGB texels Cycles shows code 0.5, not half the light."""
    texels = np.array([[[0], [255]]], np.uint8)
    finer_texels, coded = finer(texels, True, "clamp", "linear")
    assert coded and finer_texels.shape == (8, 16, 1)
    np.testing.assert_allclose(finer_texels[0, 7:9, 0] / 255, [7 / 16, 9 / 16], atol=1 / 255)
    flat = np.full((4, 4, 3), 77, np.uint8)
    blurred, coded = finer(flat, False, "mirror", "cubic")
    assert not coded
    np.testing.assert_allclose(blurred, 77 / 255, rtol=1e-5)


def test_other_colour_spaces_are_decoded_by_blender() -> None:
    codes = np.full((2, 3, 4), 128, np.uint8)
    codes[0, :, 0] = 255
    decoded = decode(codes, "sRGB")
    np.testing.assert_allclose(decoded[1, :, :3], 0.2158, atol=1e-3)
    np.testing.assert_allclose(decoded[0, :, 0], 1.0, atol=1e-3)
    np.testing.assert_allclose(decoded[..., 3], 128 / 255, atol=1e-6)
    assert abs(float(decode(codes, "Filmic sRGB")[1, 0, 1]) - 0.2158) > 0.02


def test_bake_processes_fill_the_cache_and_name_what_failed(tmp_path: Path) -> None:
    meshes = scene_of(material_of("m", lambda tree: add_node(tree, "TexNoise").outputs["Fac"]))
    source, geometry = tmp_path / "scene.blend", tmp_path / "geometry.npz"
    workspace = Workspace.create(tmp_path / "w.dnr", Source(path=str(source), sha256="0"))
    book = BakeCache(Atlas(meshes, SIZE), workspace.root / BAKES)
    book.value("m", "colour", source_of(bpy.data.materials["m"]), "Base Color", Findings())
    bpy.ops.wm.save_as_mainfile(filepath=str(source))
    save_geometry(geometry, meshes)
    (layer,) = book.layers()
    tap = layer[0].taps[0].model_copy(update={"key": "k"})
    gone = layer[0].model_copy(update={"material": "gone", "taps": (tap,)})
    pending = PendingBakes(layers=(tuple(layer), (gone,)), frame=1)
    run = Run(workspace, Settings.model_validate({"passes": {"bake_size": SIZE, "workers": 1}}), Console(quiet=True))
    assert bake(run, source, geometry, pending) == ["k"]
    assert [path.stem for path in (workspace.root / BAKES).glob("*.npy")] == list(book.missing)
