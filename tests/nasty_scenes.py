"""Files that users really have and that break converters: one small builder each.

A builder leaves its file in ``folder`` and returns the path. All run in one bpy process, each from an empty file.
"""

from __future__ import annotations

import gzip
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

Builder = Callable[[Path], Path]
NAN = float("nan")


def empty() -> Any:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def link(name: str, data: Any) -> Any:
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def cube(name: str = "cube", material: Any = None) -> Any:
    """A unit tetrahedron, despite its name: four faces pack faster than six."""
    data = bpy.data.meshes.new(name)
    data.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    data.uv_layers.new(name="UVMap")
    if material is not None:
        data.materials.append(material)
    return link(name, data)


def material(name: str, *, image: Any = None, colour: tuple[float, float, float] | None = None) -> Any:
    made = bpy.data.materials.new(name)
    tree = made.node_tree
    principled = tree.nodes["Principled BSDF"]
    if colour is not None:
        principled.inputs["Base Color"].default_value = (*colour, 1)
    if image is not None:
        texture = tree.nodes.new("ShaderNodeTexImage")
        texture.image = image
        tree.links.new(texture.outputs["Color"], principled.inputs["Base Color"])
    return made


def png(path: Path) -> Any:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = bpy.data.images.new(path.stem, 4, 4)
    image.generated_color = (0.2, 0.6, 0.9, 1)
    image.file_format = "PNG"
    image.filepath_raw = str(path)
    image.save()
    bpy.data.images.remove(image)
    return bpy.data.images.load(str(path))


def save(path: Path, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path), relative_remap=False, **options)
    return path


def bare(folder: Path) -> Path:
    empty()
    cube()
    return save(folder / "bare.blend")


def lamp_as_camera(folder: Path) -> Path:
    scene = empty()
    cube()
    scene.camera = link("lamp", bpy.data.lights.new("lamp", "POINT"))
    return save(folder / "lamp_as_camera.blend")


def flat_camera(folder: Path) -> Path:
    """Active camera of scale 0; another one that works."""
    scene = empty()
    cube()
    scene.camera = link("flat", bpy.data.cameras.new("flat"))
    scene.camera.scale = (0, 0, 0)
    link("good", bpy.data.cameras.new("good")).location = (0, 0, 9)
    return save(folder / "flat_camera.blend")


def nan_camera(folder: Path) -> Path:
    scene = empty()
    cube()
    scene.camera = link("lost", bpy.data.cameras.new("lost"))
    scene.camera.location = (NAN, 0, 0)
    return save(folder / "nan_camera.blend")


def missing_everything(folder: Path) -> Path:
    """Image, font, volume and library are gone."""
    empty()
    cube("linked", material("shared"))
    library = save(folder / "gone" / "library.blend")
    empty()
    image = png(folder / "gone" / "gone.png")
    cube("textured", material("textured", image=image))
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.objects = ["linked"]
    bpy.context.scene.collection.objects.link(bpy.data.objects["linked"])
    smoke = bpy.data.volumes.new("smoke")
    smoke.filepath = str(folder / "gone" / "smoke.vdb")
    link("smoke", smoke)
    path = save(folder / "missing_everything.blend")
    shutil.rmtree(folder / "gone")
    return path


