"""All materials are converted before anything is exported, to find the values that have to be baked first."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dnrpipe.core.scene_files import read_record
from dnrpipe.core.scene_records import AtlasFacts
from dnrtrain.atomic import write_json

from ..findings import Findings
from ..geometry.atlas import build_atlas
from ..geometry.frozen import FrozenMesh, load_geometry, save_geometry
from ..reading.names import find_material
from ..shading.materials import MaterialConverter
from ..shading.textures import ImageReader, TextureStore
from ..tasks import BakeOptions, PendingBakes
from .cache import BakeCache
from .regions import Atlas

PENDING = "pending.json"


def place_atlas(meshes: Sequence[FrozenMesh], scene_dir: Path) -> AtlasFacts:
    """Pack the scene atlas, or take the one that the bakes were made for."""
    pending = scene_dir / PENDING
    kept = load_geometry(scene_dir / "geometry.npz") if pending.is_file() else []
    if [(mesh.name, mesh.triangles) for mesh in meshes] != [(mesh.name, mesh.triangles) for mesh in kept]:
        return build_atlas(meshes)  # the first attempt, or the file changed in between
    for mesh, before in zip(meshes, kept, strict=True):
        mesh.atlas = before.atlas
    return read_record(pending, AtlasFacts)


def convert_materials(
    meshes: Sequence[FrozenMesh], scene_dir: Path, findings: Findings, options: BakeOptions | None
) -> MaterialConverter:
    """A converter that has converted every material in use; `missing_bakes` says what it lacks."""
    bakes = None if options is None else bake_cache(meshes, options)
    return converted(meshes, MaterialConverter(TextureStore(scene_dir), ImageReader(findings), findings, bakes))


def bake_cache(meshes: Sequence[FrozenMesh], options: BakeOptions) -> BakeCache:
    """The cache for an atlas that the meshes fill."""
    return BakeCache(Atlas(meshes, options.size), options.folder, frozenset(options.refused))


def converted(meshes: Sequence[FrozenMesh], converter: MaterialConverter) -> MaterialConverter:
    """The converter, which has converted every material of the meshes."""
    for mesh in meshes:
        for slot in np.unique(mesh.material_index):
            name = mesh.materials[slot]
            if name is not None:
                converter.convert(find_material(name))
    return converter


def missing_bakes(
    converter: MaterialConverter, meshes: Sequence[FrozenMesh], atlas: AtlasFacts, scene_dir: Path, frame: int
) -> PendingBakes | None:
    """What has to be baked before the scene can be exported, or None.

    Leaves geometry.npz for the bake, and the atlas' facts for the next attempt.
    """
    pending = scene_dir / PENDING
    if converter.bakes is None or not converter.bakes.missing:
        pending.unlink(missing_ok=True)
        return None
    shutil.rmtree(scene_dir / "textures", ignore_errors=True)  # made of placeholders
    save_geometry(scene_dir / "geometry.npz", meshes)
    write_json(pending, atlas.data())
    return PendingBakes(layers=tuple(map(tuple, converter.bakes.layers())), frame=frame)
