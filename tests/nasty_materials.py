"""Shader trees, lamps and worlds that users really have and that break converters: one small builder each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
from tests.nasty_scenes import Builder, cube, empty, link, material, png, save

Case = tuple[Builder, tuple[str, ...]]


def plain() -> Any:
    """An empty scene whose display transform takes no time to convert."""
    scene = empty()
    scene.view_settings.view_transform = "Standard"
    return scene


def tree_of(name: str) -> tuple[Any, Any, Any]:
    """(material, its tree, its Principled BSDF)."""
    made = material(name)
    return made, made.node_tree, made.node_tree.nodes["Principled BSDF"]


def output_of(tree: Any) -> Any:
    return next(node for node in tree.nodes if node.bl_idname.startswith("ShaderNodeOutput"))


def group_of(name: str, inputs: dict[str, str], outputs: dict[str, str]) -> tuple[Any, Any, Any]:
    """(group, its input node, its output node). inputs, outputs: name -> type of socket."""
    group = bpy.data.node_groups.new(name, "ShaderNodeTree")
    for direction, sockets in (("INPUT", inputs), ("OUTPUT", outputs)):
        for socket, kind in sockets.items():
            group.interface.new_socket(socket, in_out=direction, socket_type=kind)
    return group, group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")


def use(tree: Any, group: Any) -> Any:
    node = tree.nodes.new("ShaderNodeGroup")
    node.node_tree = group
    return node


def of_add_on(base: type, name: str, **outputs: str) -> type:
    """A node class as another renderer's add-on registers it. outputs: name of a socket -> its type."""

    def init(self: Any, context: Any) -> None:
        del context
        self.inputs.new("NodeSocketColor", "Tint")
        self.inputs.new("NodeSocketShader", "Shader")
        for socket, kind in outputs.items():
            self.outputs.new(kind, socket)

    return type(name, (base,), {"bl_idname": name, "bl_label": name, "init": init})


@contextmanager
def add_on(*kinds: type) -> Iterator[None]:
    """The classes are registered while the file is made, and unknown when it is read."""
    for kind in kinds:
        bpy.utils.register_class(kind)
    try:
        yield
    finally:
        for kind in reversed(kinds):
            bpy.utils.unregister_class(kind)


# ---------------------------------------------------------------- nodes of add-ons that are not installed


def foreign_output(folder: Path) -> Path:
    """The only output is another renderer's."""
    plain()
    with add_on(of_add_on(bpy.types.ShaderNode, "ForeignOutput", Out="NodeSocketShader")):
        made, tree, principled = tree_of("foreign output")
        tree.nodes.remove(output_of(tree))
        tree.links.new(principled.outputs[0], tree.nodes.new("ForeignOutput").inputs["Shader"])
        cube("thing", made)
        return save(folder / "foreign_output.blend")


def foreign_shader(folder: Path) -> Path:
    """A foreign BSDF alone, behind a Mix Shader, behind an Add Shader, as a volume, as displacement."""
    plain()
    with add_on(of_add_on(bpy.types.ShaderNode, "ForeignBSDF", BSDF="NodeSocketShader", Disp="NodeSocketVector")):
        for kind in ("Surface", "Mix", "Add", "Volume", "Displacement"):
            made, tree, principled = tree_of(kind)
            foreign, output = tree.nodes.new("ForeignBSDF"), output_of(tree)
            if kind in {"Mix", "Add"}:
                combined = tree.nodes.new(f"ShaderNode{kind}Shader")
                shaders = [socket for socket in combined.inputs if socket.type == "SHADER"]
                tree.links.new(foreign.outputs["BSDF"], shaders[0])
                tree.links.new(principled.outputs[0], shaders[1])
                tree.links.new(combined.outputs[0], output.inputs["Surface"])
            else:
                source = foreign.outputs["Disp" if kind == "Displacement" else "BSDF"]
                tree.links.new(source, output.inputs[kind])
            cube(kind, made)
        return save(folder / "foreign_shader.blend")


def foreign_texture(folder: Path) -> Path:
    """Foreign colours before a procedural texture, a bump, a normal map, a mapping, through reroutes, muted."""
    plain()
    with add_on(of_add_on(bpy.types.ShaderNode, "ForeignTexture", Color="NodeSocketColor", Value="NodeSocketFloat")):
        for kind, socket in (
            ("ShaderNodeTexNoise", "Scale"),
            ("ShaderNodeBump", "Height"),
            ("ShaderNodeNormalMap", "Color"),
            ("ShaderNodeMapping", "Scale"),
            ("ShaderNodeMix", "A_Color"),
            ("NodeReroute", "Input"),
        ):
            made, tree, principled = tree_of(kind)
            principled.inputs["Base Color"].default_value = (0.5, 0.2, 0.1, 1)
            foreign, between = tree.nodes.new("ForeignTexture"), tree.nodes.new(kind)
            if kind == "ShaderNodeMix":
                between.data_type = "RGBA"
            found = next(s for s in between.inputs if socket in (s.identifier, s.name))
            tree.links.new(foreign.outputs[0], found)
            target = "Normal" if kind in {"ShaderNodeBump", "ShaderNodeNormalMap"} else "Base Color"
            out = next(s for s in between.outputs if s.enabled)
            if kind == "ShaderNodeMapping":
                noise = tree.nodes.new("ShaderNodeTexNoise")
                tree.links.new(out, noise.inputs["Vector"])
                out = noise.outputs[0]
            tree.links.new(out, principled.inputs[target])
            cube(kind, made)
        made, tree, principled = tree_of("muted")
        foreign = tree.nodes.new("ForeignTexture")
        tree.links.new(foreign.outputs[0], principled.inputs["Base Color"])
        foreign.mute = True
        cube("muted", made)
        return save(folder / "foreign_texture.blend")


