"""One small still life, and what may happen to it: each builder leaves a .blend whose picture is known in advance.

All run in one bpy process, each from an empty file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

NAN, INF = float("nan"), float("inf")
EYE, AIM = (2.2, -2.6, 1.8), (0.0, 0.0, 0.3)

QUAD = ([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2), (0, 2, 3)])
BLOCK_VERTICES = [(x, y, z) for x in (-0.3, 0.3) for y in (-0.3, 0.3) for z in (0, 0.6)]
BLOCK = (
    BLOCK_VERTICES,
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
     (1, 5, 7), (1, 7, 3)],
)  # fmt: skip


def mesh(name: str, data: tuple[Any, Any], colour: tuple[float, float, float] | None = (0.6, 0.6, 0.6)) -> Any:
    made = bpy.data.meshes.new(name)
    made.from_pydata(*[[*data[0]], [], [*data[1]]])
    made.uv_layers.new(name="UVMap")
    if colour is not None:
        made.materials.append(paint(name, Color=(*colour, 1)))
    obj = bpy.data.objects.new(name, made)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def paint(name: str, kind: str = "ShaderNodeBsdfDiffuse", **inputs: Any) -> Any:
    """A material of one shader node."""
    made = bpy.data.materials.new(name)
    tree = made.node_tree
    tree.nodes.clear()
    shader, output = tree.nodes.new(kind), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    for key, value in inputs.items():
        shader.inputs[key].default_value = value
    return made


def still(*, lamp: float = 60.0, sky: float = 0.4) -> dict[str, Any]:
    """A floor, a red block, a blue one, an area lamp, a grey sky and a camera; the objects by name."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    red, blue = mesh("red", BLOCK, (0.7, 0.1, 0.1)), mesh("blue", BLOCK, (0.1, 0.2, 0.7))
    red.location, blue.location = (-0.45, 0.1, 0), (0.45, 0.3, 0)
    found = {"floor": mesh("floor", QUAD), "red": red, "blue": blue}
    light = bpy.data.lights.new("lamp", "AREA")
    light.energy, light.size = lamp, 1.0
    found["lamp"] = bpy.data.objects.new("lamp", light)
    found["lamp"].location = (0.5, -0.5, 2.5)
    camera = bpy.data.cameras.new("camera")
    camera.lens = 40
    found["camera"] = bpy.data.objects.new("camera", camera)
    found["camera"].matrix_world = looking(EYE, AIM)
    for name in ("lamp", "camera"):
        scene.collection.objects.link(found[name])
    scene.camera = found["camera"]
    scene.render.resolution_x = scene.render.resolution_y = 24
    scene.world = bpy.data.worlds.new("sky")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = sky
    return found


def looking(eye: tuple[float, ...], aim: tuple[float, ...]) -> Matrix:
    turn = (Vector(aim) - Vector(eye)).to_track_quat("-Z", "Y")
    return Matrix.Translation(Vector(eye)) @ turn.to_matrix().to_4x4()


def moved(matrix: Matrix, scale: float = 1.0) -> dict[str, Any]:
    """The still life, all of it moved by ``matrix``; a lamp ``scale`` times as far gets scale² times the power."""
    found = still()
    bpy.context.view_layer.update()
    for obj in found.values():
        obj.matrix_world = matrix @ obj.matrix_world
    found["lamp"].data.energy *= scale**2
    found["camera"].scale = (1, 1, 1)
    found["camera"].data.clip_end = 1e9
    return found


def renamed() -> None:
    for number, obj in enumerate(reversed(still().values())):
        obj.name = f"{number}é {chr(122 - number)} ../x"
        obj.data.name = obj.name


def split() -> None:
    """The red block as twelve objects of one triangle each."""
    found = still()
    red = found["red"]
    for number, triangle in enumerate(BLOCK[1]):
        part = mesh(f"part{number}", ([BLOCK_VERTICES[i] for i in triangle], [(0, 1, 2)]), None)
        part.data.materials.append(red.data.materials[0])
        part.location = red.location
    bpy.data.objects.remove(red)


