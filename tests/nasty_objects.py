"""Meshes, objects, cameras, layers and libraries that users really have and that break converters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
from tests.nasty_materials import Case, plain
from tests.nasty_scenes import NAN, cube, empty, link, material, save

TRIANGLE = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


def mesh(name: str, vertices: Sequence[tuple[float, ...]], faces: Sequence[Sequence[int]]) -> Any:
    data = bpy.data.meshes.new(name)
    data.from_pydata(vertices, [], faces)
    return link(name, data)


def identifiers(choices: Any) -> list[str]:
    """Of the items of an enum."""
    return [item.identifier for item in choices]


def collection(name: str, *objects: Any, shown: bool = True) -> Any:
    """A collection that holds ``objects``, moved out of the scene's own. shown: linked into the scene."""
    made = bpy.data.collections.new(name)
    for obj in objects:
        made.objects.link(obj)
        bpy.context.scene.collection.objects.unlink(obj)
    if shown:
        bpy.context.scene.collection.children.link(made)
    return made


def place(name: str, what: Any, x: float = 0) -> Any:
    """An empty that instances a collection."""
    obj = link(name, None)
    obj.instance_type, obj.instance_collection, obj.location.x = "COLLECTION", what, x
    return obj


# ---------------------------------------------------------------- meshes


def odd_meshes(folder: Path) -> Path:
    """No area, concave n-gons, duplicates, loose edges, eight UV layers, NaN UVs, custom normals of length 0."""
    plain()
    cube("whole")
    mesh("flat", [(0, 0, 0), (1, 0, 0), (2, 0, 0), *TRIANGLE], [(0, 1, 2), (3, 4, 5)])
    mesh("concave", [(0, 0, 0), (4, 0, 0), (4, 4, 0), (2, 1, 0), (0, 4, 0)], [(0, 1, 2, 3, 4)])
    mesh("twisted", [(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2, 3)])
    mesh("twice", TRIANGLE, [(0, 1, 2), (0, 1, 2), (2, 1, 0)])
    data = bpy.data.meshes.new("loose")
    data.from_pydata([*TRIANGLE, (5, 5, 5), (6, 6, 6)], [(3, 4)], [(0, 1, 2)])
    link("loose", data)
    layered = cube("layers").data
    for number in range(7):
        layered.uv_layers.new(name=f"layer {number}")
    layered.uv_layers[0].name = ""
    layered.uv_layers[2].uv.foreach_set("vector", [NAN] * 24)
    normals = cube("normals").data
    normals.normals_split_custom_set([(0, 0, 0)] * 12)
    free = cube("free normals").data.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT")
    free.data.foreach_set("vector", [NAN] * 12)
    return save(folder / "odd_meshes.blend")


KINDS = ("FLOAT", "INT", "FLOAT_VECTOR", "FLOAT_COLOR", "BYTE_COLOR", "STRING", "BOOLEAN", "FLOAT2", "INT8", "INT16_2D",
         "INT32_2D", "QUATERNION", "FLOAT4X4")  # fmt: skip


def attributes(folder: Path) -> Path:
    """Attributes of every type and domain, all of them read by a material; names of Blender's own."""
    plain()
    for domain in ("POINT", "EDGE", "FACE", "CORNER"):
        obj = cube(domain)
        names = ["position", ".corner_vert", "material_index", "sharp_face", "UVMap", "", "gone", "x" * 60]
        for kind in KINDS:
            try:
                names.append(obj.data.attributes.new(f"{domain} {kind}", kind, domain).name)
            except (TypeError, RuntimeError):
                continue
        for name in names:
            made = material(f"{domain} reads {name}")
            tree = made.node_tree
            for node_type, target in (
                ("ShaderNodeAttribute", "Base Color"),
                ("ShaderNodeVertexColor", "Emission Color"),
            ):
                node = tree.nodes.new(node_type)
                setattr(node, "attribute_name" if node_type.endswith("Attribute") else "layer_name", name)
                tree.links.new(node.outputs[0], tree.nodes["Principled BSDF"].inputs[target])
            factor = tree.nodes.new("ShaderNodeAttribute")
            factor.attribute_name = name
            tree.links.new(factor.outputs["Factor" if "Factor" in factor.outputs else "Fac"],
                           tree.nodes["Principled BSDF"].inputs["Roughness"])  # fmt: skip
            obj.data.materials.append(made)
            copy = link(made.name, obj.data.copy())
            copy.data.materials.clear()
            copy.data.materials.append(made)
    return save(folder / "attributes.blend")