def foreign_in_group(folder: Path) -> Path:
    """Inside a group, before a group, after a group."""
    plain()
    with add_on(of_add_on(bpy.types.ShaderNode, "ForeignInner", Color="NodeSocketColor")):
        group, start, end = group_of("holder", {"In": "NodeSocketColor"}, {"Out": "NodeSocketColor"})
        group.links.new(group.nodes.new("ForeignInner").outputs[0], end.inputs[0])
        through, start, end = group_of("through", {"In": "NodeSocketColor"}, {"Out": "NodeSocketColor"})
        through.links.new(start.outputs[0], end.inputs[0])
        for kind, which in (("inside", group), ("before", through)):
            made, tree, principled = tree_of(kind)
            node = use(tree, which)
            node.inputs[0].default_value = (0.1, 0.5, 0.2, 1)
            if kind == "before":
                tree.links.new(tree.nodes.new("ForeignInner").outputs[0], node.inputs[0])
            tree.links.new(node.outputs[0], principled.inputs["Base Color"])
            cube(kind, made)
        return save(folder / "foreign_in_group.blend")


def foreign_custom_group(folder: Path) -> Path:
    """A group node of an add-on's own class, which holds a tree."""
    plain()
    kind = type(
        "ForeignGroup", (bpy.types.ShaderNodeCustomGroup,), {"bl_idname": "ForeignGroup", "bl_label": "ForeignGroup"}
    )
    with add_on(kind):
        group, _, end = group_of("inner", {}, {"Out": "NodeSocketColor"})
        end.inputs[0].default_value = (0, 1, 0, 1)
        made, tree, principled = tree_of("custom group")
        node = tree.nodes.new("ForeignGroup")
        node.node_tree = group
        tree.links.new(node.outputs[0], principled.inputs["Base Color"])
        cube("thing", made)
        return save(folder / "foreign_custom_group.blend")


def foreign_world(folder: Path) -> Path:
    scene = plain()
    with add_on(of_add_on(bpy.types.ShaderNode, "ForeignSky", Color="NodeSocketColor", Env="NodeSocketShader")):
        scene.world = bpy.data.worlds.new("foreign world")
        tree = scene.world.node_tree
        tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.6, 0.9, 1)
        tree.links.new(tree.nodes.new("ForeignSky").outputs["Color"], tree.nodes["Background"].inputs["Color"])
        cube()
        return save(folder / "foreign_world.blend")


def foreign_world_output(folder: Path) -> Path:
    """The world's shader is another renderer's, and a Mix of it with a Background lies beside."""
    scene = plain()
    with add_on(of_add_on(bpy.types.ShaderNode, "ForeignEnv", Env="NodeSocketShader")):
        scene.world = bpy.data.worlds.new("foreign env")
        tree = scene.world.node_tree
        mix = tree.nodes.new("ShaderNodeMixShader")
        tree.links.new(tree.nodes.new("ForeignEnv").outputs["Env"], mix.inputs[1])
        tree.links.new(tree.nodes["Background"].outputs[0], mix.inputs[2])
        tree.links.new(mix.outputs[0], output_of(tree).inputs["Surface"])
        cube()
        return save(folder / "foreign_world_output.blend")


def foreign_lamp(folder: Path) -> Path:
    """Lamps whose strength, whose shader and whose output are foreign."""
    plain()
    with add_on(of_add_on(bpy.types.ShaderNode, "ForeignLamp", V="NodeSocketFloat", S="NodeSocketShader")):
        cube()
        for kind in ("strength", "shader", "output"):
            lamp = bpy.data.lights.new(kind, "POINT")
            lamp.use_nodes = True
            tree = lamp.node_tree
            tree.nodes.clear()
            foreign = tree.nodes.new("ForeignLamp")
            emission = tree.nodes.new("ShaderNodeEmission")
            if kind == "output":
                tree.links.new(emission.outputs[0], foreign.inputs["Shader"])
            else:
                output = tree.nodes.new("ShaderNodeOutputLight")
                source = foreign.outputs["S"] if kind == "shader" else emission.outputs[0]
                tree.links.new(source, output.inputs[0])
                tree.links.new(foreign.outputs["V"], emission.inputs["Strength"])
            link(kind, lamp).location = (0, 0, 3)
        return save(folder / "foreign_lamp.blend")


def foreign_geometry(folder: Path) -> Path:
    """A geometry-nodes modifier with a node of an add-on: in the geometry's way, and beside it."""
    plain()
    with add_on(of_add_on(bpy.types.GeometryNode, "ForeignGeometry", Geometry="NodeSocketGeometry")):
        for kind in ("beside", "between"):
            tree = bpy.data.node_groups.new(kind, "GeometryNodeTree")
            for direction in ("INPUT", "OUTPUT"):
                tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
            start, end = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
            foreign = tree.nodes.new("ForeignGeometry")
            join = tree.nodes.new("GeometryNodeJoinGeometry")
            tree.links.new(start.outputs[0], join.inputs[0])
            tree.links.new(foreign.outputs[0], join.inputs[0] if kind == "beside" else end.inputs[0])
            if kind == "beside":
                tree.links.new(join.outputs[0], end.inputs[0])
            cube(kind).modifiers.new("nodes", "NODES").node_group = tree
        cube("whole")
        return save(folder / "foreign_geometry.blend")


