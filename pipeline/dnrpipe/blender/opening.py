"""Open a scene file in this process: .blend, or a mesh format through Blender's importers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import bpy

from dnrpipe.errors import UserError

BLEND_MAGIC = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")  # plain, zstd, gzip
GEOMETRY_TYPES = {"MESH", "CURVE", "SURFACE", "META", "FONT"}
SHAPELESS_IMAGES = {"GENERATED", "VIEWER"}  # sources without a file


def _import_gltf(path: str) -> None:
    import addon_utils

    addon_utils.enable("io_scene_gltf2")
    bpy.ops.import_scene.gltf(filepath=path)


IMPORTERS: dict[str, Callable[[str], object]] = {
    ".obj": lambda path: bpy.ops.wm.obj_import(filepath=path),
    ".gltf": _import_gltf,
    ".glb": _import_gltf,
    ".fbx": lambda path: bpy.ops.wm.fbx_import(filepath=path),
    ".ply": lambda path: bpy.ops.wm.ply_import(filepath=path),
    ".stl": lambda path: bpy.ops.wm.stl_import(filepath=path),
}


def open_scene(path: str | Path) -> list[str]:
    """Make ``path`` the open file of this process and return warnings for the user.

    Scripts embedded in the file (text blocks, Python drivers) are never executed. Mesh formats are
    imported into an empty scene; they bring no light.

    Raises:
        UserError: no such file, unknown format, damaged file, or no renderable mesh.
    """
    path = Path(path).resolve()
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a .blend file in it")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix in IMPORTERS:
        return _import(path, suffix)
    if suffix != ".blend":
        known = ", ".join([".blend", *IMPORTERS])
        raise UserError(f"{path}: cannot read '{suffix or path.name}' files; known are {known}")
    return open_blend(path)


def open_blend(path: Path, *, require_geometry: bool = True) -> list[str]:
    """Open a .blend file. See :func:`open_scene`."""
    with path.open("rb") as file:
        head = file.read(7)
    if not head:
        raise UserError(f"{path}: is empty (0 bytes)")
    if not head.startswith(BLEND_MAGIC):
        raise UserError(f"{path}: is not a Blender file (starts with {head[:7]!r}); save it from Blender again")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        raise UserError(f"{path}: damaged or truncated .blend; save it from Blender again ({reason})") from None
    warnings = []
    if bpy.data.version[:2] > bpy.app.version[:2]:
        saved = ".".join(map(str, bpy.data.version[:2]))
        here = ".".join(map(str, bpy.app.version[:2]))
        warnings.append(f"saved by Blender {saved}, read by {here}: some data may be lost; compare the picture")
    warnings += missing_files()
    if require_geometry:
        require_renderable(path)
    return warnings


def _import(path: Path, suffix: str) -> list[str]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    try:
        IMPORTERS[suffix](str(path))
    except RuntimeError as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        raise UserError(f"{path}: cannot be imported as {suffix[1:].upper()} ({reason})") from None
    require_renderable(path)
    return [*_neutral_light(path), *missing_files()]


def _neutral_light(path: Path) -> list[str]:
    """Mesh formats bring no world and often no lamp: a white world of strength 1 then, said to the user."""
    scene = bpy.context.scene
    if scene.world is not None or any(o.type == "LIGHT" for o in scene.objects):
        return []
    world = bpy.data.worlds.new("neutral")
    world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs["Strength"].default_value = 1.0
    scene.world = world
    return [f"{path.name} brings no light: a white world of strength 1 lights it"]


def external_files(path: Path) -> list[Path]:
    """Files beside ``path`` that the open scene was read from: images, libraries, .mtl and glTF buffers."""
    found = [
        Path(bpy.path.abspath(image.filepath, library=image.library))
        for image in bpy.data.images
        if image.filepath and not image.packed_file
    ]
    found += [Path(bpy.path.abspath(library.filepath)) for library in bpy.data.libraries]
    if path.suffix.lower() == ".obj":
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        found += [path.parent / line.split(maxsplit=1)[1].strip() for line in lines if line.startswith("mtllib ")]
    elif path.suffix.lower() == ".gltf":
        buffers = json.loads(path.read_text(encoding="utf-8")).get("buffers", [])
        found += [path.parent / b["uri"] for b in buffers if "uri" in b and not b["uri"].startswith("data:")]
    return sorted({file.resolve() for file in found if file.is_file()})


def require_renderable(path: Path) -> None:
    """Raise UserError when the active scene has nothing that could be frozen."""
    scene = bpy.context.scene
    shapes = [o for o in scene.objects if o.type in GEOMETRY_TYPES or o.instance_type == "COLLECTION"]
    if not shapes:
        raise UserError(f"{path}: scene '{scene.name}' has no mesh; open a file with at least one visible object")
    if all(o.hide_render for o in shapes):
        raise UserError(f"{path}: every object of scene '{scene.name}' is hidden in renders; enable one")


def missing_files() -> list[str]:
    """One warning per image, library or font of the open file that is not on disk."""
    warnings = []
    for image in bpy.data.images:
        if image.packed_file or image.packed_files or image.source in SHAPELESS_IMAGES or not image.filepath:
            continue
        file = Path(bpy.path.abspath(image.filepath, library=image.library))
        if image.source == "TILED":
            tiles = image.tiles
            number = str(tiles[0].number) if tiles else "1001"
            file = Path(str(file).replace("<UDIM>", number))
        if not file.is_file():
            warnings.append(f"image '{image.name}': {file} is missing; it renders magenta")
    for library in bpy.data.libraries:
        file = Path(bpy.path.abspath(library.filepath))
        if not library.packed_file and not file.is_file():
            warnings.append(f"linked library {file} is missing; its objects are absent")
    for font in bpy.data.fonts:
        if font.filepath in ("", "<builtin>") or font.packed_file:
            continue
        file = Path(bpy.path.abspath(font.filepath, library=font.library))
        if not file.is_file():
            warnings.append(f"font '{font.name}': {file} is missing; its text changes shape")
    return warnings
