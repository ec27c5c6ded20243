"""Open a scene file in this process: .blend, or a mesh format through Blender's importers."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy

from dnrpipe.core.errors import NothingVisible, UserError
from dnrtrain.text import one_line

from ..findings import first_of
from .missing import missing_files, missing_warnings, strict_refusal
from .names import repair_names
from .repairing import repair_shaders
from .scripts import script_warnings

BLEND_MAGIC = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")  # plain, zstd, gzip
BLEND_SUFFIX = re.compile(r"\.blend\d*", re.IGNORECASE)  # .blend1 and so on are Blender's backups
OWN_SCENES = "dnrpipe."  # scenes of a source.blend that is converted once more
UNNODED = "Versioning: Use Nodes was removed"  # Blender 5's label on nodes it made for materials without any
BODILESS = {"EMPTY", "CAMERA", "LIGHT", "LIGHT_PROBE", "SPEAKER", "ARMATURE", "LATTICE"}
"""Types of objects without a surface of their own; an empty may instance some."""


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


def open_scene(path: str | Path, *, strict: bool = False) -> list[str]:
    """Make ``path`` the open file of this process and return warnings for the user.

    Scripts embedded in the file (text blocks, Python drivers) are never executed. Mesh formats are
    imported into an empty scene. Of several scenes the active one is taken, or the first with objects.

    Args:
        strict: refuse a file that refers to missing images, libraries, fonts, volumes or caches.

    Raises:
        UserError: no such file, unknown format, damaged file; ``strict`` and something is missing.
        NothingVisible: no object that could give a surface; the file stays open.
    """
    path = Path(path).resolve()
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a .blend file in it")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix in IMPORTERS:
        _import(path, suffix)
        warnings = []
    elif BLEND_SUFFIX.fullmatch(suffix) or _head(path) == BLEND_MAGIC[0]:  # an uncompressed .blend of any suffix
        warnings = open_blend(path)
    else:
        known = ", ".join([".blend", *IMPORTERS])
        raise UserError(f"{path}: cannot read '{suffix or path.name}' files; known are {known}")
    warnings += repair_names()
    warnings += repair_shaders()
    warnings += _choose_scene(path)
    missing = missing_files()
    if strict and missing:
        raise UserError(f"{path}: {strict_refusal(missing)}")
    return warnings + missing_warnings(missing) + script_warnings()


def open_blend(path: Path) -> list[str]:
    """Open a .blend file of any Blender; warnings on versions. Raises UserError when it is not one, or damaged."""
    head = _head(path)
    if not head:
        raise UserError(f"{path}: is empty (0 bytes)")
    if not head.startswith(BLEND_MAGIC):
        raise UserError(f"{path}: is not a Blender file (starts with {head!r}); save it from Blender again")
    try:
        with _heard() as said:
            bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        reason = one_line(str(error).removeprefix("Error: "))
        if "Big Endian" in reason:
            unread = f"which Blender {_version(bpy.app.version)} no longer reads; save it from Blender 4.5 or older"
            raise UserError(f"{path}: saved on a big-endian machine, {unread}") from None
        raise UserError(f"{path}: damaged or truncated .blend; save it from Blender again ({reason})") from None
    return _version_warnings() + _colour_warnings("".join(said))


@contextmanager
def _heard() -> Iterator[list[str]]:
    """What Blender prints meanwhile, also passed on: of colour spaces that it does not know it says nothing else."""
    said: list[str] = []
    sys.stdout.flush()
    kept = os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        try:
            yield said
        finally:
            os.dup2(kept, 1)
            os.close(kept)
            file.seek(0)
            content = file.read()
            said.append(content.decode("utf-8", "replace"))
            os.write(1, content)


def _colour_warnings(said: str) -> list[str]:
    """One line for colour spaces, displays, view transforms and looks of another OpenColorIO configuration."""
    lines = [line.partition("color_management | WARNING ")[2].strip() for line in said.splitlines()]
    unknown = list(dict.fromkeys(line.rstrip(".") for line in lines if "not found" in line))
    if not unknown:
        return []
    return [f"colour management of another configuration than Blender's own is replaced: {first_of(unknown, 5, '; ')}"]


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(7)


def _version(numbers: tuple[int, ...]) -> str:
    return ".".join(map(str, numbers[:2]))


def _version_warnings() -> list[str]:
    saved, here = tuple(bpy.data.version), _version(bpy.app.version)
    by = f"saved by Blender {_version(saved)}"
    if saved[:2] > bpy.app.version[:2]:
        return [f"{by}, read by {here}: some data may be lost; compare the picture"]
    warnings = []
    if saved < (2, 50):
        warnings.append(f"{by}: Blender {here} reads no animation of it")
    if saved < (2, 80):
        trees = [m.node_tree for m in bpy.data.materials if m.users and m.node_tree]
        plain = sum(any(node.type == "FRAME" and node.label == UNNODED for node in tree.nodes) for tree in trees)
        if plain:
            only = "only the colour remains, as in Blender itself"
            warnings.append(f"{by}: of {plain} material(s) of Blender Internal {only}")
    return warnings


def _import(path: Path, suffix: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    try:
        IMPORTERS[suffix](str(path))
    except (RuntimeError, ValueError, KeyError, IndexError, OSError) as error:  # the glTF importer is Python
        reason = one_line(str(error).removeprefix("Error: "))[:200]
        raise UserError(f"{path}: cannot be imported as {suffix[1:].upper()} ({reason})") from None
    if not bpy.context.scene.objects:
        raise UserError(f"{path}: nothing was imported from it; is it a valid {suffix[1:].upper()} file?")


def _choose_scene(path: Path) -> list[str]:
    """Stay in the active scene; if it has no objects, go to the first one that has."""
    for scene in [s for s in bpy.data.scenes if s.name.startswith(OWN_SCENES)]:
        if len(bpy.data.scenes) > 1:
            bpy.data.scenes.remove(scene)
    scenes = list(bpy.data.scenes)
    active = bpy.context.scene
    filled = [scene for scene in scenes if _may_show(scene)]
    if not filled:
        where = f"scene '{scenes[0].name}' has" if len(scenes) == 1 else f"none of its {len(scenes)} scenes has"
        count = sum(obj.type == "MESH" and not obj.users_scene for obj in bpy.data.objects)
        loose = f" ({count} mesh objects lie in no scene)" if count else ""  # a file of assets
        raise NothingVisible(
            f"{path}: {where} no object with a surface{loose}; open a file with at least one visible object"
        )
    if active not in filled:
        bpy.context.window.scene = filled[0]
        return [f"the active scene '{active.name}' has no objects to show: scene '{filled[0].name}' is converted"]
    if len(scenes) > 1:
        names = ", ".join(f"'{scene.name}'" for scene in scenes[:5])
        return [f"the file has {len(scenes)} scenes ({names}): the active one, '{active.name}', is converted"]
    return []


def _may_show(scene: bpy.types.Scene) -> bool:
    """Whether any object, of the background set too, could give a surface: it carries geometry, or instances some."""
    if any(obj.type not in BODILESS or obj.instance_type == "COLLECTION" for obj in scene.objects):
        return True
    return scene.background_set is not None and _may_show(scene.background_set)