def foreign_sockets(folder: Path) -> Path:
    """Sockets of an add-on's own type, on its node and on a group."""
    plain()

    class ForeignSocket(bpy.types.NodeSocket):
        bl_idname = "ForeignSocket"
        bl_label = "foreign"

        def draw(self, context: Any, layout: Any, node: Any, text: str) -> None: ...

        def draw_color(self, context: Any, node: Any) -> tuple[float, ...]:
            return (1, 1, 1, 1)

    def init(self: Any, context: Any) -> None:
        del context
        self.inputs.new("ForeignSocket", "in")
        self.outputs.new("ForeignSocket", "out")

    kind = type("ForeignBox", (bpy.types.ShaderNode,), {"bl_idname": "ForeignBox", "bl_label": "box", "init": init})
    with add_on(ForeignSocket, kind):
        made, tree, principled = tree_of("foreign sockets")
        box, other = tree.nodes.new("ForeignBox"), tree.nodes.new("ForeignBox")
        tree.links.new(box.outputs[0], other.inputs[0])
        tree.links.new(other.outputs[0], principled.inputs["Base Color"], verify_limits=False)
        tree.links.new(other.outputs[0], output_of(tree).inputs["Displacement"], verify_limits=False)
        reroute = tree.nodes.new("NodeReroute")
        tree.links.new(box.outputs[0], reroute.inputs[0])
        tree.links.new(reroute.outputs[0], principled.inputs["Roughness"])
        cube("thing", made)
        return save(folder / "foreign_sockets.blend")


# ---------------------------------------------------------------- trees


def deep_chain(folder: Path) -> Path:
    """600 Math nodes in a row, and 400 Mix Shaders."""
    plain()
    made, tree, principled = tree_of("deep values")
    last = tree.nodes.new("ShaderNodeValue").outputs[0]
    for _ in range(600):
        node = tree.nodes.new("ShaderNodeMath")
        node.inputs[1].default_value = 0.001
        tree.links.new(last, node.inputs[0])
        last = node.outputs[0]
    tree.links.new(last, principled.inputs["Roughness"])
    cube("values", made)
    made, tree, principled = tree_of("deep shaders")
    last = principled.outputs[0]
    for _ in range(400):
        node = tree.nodes.new("ShaderNodeMixShader")
        node.inputs[0].default_value = 0
        tree.links.new(last, node.inputs[1])
        last = node.outputs[0]
    tree.links.new(last, output_of(tree).inputs["Surface"])
    cube("shaders", made)
    return save(folder / "deep_chain.blend")


def diamonds(folder: Path) -> Path:
    """40 nodes each of which reads the one before twice: 2^40 ways through."""
    plain()
    made, tree, principled = tree_of("diamonds")
    last = tree.nodes.new("ShaderNodeTexImage")
    last.image = png(folder / "diamond.png")
    last = last.outputs["Color"]
    for _ in range(40):
        node = tree.nodes.new("ShaderNodeMixRGB")
        tree.links.new(last, node.inputs[1])
        tree.links.new(last, node.inputs[2])
        last = node.outputs[0]
    tree.links.new(last, principled.inputs["Base Color"])
    cube("values", made)
    made, tree, principled = tree_of("shader diamonds")
    last = principled.outputs[0]
    for _ in range(40):
        node = tree.nodes.new("ShaderNodeMixShader")
        tree.links.new(last, node.inputs[1])
        tree.links.new(last, node.inputs[2])
        last = node.outputs[0]
    tree.links.new(last, output_of(tree).inputs["Surface"])
    cube("shaders", made)
    return save(folder / "diamonds.blend")


GROUP_SOCKETS = ("Float", "Int", "Bool", "Vector", "Color", "Shader", "String", "Menu", "Rotation", "Matrix", "Object",
                 "Image", "Material", "Collection", "Texture", "Bundle", "Closure")  # fmt: skip


def typed_groups(folder: Path) -> Path:
    """Unlinked group inputs of every type, read as a colour, a number, a vector and a shader."""
    plain()
    for kind in GROUP_SOCKETS:
        try:
            group, start, end = group_of(kind, {"In": f"NodeSocket{kind}"}, {"Shader": "NodeSocketShader"})
        except (TypeError, RuntimeError):
            continue  # a socket that shader trees do not take
        principled, emission = group.nodes.new("ShaderNodeBsdfPrincipled"), group.nodes.new("ShaderNodeEmission")
        glass, mix = group.nodes.new("ShaderNodeBsdfGlass"), group.nodes.new("ShaderNodeMixShader")
        add = group.nodes.new("ShaderNodeAddShader")
        for node, sockets in (
            (principled, ("Base Color", "Roughness", "Metallic", "Alpha", "Normal", "Emission Color", "IOR")),
            (principled, ("Emission Strength", "Transmission Weight", "Coat Weight", "Subsurface Weight")),
            (emission, ("Color", "Strength")),
            (glass, ("Roughness", "IOR", "Color")),
        ):
            for socket in sockets:
                group.links.new(start.outputs[0], node.inputs[socket])
        group.links.new(start.outputs[0], mix.inputs[0])
        group.links.new(principled.outputs[0], mix.inputs[1])
        group.links.new(glass.outputs[0], mix.inputs[2])
        group.links.new(mix.outputs[0], add.inputs[0])
        group.links.new(emission.outputs[0], add.inputs[1])
        group.links.new(add.outputs[0], end.inputs[0])
        made, tree, _ = tree_of(kind)
        tree.links.new(use(tree, group).outputs[0], output_of(tree).inputs["Surface"])
        cube(kind, made)
    return save(folder / "typed_groups.blend")