def shape_keys(folder: Path) -> Path:
    """Keys relative to each other, muted, driven by the frame, on a lattice, with a NaN; vertices out of groups."""
    scene = plain()
    obj = cube("keyed")
    for name in ("Basis", "one", "two"):
        obj.shape_key_add(name=name)
    keys = obj.data.shape_keys.key_blocks
    keys["one"].relative_key, keys["two"].relative_key = keys["two"], keys["one"]
    keys["one"].data[0].co = (5, 5, 5)
    keys["one"].vertex_group = "gone"
    keys["one"].driver_add("value").driver.expression = "frame / 10"
    broken = cube("broken")
    broken.shape_key_add(name="Basis")
    broken.shape_key_add(name="nan").data[0].co = (NAN, 0, 0)
    broken.data.shape_keys.key_blocks["nan"].value = 1
    scene.frame_set(-3)
    return save(folder / "shape_keys.blend")


# ---------------------------------------------------------------- objects


def odd_objects(folder: Path) -> Path:
    """Mirrored, sheared by its parents, parented to a bone and to vertices that are gone, names of control signs."""
    plain()
    material("line\nbreak\tand\x01bell")
    cube("mirrored").scale = (-1, 1, 1)
    parent = cube("stretched")
    parent.scale = (1, 5, 0.1)
    child = cube("sheared\n\tchild\x02", bpy.data.materials[-1])
    child.parent, child.rotation_euler = parent, (0.5, 0.5, 0.5)
    arm = link("arm", bpy.data.armatures.new("arm"))
    on_bone = cube("on bone")
    on_bone.parent, on_bone.parent_type, on_bone.parent_bone = arm, "BONE", "gone"
    on_vertex = cube("on vertex")
    on_vertex.parent, on_vertex.parent_type, on_vertex.parent_vertices = parent, "VERTEX", (99, 99, 99)
    loop = cube("looks at itself")
    loop.constraints.new("COPY_LOCATION").target = loop
    other = cube("circle")
    other.constraints.new("CHILD_OF").target = child
    child.constraints.new("CHILD_OF").target = other
    quaternion = cube("no rotation")
    quaternion.rotation_mode, quaternion.rotation_quaternion = "QUATERNION", (0, 0, 0, 0)
    return save(folder / "odd_objects.blend")


def every_constraint(folder: Path) -> Path:
    """Every constraint without a target, on meshes and on the camera."""
    scene = plain()
    scene.camera = link("camera", bpy.data.cameras.new("camera"))
    for kind in identifiers(bpy.types.Constraint.bl_rna.properties["type"].enum_items):
        for obj in (cube(kind), scene.camera):
            try:
                obj.constraints.new(kind)
            except RuntimeError:
                continue
    return save(folder / "every_constraint.blend")


def every_modifier(folder: Path) -> Path:
    """Every modifier as it is added, on a mesh, on a curve and on a lattice."""
    plain()
    for number, kind in enumerate(identifiers(bpy.types.Modifier.bl_rna.properties["type"].enum_items)):
        curve = bpy.data.curves.new(kind, "CURVE")
        curve.splines.new("POLY").points.add(2)
        curve.bevel_depth = 0.1
        for obj in (cube(kind), link(kind, curve)):
            obj.location.x = 2 * number
            try:
                obj.modifiers.new(kind, kind)
            except (RuntimeError, TypeError):
                continue
    return save(folder / "every_modifier.blend")