def missing_group(folder: Path) -> Path:
    """The material's node group lies in a library that is gone."""
    empty()
    tree = bpy.data.node_groups.new("group", "ShaderNodeTree")
    tree.interface.new_socket("Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
    tree.use_fake_user = True
    library = save(folder / "gone_group.blend")
    empty()
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.node_groups = ["group"]
    made = material("grouped")
    node = made.node_tree.nodes.new("ShaderNodeGroup")
    node.node_tree = bpy.data.node_groups["group"]
    made.node_tree.links.new(node.outputs[0], made.node_tree.nodes["Material Output"].inputs["Surface"])
    cube("grouped", made)
    path = save(folder / "missing_group.blend")
    library.unlink()
    return path


def half_udim(folder: Path) -> Path:
    """Two UDIM tiles, the second of which is gone."""
    empty()
    png(folder / "tiles" / "tile.1001.png")
    bpy.ops.image.open(filepath=str(folder / "tiles" / "tile.1001.png"), use_udim_detecting=False)
    image = bpy.data.images["tile.1001.png"]
    image.source = "TILED"
    image.filepath_raw = str(folder / "tiles" / "tile.<UDIM>.png")
    image.tiles.new(tile_number=1002)
    cube("tiled", material("tiled", image=image))
    return save(folder / "half_udim.blend")


def odd_paths(folder: Path) -> Path:
    """A Windows path, a path of the author's machine in another alphabet, a backslash path that is there."""
    empty()
    present = png(folder / "textures" / "here.png")
    present.filepath_raw = "//textures\\here.png"
    for name, path in (("windows", "C:\\work\\wood.png"), ("unicode", "//ü漢/ß.png")):
        image = png(folder / "textures" / f"{name}.png")
        image.filepath_raw = path
        cube(name, material(name, image=image))
    cube("here", material("here", image=present))
    return save(folder / "odd_paths.blend")


def latin_names(folder: Path) -> Path:
    """Names and a path in Latin-1, as Blender 2.4x wrote them."""
    empty()
    image = png(folder / "image.png")
    image.filepath_raw = "//PATHXYZ.png"
    made = cube("NAMEXYZ", material("MATXYZ", image=image))
    made.data.uv_layers[0].name = "UVXYZ"
    path = save(folder / "latin_names.blend", compress=False)
    raw = path.read_bytes()
    for old, new in ((b"OBNAMEXYZ", b"OBN\xe4MEXYZ"), (b"MAMATXYZ", b"MAM\xe4TXYZ"), (b"//PATHXYZ", b"//P\xe4THXYZ")):
        assert old in raw
        raw = raw.replace(old, new)
    path.write_bytes(raw.replace(b"UVXYZ", b"UV\xfcYZ"))
    return path


def two_scenes(folder: Path) -> Path:
    scene = empty()
    scene.name = "first"
    cube("in first")
    bpy.context.window.scene = bpy.data.scenes.new("second")
    cube("in second")
    return save(folder / "two_scenes.blend")


def active_scene_empty(folder: Path) -> Path:
    scene = empty()
    scene.name = "full"
    cube("in full")
    bpy.context.window.scene = bpy.data.scenes.new("void")
    return save(folder / "active_scene_empty.blend")


def appears_later(folder: Path) -> Path:
    scene = empty()
    scene.frame_end = 40
    obj = cube()
    for frame, hidden in ((1, True), (20, False)):
        obj.hide_render = hidden
        obj.keyframe_insert("hide_render", frame=frame)
    scene.frame_set(1)
    return save(folder / "appears_later.blend")


def nothing(folder: Path) -> Path:
    empty()
    return save(folder / "nothing.blend")


def lights_only(folder: Path) -> Path:
    empty()
    link("lamp", bpy.data.lights.new("lamp", "POINT"))
    return save(folder / "lights_only.blend")


def excluded(folder: Path) -> Path:
    """Everything lies in a collection that the view layer excludes."""
    scene = empty()
    obj = cube()
    group = bpy.data.collections.new("group")
    scene.collection.children.link(group)
    group.objects.link(obj)
    scene.collection.objects.unlink(obj)
    scene.view_layers[0].layer_collection.children[0].exclude = True
    return save(folder / "excluded.blend")


def hidden(folder: Path) -> Path:
    empty()
    cube().hide_render = True
    return save(folder / "hidden.blend")


def scripted(folder: Path) -> Path:
    """A Python driver, a driver that Blender evaluates itself, a script that wants to run on opening."""
    empty()
    obj = cube()
    marker = folder / "executed"
    curve = obj.driver_add("location", 0)
    curve.driver.expression = f"__import__('pathlib').Path({str(marker)!r}).touch() or 5"
    obj.driver_add("location", 1).driver.expression = "frame * 2 + 1"
    text = bpy.data.texts.new("on_load.py")
    text.write(f"open({str(marker)!r}, 'w').close()\n")
    text.use_module = True
    path = save(folder / "scripted.blend")
    marker.unlink(missing_ok=True)  # saving evaluates drivers of this, trusted, process
    return path


def broken_transforms(folder: Path) -> Path:
    """A flat scale, a NaN location and NaN corners beside one good object."""
    empty()
    cube("good")
    cube("flat").scale = (1, 1, 0)
    cube("zero").scale = (0, 0, 0)
    cube("lost").location = (NAN, 0, 0)
    cube("holed").data.vertices[3].co = (0, math.inf, NAN)
    return save(folder / "broken_transforms.blend")


def far_away(folder: Path) -> Path:
    """So far from the origin that its corners coincide in float32."""
    empty()
    cube().location = (1e8, 1e8, 0)
    return save(folder / "far_away.blend")


def remote(folder: Path) -> Path:
    """Far from the origin, but large enough to survive."""
    empty()
    obj = cube()
    obj.location, obj.scale = (2e7, 0, 0), (1000, 1000, 1000)
    return save(folder / "remote.blend")


def tiny(folder: Path) -> Path:
    """Modelled in millimetres with a unit scale of 0.001, and 1e-4 wide."""
    scene = empty()
    scene.unit_settings.scale_length = 0.001
    cube().scale = (1e-4, 1e-4, 1e-4)
    return save(folder / "tiny.blend")


def awkward_names(folder: Path) -> Path:
    """Names that differ in case only, are very long, hold slashes, dots, emoji, or nothing that a file can."""
    empty()
    for name in ("Part", "part", "PART", "a/b\\c", "..", "漢字", "🙂", "CON", "x" * 250, "x" * 249 + "y", '"<&>'):
        obj = cube(name, material(name, colour=(0.5, 0.2, 0.1)))
        obj.data.materials.append(material("second " + name[:200]))
        obj.data.polygons[0].material_index = 1
    return save(folder / "awkward_names.blend")


def odd_slots(folder: Path) -> Path:
    """The same material twice, an empty slot, an index beyond the slots, a mesh without faces or vertices."""
    empty()
    made = material("twice", colour=(1, 0, 0))
    obj = cube("slots", made)
    obj.data.materials.append(made)
    obj.data.materials.append(None)
    for index, polygon in enumerate(obj.data.polygons):
        polygon.material_index = index
    edges = bpy.data.meshes.new("edges")
    edges.from_pydata([(0, 0, 0), (1, 0, 0)], [(0, 1)], [])
    link("edges", edges)
    link("void", bpy.data.meshes.new("void"))
    return save(folder / "odd_slots.blend")


def same_names(folder: Path) -> Path:
    """Local and linked objects, meshes and materials of the same names."""
    for colour, name in (((0, 1, 0), "green"), ((0, 0, 1), "blue")):
        empty()
        cube("thing", material("paint", colour=colour))
        save(folder / f"library_{name}.blend")
    empty()
    cube("thing", material("paint", colour=(1, 0, 0)))
    for step, name in enumerate(("green", "blue"), start=1):
        with bpy.data.libraries.load(str(folder / f"library_{name}.blend"), link=True) as (_, wanted):
            wanted.collections = ["Collection"] if "Collection" in _.collections else []
            wanted.objects = ["thing"]
        holder = bpy.data.collections.new(name)
        holder.objects.link(wanted.objects[0])
        empty_ = link(f"place {name}", None)
        empty_.instance_type, empty_.instance_collection = "COLLECTION", holder
        empty_.location.x = 2 * step
    return save(folder / "same_names.blend")


def overridden(folder: Path) -> Path:
    """A library override whose location differs from its library's."""
    empty()
    cube("thing", material("paint"))
    library = save(folder / "override_library.blend")
    empty()
    with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
        wanted.objects = ["thing"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    local = wanted.objects[0].override_create(remap_local_usages=True)
    local.location = (0, 0, 7)
    return save(folder / "overridden.blend")


def chained(folder: Path, *, relative: bool = True) -> Path:
    """A library that links a library, by relative paths as Blender's own dialog does, or by absolute ones."""
    empty()
    cube("deep", material("deep"))
    first = save(folder / "libs" / "first.blend")
    empty()
    second = save(folder / "libs" / "second.blend")  # relative paths need a saved file
    group = bpy.data.collections.new("group")
    with bpy.data.libraries.load(str(first), link=True, relative=relative) as (_, wanted):
        wanted.objects = ["deep"]
    group.objects.link(wanted.objects[0])
    group.use_fake_user = True
    save(second)
    empty()
    save(folder / "chained.blend")
    with bpy.data.libraries.load(str(second), link=True, relative=relative) as (_, wanted):
        wanted.collections = ["group"]
    place = link("place", None)
    place.instance_type, place.instance_collection = "COLLECTION", bpy.data.collections["group"]
    return save(folder / "chained.blend")


def from_the_future(folder: Path) -> Path:
    """Header of Blender 5.3."""
    path = bare(folder).rename(folder / "from_the_future.blend")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    save(path, compress=False)
    raw = path.read_bytes()
    assert raw[:17].endswith(b"0500")
    path.write_bytes(raw[:13] + b"0503" + raw[17:])
    return path


def backup(folder: Path) -> Path:
    return bare(folder).rename(folder / "backup.blend1")


def gzipped(folder: Path) -> Path:
    empty()
    cube()
    plain = save(folder / "plain.blend", compress=False)
    path = folder / "gzipped.blend"
    path.write_bytes(gzip.compress(plain.read_bytes()))
    return path


def zstandard(folder: Path) -> Path:
    empty()
    cube()
    return save(folder / "zstandard.BLEND", compress=True)


def no_suffix(folder: Path) -> Path:
    empty()
    cube()
    return save(folder / "plain.blend", compress=False).rename(folder / "scene_without_suffix")


def truncated(folder: Path) -> Path:
    path = bare(folder).rename(folder / "truncated.blend")
    path.write_bytes(path.read_bytes()[:5000])
    return path


def not_a_blend(folder: Path) -> Path:
    path = folder / "not_a_blend.blend"
    path.write_bytes(b"<html>404</html>")
    return path


def zero_bytes(folder: Path) -> Path:
    path = folder / "zero_bytes.blend"
    path.touch()
    return path


def curves_only(folder: Path) -> Path:
    empty()
    curve = bpy.data.curves.new("wire", "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", 0.1
    spline = curve.splines.new("BEZIER")
    spline.bezier_points.add(1)
    spline.bezier_points[1].co = (2, 0, 1)
    link("wire", curve)
    return save(folder / "curves_only.blend")


def text_only(folder: Path) -> Path:
    empty()
    body = bpy.data.curves.new("text", "FONT")
    body.body, body.extrude = "Hi", 0.05
    link("text", body)
    return save(folder / "text_only.blend")


def empty_text(folder: Path) -> Path:
    empty()
    body = bpy.data.curves.new("text", "FONT")
    body.body = ""
    link("text", body)
    return save(folder / "empty_text.blend")


def metaball_only(folder: Path) -> Path:
    empty()
    data = bpy.data.metaballs.new("ball")
    data.resolution = data.render_resolution = 0.8
    data.elements.new()
    link("ball", data)
    return save(folder / "metaball_only.blend")


def volume_only(folder: Path) -> Path:
    empty()
    link("smoke", bpy.data.volumes.new("smoke"))
    return save(folder / "volume_only.blend")


def points_only(folder: Path) -> Path:
    empty()
    link("points", bpy.data.pointclouds.new("points"))
    return save(folder / "points_only.blend")


def grease_pencil_only(folder: Path) -> Path:
    empty()
    link("drawing", bpy.data.grease_pencils.new("drawing"))
    return save(folder / "grease_pencil_only.blend")


def broken_modifiers(folder: Path) -> Path:
    """Modifiers without their objects, node groups or images."""
    empty()
    obj = cube("modified")
    obj.modifiers.new("boolean", "BOOLEAN")
    obj.modifiers.new("nodes", "NODES")
    obj.modifiers.new("displace", "DISPLACE")
    obj.modifiers.new("lattice", "LATTICE")
    obj.modifiers.new("cache", "MESH_SEQUENCE_CACHE")
    return save(folder / "broken_modifiers.blend")


def odd_materials(folder: Path) -> Path:
    """No output, volume only, an image node without image, an unplugged group, a movie that is gone."""
    empty()
    no_output = material("no output")
    no_output.node_tree.nodes.remove(no_output.node_tree.nodes["Material Output"])
    volume = material("volume")
    tree = volume.node_tree
    tree.nodes.remove(tree.nodes["Principled BSDF"])
    scatter = tree.nodes.new("ShaderNodeVolumeScatter")
    tree.links.new(scatter.outputs[0], tree.nodes["Material Output"].inputs["Volume"])
    no_image = material("no image")
    tree = no_image.node_tree
    tree.links.new(
        tree.nodes.new("ShaderNodeTexImage").outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"]
    )
    no_group = material("no group")
    no_group.node_tree.nodes.new("ShaderNodeGroup")
    bare_tree = material("bare tree")
    bare_tree.node_tree.nodes.clear()
    movie = png(folder / "movie.png")
    movie.source = "MOVIE"
    movie.filepath_raw = str(folder / "movie.mp4")
    for made in (no_output, volume, no_image, no_group, bare_tree, material("movie", image=movie)):
        cube(made.name, made)
    return save(folder / "odd_materials.blend")


def odd_render_settings(folder: Path) -> Path:
    """No layer to be rendered, a panoramic camera, stereo, a huge frame range with a moving camera."""
    scene = empty()
    cube()
    camera = bpy.data.cameras.new("pano")
    camera.type = "PANO"
    scene.camera = link("pano", camera)
    scene.camera.keyframe_insert("location", frame=1)
    scene.camera.location.z = 5
    scene.camera.keyframe_insert("location", frame=1000)
    scene.frame_end = 1_000_000
    scene.view_layers[0].use = False
    scene.render.use_multiview = True
    scene.render.resolution_x, scene.render.resolution_percentage = 4, 1
    return save(folder / "odd_render_settings.blend")


def default_world(folder: Path) -> Path:
    """Blender's own new scene, without its lamp."""
    bpy.ops.wm.read_factory_settings(use_empty=False)
    bpy.data.objects.remove(bpy.data.objects["Light"])
    return save(folder / "default_world.blend")


def circular(folder: Path) -> Path:
    """A Mix Shader that mixes itself, behind a reroute."""
    empty()
    made = material("circular", colour=(1, 0, 0))
    tree = made.node_tree
    mix, reroute = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("NodeReroute")
    tree.links.new(mix.outputs[0], reroute.inputs[0])
    tree.links.new(reroute.outputs[0], mix.inputs[1])
    tree.links.new(tree.nodes["Principled BSDF"].outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    cube("circular", made)
    return save(folder / "circular.blend")


def not_finite(folder: Path) -> Path:
    """NaN and infinite numbers in a material, lamps and the world, lamps of scale 0 and at NaN."""
    scene = empty()
    made = material("not finite", colour=(NAN, 1, 1))
    principled = made.node_tree.nodes["Principled BSDF"]
    for name, value in (("Roughness", NAN), ("IOR", math.inf), ("Emission Strength", math.inf)):
        principled.inputs[name].default_value = value
    cube("not finite", made)
    for kind in ("POINT", "AREA", "SPOT", "SUN"):
        link(f"{kind} hot", bpy.data.lights.new(f"{kind} hot", kind)).data.energy = math.inf
        link(f"{kind} flat", bpy.data.lights.new(f"{kind} flat", kind)).scale = (0, 0, 0)
        link(f"{kind} lost", bpy.data.lights.new(f"{kind} lost", kind)).location = (NAN, 0, 0)
    scene.world = bpy.data.worlds.new("world")
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = NAN
    return save(folder / "not_finite.blend")


def foreign_add_ons(folder: Path) -> Path:
    """A render engine and a shader node of add-ons that are not installed here."""

    class Engine(bpy.types.RenderEngine):
        bl_idname = "FOREIGN"
        bl_label = "foreign"

    class Node(bpy.types.ShaderNode):
        bl_idname = "ForeignNode"
        bl_label = "foreign"

        def init(self, context: Any) -> None:
            del context
            self.outputs.new("NodeSocketColor", "Color")

    scene = empty()
    for kind in (Engine, Node):
        bpy.utils.register_class(kind)
    scene.render.engine = "FOREIGN"
    made = material("foreign")
    tree = made.node_tree
    tree.links.new(tree.nodes.new("ForeignNode").outputs[0], tree.nodes["Principled BSDF"].inputs["Base Color"])
    cube("foreign", made)
    path = save(folder / "foreign_add_ons.blend")
    for kind in (Engine, Node):
        bpy.utils.unregister_class(kind)
    return path


def background_set(folder: Path) -> Path:
    """All there is to see comes from the background scene."""
    scene = empty()
    scene.name = "stage"
    cube("in the background")
    front = bpy.data.scenes.new("front")
    front.background_set = scene
    bpy.context.window.scene = front
    return save(folder / "background_set.blend")


OPENS: dict[str, tuple[Builder, tuple[str, ...]]] = {
    "bare": (bare, ("no camera: a 50 mm camera", "no light", "neutral studio")),
    "lamp as camera": (lamp_as_camera, ("camera 'lamp' that cannot see",)),
    "flat camera": (flat_camera, ("its camera 'good' is used",)),
    "nan camera": (nan_camera, ("camera 'lost' that cannot see",)),
    "missing everything": (
        missing_everything,
        ("image 'gone.png'", "volume 'smoke'", "linked library 'library.blend'", "magenta"),
    ),
    "missing group": (missing_group, ("linked library 'gone_group.blend'",)),
    "half udim": (half_udim, ("tile.1002.png",)),
    "odd paths": (odd_paths, ("C:", "wood.png", "ß.png")),
    "latin names": (latin_names, ("not UTF-8", "NäMEXYZ", "\\xe4THXYZ.png")),
    "two scenes": (two_scenes, ("'first', 'second'", "'second', is converted")),
    "active scene empty": (active_scene_empty, ("scene 'full' is converted",)),
    "appears later": (appears_later, ("nothing is visible at frame 1: frame",)),
    "scripted": (scripted, ("1 Python driver(s) not executed", "cube.location", "on_load.py")),
    "broken transforms": (broken_transforms, ("not finite",)),
    "remote": (remote, ("float32", "move it to the origin")),
    "tiny": (tiny, ()),
    "awkward names": (awkward_names, ()),
    "odd slots": (odd_slots, ()),
    "same names": (same_names, ()),
    "overridden": (overridden, ()),
    "chained": (chained, ()),
    "from the future": (from_the_future, ("saved by Blender 5.3",)),
    "backup": (backup, ()),
    "gzipped": (gzipped, ()),
    "zstandard": (zstandard, ()),
    "no suffix": (no_suffix, ()),
    "curves only": (curves_only, ()),
    "text only": (text_only, ()),
    "metaball only": (metaball_only, ()),
    "broken modifiers": (broken_modifiers, ()),
    "odd materials": (odd_materials, ("movie.mp4",)),
    "odd render settings": (odd_render_settings, ()),
    "circular": (circular, ("1 shader link(s) run in a circle", "circular: ")),
    "not finite": (not_finite, ("not finite (NaN, infinite, beyond 1e+15) and are replaced", "Base Color")),
    "foreign add-ons": (foreign_add_ons, ()),
    "background set": (background_set, ("'front', is converted",)),
    "default world": (default_world, ("default world",)),
}
"""Name -> builder, and what the warnings must say."""

REFUSED: dict[str, tuple[Builder, str]] = {
    "nothing": (nothing, "no object with a surface"),
    "lights only": (lights_only, "no object with a surface"),
    "excluded": (excluded, "no surface is visible"),
    "hidden": (hidden, "no surface is visible"),
    "truncated": (truncated, "damaged or truncated"),
    "not a blend": (not_a_blend, "not a Blender file"),
    "zero bytes": (zero_bytes, "is empty"),
    "far away": (far_away, "where float32 cannot resolve them"),
    "empty text": (empty_text, "no surface is visible"),
    "volume only": (volume_only, "1 volume"),
    "points only": (points_only, "1 pointcloud"),
    "grease pencil only": (grease_pencil_only, "1 grease"),
}
"""Name -> builder, and what the one-line error must say."""


if __name__ == "__main__":
    import sys

    target = Path(sys.argv[1]).resolve()
    for title, (builder, _) in [*OPENS.items(), *REFUSED.items()]:
        place = target / title.replace(" ", "_")
        place.mkdir(parents=True, exist_ok=True)
        print(builder(place))