def typed_world(folder: Path) -> Path:
    """A world and a lamp in a group whose colour is a number and whose strength is a colour."""
    scene = plain()
    group, start, end = group_of(
        "light", {"Number": "NodeSocketFloat", "Colour": "NodeSocketColor"}, {"Out": "NodeSocketShader"}
    )
    background = group.nodes.new("ShaderNodeBackground")
    group.links.new(start.outputs["Number"], background.inputs["Color"])
    group.links.new(start.outputs["Colour"], background.inputs["Strength"])
    group.links.new(background.outputs[0], end.inputs[0])
    scene.world = bpy.data.worlds.new("typed")
    tree = scene.world.node_tree
    tree.links.new(use(tree, group).outputs[0], output_of(tree).inputs["Surface"])
    cube()
    return save(folder / "typed_world.blend")


def node_classes() -> list[str]:
    """Every node that shader trees take."""
    trial = bpy.data.node_groups.new("trial", "ShaderNodeTree")
    names = []
    for name in sorted(dir(bpy.types)):
        kind = getattr(bpy.types, name)
        if not (isinstance(kind, type) and issubclass(kind, bpy.types.Node)):
            continue
        try:
            trial.nodes.new(name)
        except RuntimeError:
            continue
        names.append(name)
    bpy.data.node_groups.remove(trial)
    return names


SLOTS = {"RGBA": "Base Color", "VALUE": "Roughness", "VECTOR": "Normal", "SHADER": ""}


def every_node(folder: Path, *, feed: Callable[[Any], Any] | None = None) -> Path:
    """Every node of this Blender, each output feeding a colour, a number, a normal, an emission or the output.

    feed: makes a node whose first output feeds every input.
    """
    plain()
    image = png(folder / "every.png")
    count = 0
    for name in node_classes():
        if name.startswith("ShaderNodeOutput") or name in {"NodeFrame", "NodeGroupInput", "NodeGroupOutput"}:
            continue
        probe = bpy.data.node_groups.new("probe", "ShaderNodeTree")
        outputs = len(probe.nodes.new(name).outputs)
        bpy.data.node_groups.remove(probe)
        for index in range(outputs):
            made, tree, principled = tree_of(f"{name} {index}")
            node = tree.nodes.new(name)
            if hasattr(node, "image"):
                node.image = image
            if feed is not None:
                source = feed(tree)
                for socket in node.inputs:
                    tree.links.new(source.outputs[0], socket)
            out, output = node.outputs[index], output_of(tree)
            if out.type == "SHADER":
                tree.links.new(out, output.inputs["Volume" if "Volume" in name else "Surface"])
            else:
                tree.links.new(out, principled.inputs[SLOTS.get(out.type, "Base Color")])
                tree.links.new(out, principled.inputs["Emission Strength"])
                tree.links.new(out, output.inputs["Displacement"])
            count += 1
            cube(f"{count}", made).location.x = 2 * count
    return save(folder / "every_node.blend")


def every_node_fed_by_noise(folder: Path) -> Path:
    return every_node(folder, feed=lambda tree: tree.nodes.new("ShaderNodeTexNoise"))


def every_node_fed_by_an_image(folder: Path) -> Path:
    def feed(tree: Any) -> Any:
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image = bpy.data.images["every.png"]
        return node

    return every_node(folder, feed=feed)


def every_node_fed_by_fresnel(folder: Path) -> Path:
    return every_node(folder, feed=lambda tree: tree.nodes.new("ShaderNodeFresnel"))


def every_setting(folder: Path) -> Path:
    """Every choice of every node's menus, with a procedural first number."""
    plain()
    common = {prop.identifier for prop in bpy.types.Node.bl_rna.properties}
    for name in node_classes():
        if not name.startswith("ShaderNode") or name.startswith("ShaderNodeOutput"):
            continue
        kind = getattr(bpy.types, name).bl_rna
        menus = [prop for prop in kind.properties if prop.type == "ENUM" and prop.identifier not in common]
        for menu in menus:
            for choice in [item.identifier for item in menu.enum_items]:
                made, tree, principled = tree_of(f"{name}.{menu.identifier}.{choice}")
                node = tree.nodes.new(name)
                try:
                    setattr(node, menu.identifier, choice)
                except (TypeError, AttributeError):
                    continue  # not for this choice of others
                out = next((socket for socket in node.outputs if socket.enabled), None)
                if out is None:
                    continue
                number = next((socket for socket in node.inputs if socket.type == "VALUE" and socket.enabled), None)
                if number is not None:
                    tree.links.new(tree.nodes.new("ShaderNodeTexNoise").outputs[0], number)
                if out.type == "SHADER":
                    tree.links.new(out, output_of(tree).inputs["Volume" if "Volume" in name else "Surface"])
                else:
                    tree.links.new(out, principled.inputs["Base Color"])
                cube(made.name, made)
    return save(folder / "every_setting.blend")


def extreme_numbers(folder: Path) -> Path:
    """Every shader with all its inputs negative, 0, very large, and too large."""
    plain()
    shaders = [name for name in node_classes() if getattr(bpy.types, name).__name__ in SHADERS or "Bsdf" in name]
    for number in (-1, -5, 0, 1e14, 1e20):
        for name in shaders:
            made, tree, _ = tree_of(f"{name} {number:g}")
            node = tree.nodes.new(name)
            for socket in node.inputs:
                size = {"VALUE": 0, "RGBA": 4, "VECTOR": 3}.get(socket.type)
                if size is not None and socket.name not in {"Normal", "Tangent", "Coat Normal"}:
                    socket.default_value = (number,) * size if size else number
            tree.links.new(node.outputs[0], output_of(tree).inputs["Volume" if "Volume" in name else "Surface"])
            cube(made.name, made)
    return save(folder / "extreme_numbers.blend")