def every_object(folder: Path) -> Path:
    """Every kind of object with its data as new, image empties, probes, speakers and all force fields."""
    plain()
    cube("whole")
    for kind in ("CURVE", "SURFACE", "FONT"):
        link(kind, bpy.data.curves.new(kind, kind))
    for kind in ("metaballs", "hair_curves", "pointclouds", "volumes", "armatures", "lattices", "speakers", "cameras",
                 "grease_pencils"):  # fmt: skip
        link(kind, getattr(bpy.data, kind).new(kind))
    for kind in ("SPHERE", "PLANE", "VOLUME"):
        link(kind, bpy.data.lightprobes.new(kind, kind))
    for kind in ("POINT", "SUN", "SPOT", "AREA"):
        link(kind, bpy.data.lights.new(kind, kind))
    for kind in identifiers(bpy.types.Object.bl_rna.properties["empty_display_type"].enum_items):
        link(kind, None).empty_display_type = kind
    for kind in identifiers(bpy.types.FieldSettings.bl_rna.properties["type"].enum_items):
        obj = link(f"field {kind}", None)
        bpy.context.view_layer.objects.active = obj
        bpy.ops.object.forcefield_toggle()
        obj.field.type = kind
    return save(folder / "every_object.blend")


def instancing(folder: Path) -> Path:
    """On vertices, on faces of no area, nested collections, one that holds nothing, one that holds a camera."""
    plain()
    cube("whole")
    for kind in ("VERTS", "FACES"):
        holder = mesh(f"on {kind}", [*TRIANGLE, (2, 0, 0), (3, 0, 0), (4, 0, 0)], [(0, 1, 2), (3, 4, 5)])
        holder.instance_type, holder.use_instance_faces_scale = kind, True
        cube(f"child of {kind}").parent = holder
    inner = collection("inner", cube("innermost"), shown=False)
    outer = collection("outer", place("nested", inner), shown=False)
    for number in range(3):
        place(f"place {number}", outer, 3 * number)
    place("of nothing", bpy.data.collections.new("nothing"))
    camera = link("in an instance", bpy.data.cameras.new("in an instance"))
    place("of a camera", collection("cameras", camera, shown=False))
    hidden = cube("hidden in an instance")
    hidden.hide_render = True
    place("of the hidden", collection("hidden", hidden, shown=False))
    return save(folder / "instancing.blend")


def particles(folder: Path) -> Path:
    """Hair, strands without children, instances of a collection, of a hidden object, of nothing, of a lamp, halos."""
    scene = plain()
    hidden = cube("hidden")
    hidden.hide_render = True
    lamp = link("lamp", bpy.data.lights.new("lamp", "POINT"))
    group = collection("group", cube("in group"), shown=False)
    for name in ("hair", "children", "of a collection", "of the hidden", "of nothing", "of a lamp", "halo", "line",
                 "none", "zero", "later"):  # fmt: skip
        obj = cube(name)
        obj.modifiers.new(name, "PARTICLE_SYSTEM")
        settings = obj.particle_systems[0].settings
        settings.count = 0 if name == "zero" else 5
        if name in {"hair", "children", "zero"}:
            settings.type = "HAIR"
        if name == "children":
            settings.child_type, settings.rendered_child_count = "INTERPOLATED", 3
        if name == "of a collection":
            settings.type, settings.render_type, settings.instance_collection = "HAIR", "COLLECTION", group
        elif name.startswith("of"):
            settings.render_type = "OBJECT"
            settings.instance_object = {"of the hidden": hidden, "of a lamp": lamp}.get(name)
        elif name in {"halo", "line", "none"}:
            settings.render_type = name.upper()
        if name == "later":
            settings.frame_start = 200
    scene.frame_set(10)
    return save(folder / "particles.blend")


