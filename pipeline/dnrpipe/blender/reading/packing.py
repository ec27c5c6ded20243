"""Make the open file stand alone (images, fonts, volumes and libraries go into it) and save it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from dnrtrain.atomic import atomic_path
from dnrtrain.text import one_line

from ..findings import printable
from .missing import SHAPELESS_IMAGES, image_files, is_file


def pack_everything() -> list[str]:
    """Pack all external data of the open file; return a warning for each that could not be packed.

    Skips missing files: `opening` has named them.
    """
    warnings = []
    for image in bpy.data.images:
        generated = image.source in SHAPELESS_IMAGES
        if image.packed_file or image.packed_files or (generated and not image.is_dirty):
            continue
        label = printable(image.name_full)
        if not generated and not any(map(is_file, image_files(image))):
            continue
        if image.source in ("MOVIE", "SEQUENCE"):
            warnings.append(f"image '{label}' is a {image.source.lower()} and stays outside the workspace")
            continue
        if image.source == "TILED":
            _drop_missing_tiles(image)
        warnings += _pack(image, f"image '{label}'")
    for block, kind in [(f, "font") for f in bpy.data.fonts] + [(v, "volume") for v in bpy.data.volumes]:
        path = block.filepath
        if path in ("", "<builtin>") or block.packed_file:
            continue
        if not is_file(Path(bpy.path.abspath(path, library=block.library))):
            continue
        warnings += _pack(block, f"{kind} '{block.name_full}'")
    return warnings + _pack_libraries()


def _pack(block: Any, label: str) -> list[str]:
    try:
        block.pack()
    except RuntimeError as error:
        return [f"{label} could not be packed: {one_line(error)}"]
    return []


def _drop_missing_tiles(image: Any) -> None:
    """Blender packs all tiles or none; a tile that is not there and one that is gone both render magenta."""
    for path, tile in list(zip(image_files(image), list(image.tiles), strict=False)):
        if not is_file(path) and len(image.tiles) > 1:
            image.tiles.remove(tile)


def _pack_libraries() -> list[str]:
    """Pack the linked libraries that are there. Blender refuses all if one has an absolute path or is missing."""
    wanted = [library for library in bpy.data.libraries if not library.packed_file and not library.is_missing]
    if not wanted:
        return []
    # A library's own path to another library is in its file and cannot be changed from here.
    fixed = [library.name for library in wanted if library.parent and not library.filepath.startswith("//")]
    for library in wanted:
        library.filepath = bpy.path.relpath(bpy.path.abspath(library.filepath))
    try:
        bpy.ops.file.pack_libraries()
        reason = ""
    except RuntimeError as error:
        reason = f" ({one_line(error)})"
    left = [library.name for library in wanted if not library.packed_file]
    left += [f"{name} (another library names it by an absolute path)" for name in fixed if name not in left]
    return [f"linked libraries stay outside the workspace: {', '.join(left)}{reason}"] if left else []


def save_blend(path: Path) -> None:
    """Save the open file compressed, atomically, without changing which file is open."""
    with atomic_path(path) as temporary:
        bpy.ops.wm.save_as_mainfile(filepath=str(temporary), compress=True, copy=True, relative_remap=True)