SHADERS = {
    *("ShaderNodeSubsurfaceScattering", "ShaderNodeEmission", "ShaderNodeBackground", "ShaderNodeHoldout"),
    *("ShaderNodeVolumeAbsorption", "ShaderNodeVolumeScatter", "ShaderNodeVolumePrincipled"),
    *("ShaderNodeVolumeCoefficients", "ShaderNodeEeveeSpecular"),
}


def one_dimensional(folder: Path) -> Path:
    """Procedural textures over one number, which have no Vector input."""
    plain()
    for kind in ("Noise", "Voronoi", "WhiteNoise"):
        made, tree, principled = tree_of(kind)
        node = tree.nodes.new(f"ShaderNodeTex{kind}")
        setattr(node, "voronoi_dimensions" if kind == "Voronoi" else "noise_dimensions", "1D")
        tree.links.new(tree.nodes.new("ShaderNodeTexCoord").outputs["Object"], node.inputs["W"])
        tree.links.new(node.outputs["Color"], principled.inputs["Base Color"])
        cube(kind, made)
    return save(folder / "one_dimensional.blend")


def only_eevee(folder: Path) -> Path:
    """Shader to RGB into a ramp into an Emission, as toon shaders do; the Specular BSDF."""
    plain()
    made, tree, principled = tree_of("toon")
    diffuse, emission = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeEmission")
    to_rgb, ramp = tree.nodes.new("ShaderNodeShaderToRGB"), tree.nodes.new("ShaderNodeValToRGB")
    tree.links.new(diffuse.outputs[0], to_rgb.inputs[0])
    tree.links.new(to_rgb.outputs[0], ramp.inputs[0])
    tree.links.new(ramp.outputs[0], emission.inputs[0])
    tree.links.new(emission.outputs[0], output_of(tree).inputs["Surface"])
    cube("toon", made)
    made, tree, principled = tree_of("plain toon")
    to_rgb = tree.nodes.new("ShaderNodeShaderToRGB")
    tree.links.new(to_rgb.outputs[0], principled.inputs["Base Color"])
    principled.inputs["Base Color"].default_value = (0.5, 0.2, 0.1, 1)
    cube("plain toon", made)
    made, tree, principled = tree_of("specular")
    tree.links.new(tree.nodes.new("ShaderNodeEeveeSpecular").outputs[0], output_of(tree).inputs["Surface"])
    cube("specular", made)
    return save(folder / "only_eevee.blend")


def scripted_shader(folder: Path) -> Path:
    """A Script node with a text that has never been compiled."""
    plain()
    made, tree, principled = tree_of("osl")
    text = bpy.data.texts.new("shader.osl")
    text.write("shader x(output color c = 0) { c = color(1, 0, 0); }")
    node = tree.nodes.new("ShaderNodeScript")
    node.script = text
    node.outputs.new("NodeSocketColor", "c")
    principled.inputs["Base Color"].default_value = (0.5, 0.2, 0.1, 1)
    tree.links.new(node.outputs[0], principled.inputs["Base Color"])
    cube("thing", made)
    return save(folder / "scripted_shader.blend")


def many_outputs(folder: Path) -> Path:
    """Outputs for EEVEE, for Cycles and for all; the active one is EEVEE's; one in a group; an AOV."""
    plain()
    made, tree, _ = tree_of("targets")
    for target, colour in (("EEVEE", (1, 0, 0, 1)), ("CYCLES", (0, 1, 0, 1)), ("ALL", (0, 0, 1, 1))):
        output, emission = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeEmission")
        output.target = target
        emission.inputs[0].default_value = colour
        tree.links.new(emission.outputs[0], output.inputs["Surface"])
        output.is_active_output = target == "EEVEE"
    cube("targets", made)
    group, _, _ = group_of("holder", {}, {})
    output, emission = group.nodes.new("ShaderNodeOutputMaterial"), group.nodes.new("ShaderNodeEmission")
    group.links.new(emission.outputs[0], output.inputs["Surface"])
    made, tree, _ = tree_of("inside")
    tree.nodes.clear()
    use(tree, group)
    cube("inside", made)
    made, tree, principled = tree_of("aov")
    tree.links.new(principled.outputs[0], tree.nodes.new("ShaderNodeOutputAOV").inputs[0])
    cube("aov", made)
    return save(folder / "many_outputs.blend")