def mirrored() -> None:
    """Negative scales: the blocks are symmetric, so they look the same; the floor is turned inside out."""
    found = still()
    for name in ("red", "blue"):
        found[name].scale = (-1, 1, 1)
    found["floor"].scale = (-1, -1, -1)


def stretched() -> None:
    """The red block's own data squeezed, its scale the inverse."""
    red = still()["red"]
    for vertex in red.data.vertices:
        vertex.co = (vertex.co[0] * 10, vertex.co[1] * 0.1, vertex.co[2] * 1000)
    red.scale = (0.1, 10, 0.001)


def flipped() -> None:
    """Winding and normals of everything the wrong way round."""
    for obj in still().values():
        if obj.type == "MESH":
            obj.data.flip_normals()


def no_normals() -> None:
    """Custom normals of length 0."""
    data = still()["red"].data
    data.normals_split_custom_set([(0, 0, 0)] * len(data.loops))


def doubled() -> None:
    """Every triangle of the red block twice, and triangles without area."""
    found = still()
    flat = [(0, 0, 1), (2, 2, 2), (4, 5, 5)]
    twice = mesh("twice", (BLOCK_VERTICES, [*BLOCK[1], *BLOCK[1], *flat]), None)
    twice.data.materials.append(found["red"].data.materials[0])
    twice.location = found["red"].location
    bpy.data.objects.remove(found["red"])


def holed() -> None:
    """NaN and infinite corners on triangles beside the good ones."""
    found = still()
    bad = [(NAN, 0, 0), (INF, 0, 1), (0, 0, NAN)]
    broken = mesh("broken", ([*BLOCK_VERTICES, *bad], [*BLOCK[1], (0, 1, 8), (1, 2, 9), (8, 9, 10)]), None)
    broken.data.materials.append(found["red"].data.materials[0])
    broken.location = found["red"].location
    bpy.data.objects.remove(found["red"])


def non_manifold() -> None:
    """Fins: further triangles inside the red block that share its edges, invisible from outside."""
    found = still()
    fins = [(0, 1, 7), (0, 3, 7), (1, 3, 6), (2, 5, 3)]
    made = mesh("finned", (BLOCK_VERTICES, [*BLOCK[1], *fins]), None)
    made.data.materials.append(found["red"].data.materials[0])
    made.location = found["red"].location
    bpy.data.objects.remove(found["red"])


def with_uvs(values: Callable[[int], tuple[float, float]] | None) -> None:
    """The red block's UV layer set corner by corner, or removed."""
    data = still()["red"].data
    if values is None:
        data.uv_layers.remove(data.uv_layers[0])
        return
    for corner, item in enumerate(data.uv_layers[0].data):
        item.uv = values(corner)


def dense() -> None:
    """A sheet of 20,000 triangles that covers less than a pixel, behind the blocks' top edge."""
    still()
    side = 101
    grid = np.stack(np.meshgrid(*[np.linspace(0, 0.002, side)] * 2), -1).reshape(-1, 2)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    lower = np.stack([corner, corner + 1, corner + side], 1)
    upper = np.stack([corner + 1, corner + side + 1, corner + side], 1)
    speck = mesh("speck", (np.c_[grid, np.zeros(len(grid))].tolist(), np.r_[lower, upper].tolist()))
    speck.location = (0.0, -0.8, 0.001)


def coplanar() -> None:
    """The floor twice, in the same place and of the same paint."""
    found = still()
    again = mesh("again", QUAD, None)
    again.data.materials.append(found["floor"].data.materials[0])


def clipped() -> None:
    """Near and far planes at the ends of what Blender takes."""
    camera = still()["camera"].data
    camera.clip_start, camera.clip_end = 1e-6, 1e30


