"""Make the open file stand alone (images, fonts and libraries go into it) and save it."""

from __future__ import annotations

from pathlib import Path

import bpy

from dnrtrain.atomic import atomic_path

from .opening import SHAPELESS_IMAGES


def pack_everything() -> list[str]:
    """Pack all external data of the open file; return a warning for each that could not be packed."""
    warnings = []
    for image in bpy.data.images:
        generated = image.source in SHAPELESS_IMAGES
        if image.packed_file or image.packed_files or (generated and not image.is_dirty):
            continue
        if image.source in ("MOVIE", "SEQUENCE"):
            warnings.append(f"image '{image.name}' is a {image.source.lower()} and stays outside the workspace")
            continue
        if image.source == "FILE" and not image.has_data and not image.pixels:
            continue  # missing; opening has warned already
        try:
            image.pack()
        except RuntimeError as error:
            warnings.append(f"image '{image.name}' could not be packed: {' '.join(str(error).split())}")
    for font in bpy.data.fonts:
        if font.filepath not in ("", "<builtin>") and not font.packed_file:
            try:
                font.pack()
            except RuntimeError as error:
                warnings.append(f"font '{font.name}' could not be packed: {' '.join(str(error).split())}")
    if bpy.data.libraries:
        try:
            bpy.ops.file.pack_libraries()
        except RuntimeError as error:
            warnings.append(f"linked libraries could not be packed: {' '.join(str(error).split())}")
    return warnings


def save_blend(path: Path) -> None:
    """Save the open file compressed, atomically, without changing which file is open."""
    with atomic_path(path) as temporary:
        bpy.ops.wm.save_as_mainfile(filepath=str(temporary), compress=True, copy=True, relative_remap=True)