def edge_cases(folder: Path) -> Path:
    """A ramp with one stop, Mapping of scale 0, a UV map of no name that exists, muted groups and mixes."""
    plain()
    image = png(folder / "edge.png")
    for name in ("ramp", "mapping", "texture mapping", "uv map", "muted mix", "muted group", "no uv", "curves"):
        made, tree, principled = tree_of(name)
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image = image
        out = node.outputs["Color"]
        if name == "ramp":
            ramp = tree.nodes.new("ShaderNodeValToRGB")
            ramp.color_ramp.elements.remove(ramp.color_ramp.elements[0])
            tree.links.new(out, ramp.inputs[0])
            out = ramp.outputs[0]
        elif name.endswith("mapping"):
            mapping, uv = tree.nodes.new("ShaderNodeMapping"), tree.nodes.new("ShaderNodeTexCoord")
            mapping.vector_type = "POINT" if name == "mapping" else "TEXTURE"
            mapping.inputs["Scale"].default_value = (0, 0, 0)
            tree.links.new(uv.outputs["UV"], mapping.inputs["Vector"])
            tree.links.new(mapping.outputs[0], node.inputs["Vector"])
        elif name == "uv map":
            uv = tree.nodes.new("ShaderNodeUVMap")
            uv.uv_map = "nowhere"
            tree.links.new(uv.outputs[0], node.inputs["Vector"])
        elif name == "muted mix":
            mix = tree.nodes.new("ShaderNodeMixShader")
            mix.mute = True
            tree.links.new(principled.outputs[0], mix.inputs[2])
            tree.links.new(mix.outputs[0], output_of(tree).inputs["Surface"])
        elif name == "muted group":
            group, _, _ = group_of("passing", {"In": "NodeSocketColor"}, {"Out": "NodeSocketColor"})
            use_ = use(tree, group)
            use_.mute = True
            tree.links.new(out, use_.inputs[0])
            out = use_.outputs[0]
        elif name == "curves":
            curves = tree.nodes.new("ShaderNodeRGBCurve")
            tree.links.new(out, curves.inputs["Color"])
            out = curves.outputs[0]
        tree.links.new(out, principled.inputs["Base Color"])
        data = cube(name, made).data
        if name == "no uv":
            data.uv_layers.remove(data.uv_layers[0])
    return save(folder / "edge_cases.blend")


def displaced(folder: Path) -> Path:
    """True displacement by an image, by noise, by a Vector Displacement, by a number; on a material that is glass."""
    plain()
    image = png(folder / "height.png")
    for kind in ("image", "noise", "vector", "number", "colour"):
        made, tree, _ = tree_of(kind)
        made.displacement_method = "BOTH" if kind == "image" else "DISPLACEMENT"
        output = output_of(tree)
        source = tree.nodes.new("ShaderNodeTexImage" if kind == "image" else "ShaderNodeTexNoise")
        if kind == "image":
            source.image = image
        if kind == "colour":
            tree.links.new(source.outputs[0], output.inputs["Displacement"])
        else:
            node = tree.nodes.new("ShaderNodeVectorDisplacement" if kind == "vector" else "ShaderNodeDisplacement")
            if kind != "number":
                tree.links.new(source.outputs[0], node.inputs[0])
            tree.links.new(node.outputs[0], output.inputs["Displacement"])
        cube(kind, made)
    return save(folder / "displaced.blend")


def many_slots(folder: Path) -> Path:
    """300 slots, a face each."""
    plain()
    data = bpy.data.meshes.new("many")
    vertices, faces = [], []
    for number in range(300):
        vertices += [(number, 0, 0), (number + 0.9, 0, 0), (number, 1, 0)]
        faces.append((3 * number, 3 * number + 1, 3 * number + 2))
        data.materials.append(material(f"slot {number}", colour=(number / 300, 0.5, 0.5)))
    data.from_pydata(vertices, [], faces)
    data.polygons.foreach_set("material_index", list(range(300)))
    link("many", data)
    return save(folder / "many_slots.blend")


def zones(folder: Path) -> Path:
    """Repeat zone, closure, bundle and Menu Switch of Blender 5."""
    plain()
    made, tree, principled = tree_of("repeat")
    first, last = tree.nodes.new("GeometryNodeRepeatInput"), tree.nodes.new("GeometryNodeRepeatOutput")
    first.pair_with_output(last)
    last.repeat_items.clear()
    last.repeat_items.new("RGBA", "Colour")
    first.inputs["Iterations"].default_value = 3
    tree.links.new(first.outputs["Colour"], last.inputs["Colour"])
    first.inputs["Colour"].default_value = (0.1, 0.2, 0.8, 1)
    tree.links.new(last.outputs["Colour"], principled.inputs["Base Color"])
    cube("repeat", made)
    made, tree, principled = tree_of("repeat shader")
    first, last = tree.nodes.new("GeometryNodeRepeatInput"), tree.nodes.new("GeometryNodeRepeatOutput")
    first.pair_with_output(last)
    last.repeat_items.clear()
    last.repeat_items.new("SHADER", "Shader")
    tree.links.new(principled.outputs[0], first.inputs["Shader"])
    tree.links.new(first.outputs["Shader"], last.inputs["Shader"])
    tree.links.new(last.outputs["Shader"], output_of(tree).inputs["Surface"])
    cube("repeat shader", made)
    made, tree, principled = tree_of("menu")
    switch = tree.nodes.new("GeometryNodeMenuSwitch")
    switch.data_type = "RGBA"
    tree.links.new(switch.outputs[0], principled.inputs["Base Color"])
    cube("menu", made)
    made, tree, principled = tree_of("menu shader")
    switch = tree.nodes.new("GeometryNodeMenuSwitch")
    switch.data_type = "SHADER"
    tree.links.new(principled.outputs[0], switch.inputs[1])
    tree.links.new(switch.outputs[0], output_of(tree).inputs["Surface"])
    cube("menu shader", made)
    made, tree, principled = tree_of("bundle")
    combine, separate = tree.nodes.new("NodeCombineBundle"), tree.nodes.new("NodeSeparateBundle")
    for node in (combine, separate):
        node.bundle_items.new("RGBA", "Colour")
    combine.inputs[0].default_value = (0.7, 0.3, 0.1, 1)
    tree.links.new(combine.outputs[0], separate.inputs[0])
    tree.links.new(separate.outputs[0], principled.inputs["Base Color"])
    cube("bundle", made)
    made, tree, principled = tree_of("closure")
    start, end = tree.nodes.new("NodeClosureInput"), tree.nodes.new("NodeClosureOutput")
    start.pair_with_output(end)
    end.output_items.new("RGBA", "Colour")
    call = tree.nodes.new("NodeEvaluateClosure")
    call.output_items.new("RGBA", "Colour")
    end.inputs[0].default_value = (0.7, 0.3, 0.1, 1)
    tree.links.new(end.outputs[0], call.inputs[0])
    tree.links.new(call.outputs[0], principled.inputs["Base Color"])
    cube("closure", made)
    return save(folder / "zones.blend")