SAME: dict[str, Callable[[], Any]] = {
    "as it is": still,
    "again": still,
    "times 1000": lambda: moved(Matrix.Scale(1000, 4), 1000),
    "times 1e-6": lambda: moved(Matrix.Scale(1e-6, 4), 1e-6),
    "times 1e6": lambda: moved(Matrix.Scale(1e6, 4), 1e6),
    "turned": lambda: moved(Matrix.Rotation(1.1, 4, "Z")),
    "1e5 away": lambda: moved(Matrix.Translation((1e5, -1e5, 0))),
    "renamed": renamed,
    "split into objects": split,
    "negative scale": mirrored,
    "non-uniform scale": stretched,
    "flipped normals": flipped,
    "zero normals": no_normals,
    "duplicate and flat triangles": doubled,
    "NaN corners": holed,
    "non-manifold": non_manifold,
    "no UVs": lambda: with_uvs(None),
    "NaN UVs": lambda: with_uvs(lambda i: (NAN, INF) if i % 2 else (0.5, 0.5)),
    "UVs outside": lambda: with_uvs(lambda i: (1e6 * i, -1e6 * i)),
    "overlapping UVs": lambda: with_uvs(lambda i: (0.25, 0.75)),
    "mirrored UVs": lambda: with_uvs(lambda i: (-(i % 3) * 0.3, (i % 2) * 0.3)),
    "20,000 triangles in a pixel": dense,
    "coplanar surfaces": coplanar,
    "near and far extremes": clipped,
}
"""Name -> builder of a scene whose picture is that of the first one."""


def black() -> None:
    still(lamp=0.0, sky=0.0)
    mesh("ember", ([(0, 0, -9), (1, 0, -9), (0, 1, -9)], [(0, 1, 2)]), None).data.materials.append(
        paint("ember", "ShaderNodeEmission", Strength=1e-6)
    )


def hot_sun() -> None:
    found = still(sky=0.0)
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy = 1e6
    found["lamp"].data = sun


def tiny_lamp() -> None:
    lamp = still(sky=0.0)["lamp"]
    lamp.scale, lamp.data.energy = (1e-4, 1e-4, 1e-4), 1e3


def all_of(kind: str, **inputs: Any) -> None:
    made = None
    for obj in still().values():
        if obj.type == "MESH":
            made = made or paint("all", kind, **inputs)
            obj.data.materials[0] = made


def camera_at(eye: tuple[float, ...], aim: tuple[float, ...]) -> None:
    still()["camera"].matrix_world = looking(eye, aim)


def one_triangle() -> None:
    found = still()
    for name in ("red", "blue", "floor"):
        bpy.data.objects.remove(found[name])
    mesh("only", ([(0, 0, 0), (1, 0, 0.3), (0, 1, 0.3)], [(0, 1, 2)]))


OWN: dict[str, tuple[Callable[[], Any], Callable[[np.ndarray], bool]]] = {
    "black": (black, lambda p: p[..., :3].max() < 1e-3 and p[..., 3].max() > 0.9),
    "sun of 1e6": (hot_sun, lambda p: p[..., :3].max() > 1e4),
    "tiny emitter": (tiny_lamp, lambda p: 0.01 < p[..., :3].mean() < 100),
    "all mirrors": (lambda: all_of("ShaderNodeBsdfGlossy", Roughness=0.0), lambda p: p[..., :3].max() > 0.1),
    "all glass": (lambda: all_of("ShaderNodeBsdfGlass", Roughness=0.0), lambda p: p[..., :3].max() > 0.1),
    "camera inside a mesh": (lambda: camera_at((-0.45, 0.1, 0.3), (0.0, 0.1, 0.3)), lambda p: p[..., 3].min() > 0.9),
    "camera on a surface": (lambda: camera_at((-0.5, -0.5, 0.0), (0.5, 0.5, 0.0)), lambda p: True),
    "camera beside an emitter": (lambda: camera_at((3, -0.5, 2.5), (0.5, -0.5, 2.5)), lambda p: True),
    "camera that looks at nothing": (lambda: camera_at(EYE, (9, -9, 9)), lambda p: p[..., 3].max() == 0),
    "one triangle": (one_triangle, lambda p: 0 < (p[..., 3] > 0).mean() < 0.6),
}
"""Name -> builder, and what its picture [H, W, 4] must be beside finite."""


def save(builder: Callable[[], Any], path: Path) -> Path:
    builder()
    bpy.ops.wm.save_as_mainfile(filepath=str(path), check_existing=False)
    return path