def strands(folder: Path) -> Path:
    """Curves without points, of one point, without radius, with NaN; point clouds of none and of NaN."""
    plain()
    cube("whole")
    for name, sizes in (("none", []), ("single", [1, 1]), ("mixed", [1, 4, 0 + 2]), ("broken", [3])):
        data = bpy.data.hair_curves.new(name)
        if sizes:
            data.add_curves(sizes)
        for index, point in enumerate(data.points):
            point.position = (NAN if name == "broken" and index == 1 else index, 0, index)
        link(name, data)
    link("cloud", bpy.data.pointclouds.new("cloud"))
    return save(folder / "strands.blend")


def nodes_modifier(name: str, build: Any) -> Any:
    """A tetrahedron whose geometry-nodes modifier ``build(tree, its input, its output)`` makes."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    build(tree, tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput"))
    obj = cube(name)
    obj.modifiers.new(name, "NODES").node_group = tree
    return obj


def geometry_nodes(folder: Path) -> Path:
    """Nodes that give only instances, curves, a volume, points, grease pencil, nothing, themselves, or by the frame."""
    scene = plain()

    def instances(tree: Any, start: Any, end: Any) -> None:
        scatter = tree.nodes.new("GeometryNodeInstanceOnPoints")
        tree.links.new(start.outputs[0], scatter.inputs["Points"])
        tree.links.new(tree.nodes.new("GeometryNodeMeshCube").outputs[0], scatter.inputs["Instance"])
        tree.links.new(scatter.outputs[0], end.inputs[0])

    def by_frame(tree: Any, start: Any, end: Any) -> None:
        move = tree.nodes.new("GeometryNodeTransform")
        tree.links.new(start.outputs[0], move.inputs["Geometry"])
        tree.links.new(tree.nodes.new("GeometryNodeInputSceneTime").outputs["Frame"], move.inputs["Translation"])
        tree.links.new(move.outputs[0], end.inputs[0])

    def only(kind: str) -> Any:
        def build(tree: Any, start: Any, end: Any) -> None:
            del start
            tree.links.new(tree.nodes.new(kind).outputs[0], end.inputs[0])

        return build

    def converted(kind: str) -> Any:
        def build(tree: Any, start: Any, end: Any) -> None:
            node = tree.nodes.new(kind)
            tree.links.new(start.outputs[0], node.inputs[0])
            tree.links.new(node.outputs[0], end.inputs[0])

        return build

    def itself(tree: Any, start: Any, end: Any) -> None:
        info = tree.nodes.new("GeometryNodeObjectInfo")
        tree.links.new(info.outputs["Geometry"], end.inputs[0])

    nodes_modifier("instances", instances)
    nodes_modifier("by frame", by_frame)
    nodes_modifier("curves", only("GeometryNodeCurvePrimitiveCircle"))
    nodes_modifier("volume", only("GeometryNodeVolumeCube"))
    nodes_modifier("points", only("GeometryNodePoints"))
    nodes_modifier("mesh to volume", converted("GeometryNodeMeshToVolume"))
    nodes_modifier("mesh to points", converted("GeometryNodeMeshToPoints"))
    nodes_modifier("nothing", lambda tree, start, end: None)
    nodes_modifier("of no object", itself)
    strange = bpy.data.node_groups.new("strange", "GeometryNodeTree")  # without any socket
    cube("strange").modifiers.new("strange", "NODES").node_group = strange
    cube("whole")
    scene.frame_set(7)
    return save(folder / "geometry_nodes.blend")


def heavy_modifiers(folder: Path) -> Path:
    """Ocean, remesh, build before its start, mask of everything, array of nothing, subdivision of loose edges."""
    scene = plain()
    cube("whole")
    ocean = cube("ocean").modifiers.new("ocean", "OCEAN")
    ocean.resolution = 2
    cube("remesh").modifiers.new("remesh", "REMESH").octree_depth = 3
    cube("build").modifiers.new("build", "BUILD").frame_start = 500
    cube("mask").modifiers.new("mask", "MASK").vertex_group = "gone"
    array = cube("array").modifiers.new("array", "ARRAY")
    array.count, array.relative_offset_displace = 3, (NAN, 0, 0)
    multires = cube("multires").modifiers.new("multires", "MULTIRES")
    multires.render_levels = 2
    cube("subsurf").modifiers.new("subsurf", "SUBSURF").render_levels = 2
    scene.frame_set(1)
    return save(folder / "heavy_modifiers.blend")


def moved_by_frame(folder: Path) -> Path:
    """Drivers of the frame on a place, a colour, a lamp and a modifier; motion blur of a child and of a deformation."""
    scene = plain()
    scene.render.use_motion_blur = True
    obj = cube("driven", material("driven"))
    obj.driver_add("location", 0).driver.expression = "frame"
    tree = obj.active_material.node_tree
    curve = tree.nodes["Principled BSDF"].inputs["Roughness"].driver_add("default_value")
    curve.driver.expression = "1 / (frame - 5)"
    lamp = bpy.data.lights.new("lamp", "POINT")
    lamp.driver_add("energy").driver.expression = "frame * 10"
    link("lamp", lamp)
    parent = link("parent", None)
    parent.keyframe_insert("location", frame=1)
    parent.location.x = 5
    parent.keyframe_insert("location", frame=9)
    cube("child of the moving").parent = parent
    deformed = cube("deformed")
    deformed.shape_key_add(name="Basis")
    key = deformed.shape_key_add(name="moves")
    key.keyframe_insert("value", frame=1)
    cube("still")
    scene.frame_set(5)
    return save(folder / "moved_by_frame.blend")


def hidden_in_viewport(folder: Path) -> Path:
    """Lamps and cameras that hang on others, hidden by eye, by screen, by collection; all of them are rendered."""
    scene = plain()
    cube()
    for name in ("eye", "screen", "parents too", "collection", "collection by eye", "driven", "camera", "excluded"):
        is_camera = name in {"camera", "excluded"}
        data = bpy.data.cameras.new(name) if is_camera else bpy.data.lights.new(name, "POINT")
        if not is_camera:
            data.shadow_soft_size = 0.1
        parent, obj = link(f"parent of {name}", None), link(name, data)
        obj.parent, parent.location, obj.location = parent, (1, 2, 3), (10, 0, 0)
        if name == "eye":
            obj.hide_set(True)
        elif name in {"screen", "parents too", "driven", "camera"}:
            obj.hide_viewport = True
            parent.hide_viewport = name == "parents too"
        else:
            collection(name, parent, obj).hide_viewport = name == "collection"
            layer = scene.view_layers[0].layer_collection.children[name]
            layer.hide_viewport, layer.exclude = name == "collection by eye", name == "excluded"
        if name == "driven":
            data.driver_add("energy").driver.expression = "frame * 100"
    lamp = bpy.data.objects.new("instanced", bpy.data.lights.new("instanced", "POINT"))
    lamp.data.shadow_soft_size = 0.1
    inner = bpy.data.collections.new("inner")
    inner.objects.link(lamp)
    holder = place("holder", inner)
    holder.location, holder.hide_viewport = (11, 2, 3), True
    return save(folder / "hidden_in_viewport.blend")


# ---------------------------------------------------------------- cameras and pictures


def odd_cameras(folder: Path) -> Path:
    """Clipping the wrong way round, tiny sensor, orthographic, shifted, panoramas, focus on a lost object."""
    scene = plain()
    cube()
    lost = cube("lost")
    lost.location = (NAN, 0, 0)
    for name, settings in {
        "clip": {"clip_start": 100, "clip_end": 0.01},
        "sensor": {"sensor_width": 1e-3, "sensor_height": 1e-3, "lens": 1e-3},
        "ortho": {"type": "ORTHO", "ortho_scale": 0},
        "shift": {"shift_x": 1000, "shift_y": -1000},
        "pano": {"type": "PANO"},
        "custom": {"type": "CUSTOM"},
        "vertical": {"sensor_fit": "VERTICAL", "lens": 5000},
    }.items():
        data = bpy.data.cameras.new(name)
        for key, value in settings.items():
            try:
                setattr(data, key, value)
            except TypeError:
                continue
        data.dof.use_dof, data.dof.focus_object, data.dof.aperture_fstop = True, lost, 1e-3
        camera = link(name, data)
        camera.scale = (-1, 1, 2)
        scene.timeline_markers.new(name, frame=10 * len(scene.timeline_markers)).camera = camera
    scene.camera = bpy.data.objects["clip"]
    scene.frame_end = 80
    return save(folder / "odd_cameras.blend")


def odd_pictures(folder: Path) -> Path:
    """Pixels that are not square, a border, a huge frame range of negative frames, fields, freestyle, simplify."""
    scene = plain()
    cube()
    render = scene.render
    render.pixel_aspect_x, render.pixel_aspect_y = 2, 1
    render.use_border, render.use_crop_to_border = True, True
    render.border_min_x, render.border_max_x = 0.7, 0.2
    render.use_freestyle = True
    render.use_simplify, render.simplify_subdivision_render = True, 0
    render.use_stamp = True
    render.fps, render.fps_base = 1, 1000
    scene.unit_settings.scale_length = 1e-9
    scene.frame_start, scene.frame_end = -500, 500
    scene.frame_set(-499)
    render.engine, scene.cycles.film_exposure = "CYCLES", 4
    scene.gravity = (NAN, NAN, NAN)
    return save(folder / "odd_pictures.blend")


def layers(folder: Path) -> Path:
    """Two layers of which the first is not rendered; holdout and indirect-only collections; a shadow catcher."""
    scene = plain()
    cube("plain")
    caught = cube("catcher")
    caught.is_shadow_catcher = True
    collection("holdout", cube("held out"))
    collection("indirect", cube("indirect"), place("placed", collection("inner", cube("instanced"), shown=False)))
    scene.view_layers[0].use = False
    layer = scene.view_layers.new("second")
    layer.layer_collection.children["holdout"].holdout = True
    layer.layer_collection.children["indirect"].indirect_only = True
    layer.use_solid = True
    return save(folder / "layers.blend")


def overriding_layer(folder: Path) -> Path:
    """A layer whose material and world stand for all others."""
    scene = plain()
    cube("red", material("red", colour=(1, 0, 0)))
    layer = scene.view_layers[0]
    layer.material_override = material("clay", colour=(0.5, 0.5, 0.5))
    scene.world = bpy.data.worlds.new("own")
    if hasattr(layer, "world_override"):
        layer.world_override = bpy.data.worlds.new("other")
    layer.use_sky = False
    return save(folder / "overriding_layer.blend")


def compositor(folder: Path) -> Path:
    """A compositor that turns everything green, and a sequencer."""
    scene = plain()
    cube()
    group = bpy.data.node_groups.new("green", "CompositorNodeTree")
    group.nodes.new("CompositorNodeRLayers")
    scene.compositing_node_group = group
    scene.sequence_editor_create()
    editor = scene.sequence_editor
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences
    strips.new_effect("colour", "COLOR", 1, 1, **({"length": 20} if bpy.app.version >= (5, 0) else {"frame_end": 20}))
    return save(folder / "compositor.blend")


def beside_pencil(folder: Path) -> Path:
    """Grease pencil, annotations and a volume beside a mesh."""
    plain()
    cube("whole")
    link("drawing", bpy.data.grease_pencils.new("drawing"))
    link("smoke", bpy.data.volumes.new("smoke"))
    return save(folder / "beside_pencil.blend")


# ---------------------------------------------------------------- libraries


def linking_back(folder: Path) -> Path:
    """A links a collection of B, which links an object of A."""
    first, second = folder / "a" / "first.blend", folder / "b" / "second.blend"
    plain()
    cube("own")
    save(first)
    plain()
    save(second)
    with bpy.data.libraries.load(str(first), link=True, relative=True) as (_, wanted):
        wanted.objects = ["own"]
    holder = bpy.data.collections.new("holder")
    holder.objects.link(wanted.objects[0])
    holder.objects.link(cube("of second"))
    holder.use_fake_user = True
    save(second)
    bpy.ops.wm.open_mainfile(filepath=str(first))
    with bpy.data.libraries.load(str(second), link=True, relative=True) as (_, wanted):
        wanted.collections = ["holder"]
    place("instance", wanted.collections[0], 2)
    return save(first)


def moved_library(folder: Path) -> Path:
    """A library beside another folder, named relatively, and its material's image relative to the library."""
    from tests.nasty_scenes import png

    plain()
    save(folder / "assets" / "library.blend")
    image = png(folder / "assets" / "textures" / "wood.png")
    image.filepath = "//textures/wood.png"
    cube("chair", material("wood", image=image))
    save(folder / "assets" / "library.blend")
    plain()
    save(folder / "shots" / "one" / "shot.blend")
    library = str(folder / "assets" / "library.blend")
    with bpy.data.libraries.load(library, link=True, relative=True) as (_, wanted):
        wanted.objects = ["chair"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    return save(folder / "shots" / "one" / "shot.blend")


def deep_parents(folder: Path) -> Path:
    """A chain of 1200 parents, collections nested 60 deep."""
    scene = empty()
    scene.view_settings.view_transform = "Standard"
    last = None
    for number in range(1200):
        obj = link(f"parent {number}", None)
        obj.parent, last = last, obj
    obj = cube("at the end")
    obj.parent = last
    inner = scene.collection
    for number in range(60):
        deeper = bpy.data.collections.new(f"level {number}")
        inner.children.link(deeper)
        inner = deeper
    inner.objects.link(obj)
    scene.collection.objects.unlink(obj)
    return save(folder / "deep_parents.blend")


def huge_and_tiny(folder: Path) -> Path:
    """A ground of 1e5 units beside a thing of 1e-4, a lamp of 1e-30 W and one of 1e30."""
    plain()
    obj = mesh("ground", TRIANGLE, [(0, 1, 2)])
    obj.scale = (1e5, 1e5, 1)
    cube("speck").scale = (1e-4, 1e-4, 1e-4)
    for energy in (1e-30, 1e29):
        lamp = link(f"{energy:g}", bpy.data.lights.new("lamp", "SPOT"))
        lamp.data.energy, lamp.location.z = energy, 2
    link("far", bpy.data.lights.new("far", "SUN")).location = (1e20, 0, 0)
    link("turned", bpy.data.lights.new("turned", "AREA")).rotation_euler = (math.inf, 0, 0)
    return save(folder / "huge_and_tiny.blend")


CONVERTS: dict[str, Case] = {
    "odd meshes": (odd_meshes, ()),
    "attributes": (attributes, ("attribute 'gone'", "not found on the mesh")),
    "shape keys": (shape_keys, ("not finite",)),
    "odd objects": (odd_objects, ()),
    "every constraint": (every_constraint, ()),
    "every modifier": (every_modifier, ()),
    "every object": (every_object, ("volume object", "greasepencil object")),
    "instancing": (instancing, ()),
    "particles": (particles, ("particles shown as halo", "particles shown as line", "hair")),
    "strands": (strands, ("hair",)),
    "geometry nodes": (geometry_nodes, ("volume", "point cloud")),
    "heavy modifiers": (heavy_modifiers, ()),
    "moved by frame": (moved_by_frame, ("motion blur", "child of the moving", "deformed")),
    "hidden in viewport": (hidden_in_viewport, ()),
    "odd cameras": (odd_cameras, ()),
    "odd pictures": (odd_pictures, ("pixel aspect", "render border", "freestyle", "simplify", "film exposure")),
    "layers": (layers, ("shadow catcher", "object 'held out'")),
    "overriding layer": (overriding_layer, ("material override", "clay")),
    "compositor": (compositor, ("compositor", "sequencer")),
    "beside pencil": (beside_pencil, ("greasepencil object", "volume object")),
    "linking back": (linking_back, ()),
    "moved library": (moved_library, ()),
    "deep parents": (deep_parents, ()),
    "huge and tiny": (huge_and_tiny, ()),
}
"""Name -> builder, and what warnings and findings must say."""