def volumes(folder: Path) -> Path:
    """Volumes that glow, vary, take a grid's density, mix with themselves, and are no volumes at all."""
    plain()
    for kind in ("VolumePrincipled", "VolumeScatter", "VolumeAbsorption", "VolumeCoefficients", "BsdfDiffuse"):
        made, tree, _ = tree_of(kind)
        node, output = tree.nodes.new(f"ShaderNode{kind}"), output_of(tree)
        tree.links.new(node.outputs[0], output.inputs["Volume"])
        density = next((socket for socket in node.inputs if socket.name == "Density"), None)
        if density is not None:
            source = "ShaderNodeVolumeInfo" if kind == "VolumePrincipled" else "ShaderNodeTexNoise"
            tree.links.new(tree.nodes.new(source).outputs[0], density)
        if kind == "VolumePrincipled":
            node.inputs["Emission Strength"].default_value = 3
        cube(kind, made)
    made, tree, _ = tree_of("emitting volume")
    tree.links.new(tree.nodes.new("ShaderNodeEmission").outputs[0], output_of(tree).inputs["Volume"])
    cube("emitting", made)
    return save(folder / "volumes.blend")


# ---------------------------------------------------------------- lamps and worlds


def odd_lamps(folder: Path) -> Path:
    """Area of size 0, spot of 180 degrees, portal, no shadow, negative energy, sun with nodes, in an instance."""
    scene = plain()
    cube()
    for number, kind in enumerate(("POINT", "SPOT", "AREA", "SUN")):
        for which in ("plain", "negative", "zero", "nodes", "portal", "linked", "instanced"):
            lamp = bpy.data.lights.new(f"{kind} {which}", kind)
            lamp.energy = -5 if which == "negative" else 5
            lamp.cycles.max_bounces = 0 if which == "instanced" else 1024
            if which == "zero":
                for name in ("size", "size_y", "shadow_soft_size", "angle", "spread", "spot_blend"):
                    if hasattr(lamp, name):
                        setattr(lamp, name, 0)
                lamp.use_shadow = False
            if kind == "SPOT":
                lamp.spot_size = 3.14159265
            if which == "portal" and kind == "AREA":
                lamp.cycles.is_portal = True
            if which == "nodes":
                lamp.use_nodes = True
                tree = lamp.node_tree
                emission = next(node for node in tree.nodes if node.type == "EMISSION")
                noise = tree.nodes.new("ShaderNodeTexNoise")
                tree.links.new(noise.outputs[0], emission.inputs["Color"])
                falloff = tree.nodes.new("ShaderNodeLightFalloff")
                tree.links.new(noise.outputs[0], falloff.inputs["Strength"])
                tree.links.new(falloff.outputs["Constant"], emission.inputs["Strength"])
            obj = link(lamp.name, lamp)
            obj.location = (number, 0, 4)
            if which == "linked":
                obj.light_linking.receiver_collection = bpy.data.collections.new("receivers")
            if which == "instanced":
                holder = bpy.data.collections.new(f"holder {kind}")
                holder.objects.link(obj)
                scene.collection.objects.unlink(obj)
                place = link(f"place {kind}", None)
                place.instance_type, place.instance_collection = "COLLECTION", holder
    return save(folder / "odd_lamps.blend")


def ies_lamp(folder: Path) -> Path:
    """An IES texture whose file is gone, and one whose text is empty."""
    plain()
    cube()
    for mode in ("EXTERNAL", "INTERNAL"):
        lamp = bpy.data.lights.new(mode, "POINT")
        lamp.use_nodes = True
        tree = lamp.node_tree
        emission = next(node for node in tree.nodes if node.type == "EMISSION")
        ies = tree.nodes.new("ShaderNodeTexIES")
        ies.mode = mode
        if mode == "EXTERNAL":
            ies.filepath = "//gone.ies"
        tree.links.new(ies.outputs[0], emission.inputs["Strength"])
        link(mode, lamp).location = (0, 0, 3)
    return save(folder / "ies_lamp.blend")


def with_world(name: str, make: Callable[[Any, Any, Path], None]) -> Builder:
    """A builder of a scene whose world ``make(tree, its Background, folder)`` sets up."""

    def build(folder: Path) -> Path:
        scene = plain()
        cube()
        scene.world = bpy.data.worlds.new(name)
        tree = scene.world.node_tree
        make(tree, tree.nodes["Background"], folder)
        return save(folder / f"{name}.blend")

    return build


def _mirror_ball(tree: Any, background: Any, folder: Path) -> None:
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image, node.projection = png(folder / "ball.png"), "MIRROR_BALL"
    tree.links.new(node.outputs[0], background.inputs["Color"])


def _missing_hdri(tree: Any, background: Any, folder: Path) -> None:
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = png(folder / "gone.png")
    (folder / "gone.png").unlink()
    tree.links.new(node.outputs[0], background.inputs["Color"])


def _no_image(tree: Any, background: Any, folder: Path) -> None:
    del folder
    tree.links.new(tree.nodes.new("ShaderNodeTexEnvironment").outputs[0], background.inputs["Color"])


