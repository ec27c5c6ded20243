"""Convert all materials before anything is exported, to learn which of their values have to be baked first."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain.atomic import write_json

from ..findings import Findings
from ..geometry.atlas import build_atlas
from ..geometry.frozen import FrozenMesh, load_geometry, save_geometry
from ..reading.names import find_material
from ..shading.materials import MaterialConverter
from ..shading.textures import ImageReader, TextureStore
from .bakes import BakeBook

PENDING = "pending.json"


@dataclass(frozen=True)
class BakeOptions:
    """folder: cached bakes (files named by content). size: texels of the atlas' side. refused: keys not to ask for."""

    folder: Path
    size: int
    refused: tuple[str, ...] = ()


def place_atlas(meshes: Sequence[FrozenMesh], scene_dir: Path) -> dict[str, Any]:
    """Pack the scene atlas (see :func:`..geometry.atlas.build_atlas`), or take the one that the bakes were made for."""
    pending = scene_dir / PENDING
    if not pending.is_file():
        return build_atlas(meshes)
    kept = load_geometry(scene_dir / "geometry.npz")
    names = [(mesh.name, mesh.triangles) for mesh in meshes]
    if names != [(mesh.name, mesh.triangles) for mesh in kept]:
        return build_atlas(meshes)  # the file changed in between
    for mesh, before in zip(meshes, kept, strict=True):
        mesh.atlas = before.atlas
    return json.loads(pending.read_text(encoding="utf-8"))["atlas"]


def convert_materials(
    meshes: Sequence[FrozenMesh], scene_dir: Path, findings: Findings, options: BakeOptions | None
) -> MaterialConverter:
    """A converter that has converted every material in use; see :func:`missing_bakes`."""
    book = None if options is None else BakeBook.open(meshes, options.folder, options.size, options.refused)
    converter = MaterialConverter(TextureStore(scene_dir), ImageReader(findings), findings, book)
    for mesh in meshes:
        for slot in np.unique(mesh.material_index):
            name = mesh.materials[slot]
            if name is not None:
                converter.convert(find_material(name))
    return converter


def missing_bakes(
    converter: MaterialConverter, meshes: Sequence[FrozenMesh], atlas: dict[str, Any], scene_dir: Path, frame: int
) -> dict[str, Any] | None:
    """What has to be baked before the scene can be exported, or None.

    Leaves geometry.npz for the bake and notes the atlas for the next attempt. Returns {"layers": tasks of
    :class:`.bake.Worker`, "frame": current frame}.
    """
    pending = scene_dir / PENDING
    if converter.book is None or not converter.book.missing:
        pending.unlink(missing_ok=True)
        return None
    shutil.rmtree(scene_dir / "textures", ignore_errors=True)  # made of placeholders
    save_geometry(scene_dir / "geometry.npz", meshes)
    write_json(pending, {"atlas": atlas})
    return {"layers": converter.book.layers(), "frame": frame}