def _two_outputs(tree: Any, background: Any, folder: Path) -> None:
    del folder
    other = tree.nodes.new("ShaderNodeOutputWorld")
    red = tree.nodes.new("ShaderNodeBackground")
    red.inputs["Color"].default_value = (1, 0, 0, 1)
    tree.links.new(red.outputs[0], other.inputs["Surface"])
    other.is_active_output = True


def _fog(tree: Any, background: Any, folder: Path) -> None:
    del folder
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    fog = tree.nodes.new("ShaderNodeVolumeScatter")
    tree.links.new(fog.outputs[0], output_of(tree).inputs["Volume"])


def _sky(tree: Any, background: Any, folder: Path) -> None:
    del folder
    sky = tree.nodes.new("ShaderNodeTexSky")
    tree.links.new(sky.outputs[0], background.inputs["Color"])


def _nothing_linked(tree: Any, background: Any, folder: Path) -> None:
    del background, folder
    tree.links.clear()


def _no_output(tree: Any, background: Any, folder: Path) -> None:
    del background, folder
    tree.nodes.clear()


def _unseen(tree: Any, background: Any, folder: Path) -> None:
    del tree, folder
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    bpy.context.scene.world.cycles_visibility.diffuse = False


def _no_profile(tree: Any, background: Any, folder: Path) -> None:
    del folder
    ies = tree.nodes.new("ShaderNodeTexIES")
    tree.links.new(ies.outputs[0], background.inputs["Color"])
    tree.links.new(ies.outputs[0], background.inputs["Strength"])


def _surface_shader(tree: Any, background: Any, folder: Path) -> None:
    """A Principled BSDF as the world's shader, and a Light Path and camera data in it."""
    del background, folder
    principled = tree.nodes.new("ShaderNodeBsdfPrincipled")
    tree.links.new(tree.nodes.new("ShaderNodeCameraData").outputs[0], principled.inputs["Base Color"])
    tree.links.new(tree.nodes.new("ShaderNodeLightPath").outputs[0], principled.inputs["Emission Strength"])
    tree.links.new(principled.outputs[0], output_of(tree).inputs["Surface"])


CONVERTS: dict[str, Case] = {
    "foreign output": (foreign_output, ("node 'ForeignOutput'",)),
    "foreign shader": (foreign_shader, ("node 'ForeignBSDF'", "its links are dropped")),
    "foreign texture": (foreign_texture, ("node 'ForeignTexture'", "material 'NodeReroute'")),
    "foreign in group": (foreign_in_group, ("node 'ForeignInner' of 'holder'", "material 'before'")),
    "foreign custom group": (foreign_custom_group, ("node 'ForeignGroup'",)),
    "foreign world": (foreign_world, ("node 'ForeignSky' of 'foreign world'",)),
    "foreign world output": (foreign_world_output, ("node 'ForeignEnv' of 'foreign env'",)),
    "foreign lamp": (foreign_lamp, ("node 'ForeignLamp' of 'strength'", "of 'output'")),
    "foreign geometry": (foreign_geometry, ("node 'ForeignGeometry' of 'between'",)),
    "foreign sockets": (foreign_sockets, ("node 'box'", "node 'box.001'")),
    "deep chain": (deep_chain, ()),
    "diamonds": (diamonds, ()),
    "typed groups": (typed_groups, ()),
    "typed world": (typed_world, ()),
    "only eevee": (only_eevee, ("node 'Shader to RGB'", "material 'toon'")),
    "scripted shader": (scripted_shader, ("node 'Script'",)),
    "many outputs": (many_outputs, ()),
    "edge cases": (edge_cases, ("UV layer 'nowhere'",)),
    "displaced": (displaced, ("true displacement", "material 'vector'")),
    "many slots": (many_slots, ()),
    "extreme numbers": (extreme_numbers, ("beyond 1e+15", "ShaderNodeBackground 1e+20")),
    "one-dimensional": (one_dimensional, ()),
    "zones": (zones, ("material 'repeat shader'", "material 'menu shader'")),
    "volumes": (volumes, ("volume emission", "Diffuse BSDF node as a volume")),
    "odd lamps": (odd_lamps, ("its area is 0", "light linking", "portal", "constant light falloff", "max bounces")),
    "ies lamp": (ies_lamp, ("gone.ies",)),
    "mirror ball": (with_world("mirror ball", _mirror_ball), ("environment image",)),
    "missing hdri": (with_world("missing hdri", _missing_hdri), ("image 'gone.png'",)),
    "no hdri": (with_world("no hdri", _no_image), ("no image chosen",)),
    "world outputs": (with_world("world outputs", _two_outputs), ()),
    "fog": (with_world("fog", _fog), ("world 'fog' volume",)),
    "world of no profile": (with_world("world of no profile", _no_profile), ("no light profile",)),
    "world unseen": (with_world("world unseen", _unseen), ("ray visibility", "diffuse rays")),
    "sky": (with_world("sky", _sky), ()),
    "world unlinked": (with_world("world unlinked", _nothing_linked), ("no light",)),
    "world without output": (with_world("world without output", _no_output), ("no light",)),
    "world of a surface shader": (with_world("world of a surface shader", _surface_shader), ()),
}
"""Name -> builder, and what warnings and findings must say."""

SWEEPS: dict[str, Case] = {
    "every node": (every_node, ()),
    "every setting": (every_setting, ()),
    "every node fed by noise": (every_node_fed_by_noise, ()),
    "every node fed by an image": (every_node_fed_by_an_image, ()),
    "every node fed by Fresnel": (every_node_fed_by_fresnel, ()),
}
"""Hundreds of materials each: slow."""
