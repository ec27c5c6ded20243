"""Worker that bakes socket values of many materials into the scene atlas, one Cycles EMIT bake per task.

An EMIT bake yields the value itself; a DIFFUSE bake would be black on metals.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import bpy
import numpy as np

from dnrtrain.atomic import atomic_path

from ..geometry.frozen import ATLAS_LAYER, FrozenMesh, load_geometry
from ..reading.names import find_material
from ..reading.opening import open_scene
from ..shading.image_files import HALF_MAX
from ..shading.sockets import walk
from ..tasks import BakeAnswer, BakeCommon, BakeTask, Tap
from .mesh import MAX_OWN, add_object, needs_own_space
from .regions import Atlas
from .trees import TreeCopier

EMPTY = -12345.0
"""What the image holds before the bake: texels that Cycles did not reach keep it."""
SAMPLES = 8
"""Points in each texel: a feature finer than a texel is averaged instead of turning into blocks."""


class Worker:
    """Bakes a layer per task. common: a `BakeCommon`, task: a `BakeTask`."""

    def __init__(self, common: dict[str, Any]) -> None:
        settings = BakeCommon.model_validate(common)
        open_scene(settings.source)
        bpy.context.scene.frame_set(settings.frame)
        self.meshes = load_geometry(settings.geometry)
        self.folder, self.threads = settings.folder, settings.threads
        self.atlas = Atlas(self.meshes, settings.size)

    def __call__(self, task: dict[str, Any]) -> BakeAnswer:
        started = time.monotonic()
        layer = {entry.material: entry.taps for entry in BakeTask.model_validate(task).layer}
        pixels = bake_layer(self.meshes, layer, self.atlas.size, self.threads)
        repaired: dict[str, int] = {}
        for material, taps in layer.items():
            values, lost = _complete(pixels, self.atlas.region(material).texels, self.atlas.size)
            if lost:
                repaired[material] = lost
            for index, tap in enumerate(taps):
                kept = values[:, index : index + 1] if tap.kind == "scalar" else values
                half = np.abs(kept).max(initial=0.0) < HALF_MAX
                with atomic_path(self.folder / f"{tap.key}.npy") as temporary, temporary.open("wb") as file:
                    np.save(file, np.ascontiguousarray(kept, np.float16 if half else np.float32))
        return {"seconds": time.monotonic() - started, "repaired": repaired}


def bake_layer(meshes: Sequence[FrozenMesh], layer: Mapping[str, Sequence[Tap]], size: int, threads: int) -> np.ndarray:
    """Bake one emission per material; returns float32 [size², 3], EMPTY where nothing was baked."""
    image = bpy.data.images.new("dnrpipe.bake", size, size, alpha=True, float_buffer=True)
    image.colorspace_settings.name = "Linear Rec.709"
    image.pixels.foreach_set(np.full(size * size * 4, EMPTY, np.float32))
    copier = TreeCopier(image)
    materials = {name: copier.copy(_material(name), taps) for name, taps in layer.items()}
    dark = copier.dark()
    scene = _scene(threads)
    window = bpy.context.window
    before = window.scene
    window.scene = scene
    try:
        wanted = [mesh for mesh in meshes if any(name in layer for name in mesh.materials)]
        few = [name for name in layer if sum(name in mesh.materials for mesh in wanted) <= MAX_OWN]
        own = [mesh for mesh in wanted if needs_own_space(mesh, few)]
        shared = [mesh for mesh in wanted if not any(mesh is other for other in own)]
        groups = [[mesh] for mesh in own] + ([shared] if shared else [])
        for group in groups:
            add_object(scene, group, materials, dark, local=group is not shared)
        nodes = (node for name in layer for node in walk(_material(name).node_tree))
        rest = [mesh for mesh in meshes if not any(mesh is other for other in wanted)]
        if rest and any(node.type == "AMBIENT_OCCLUSION" for node in nodes):  # it sees them, but they are not baked
            add_object(scene, rest, {}, dark, local=False, selected=False)
        scene.view_layers[0].update()
        bpy.ops.object.bake(
            type="EMIT",
            margin=0,
            use_clear=False,
            target="IMAGE_TEXTURES",
            save_mode="INTERNAL",
            uv_layer=ATLAS_LAYER,
        )
        pixels = np.empty(size * size * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        window.scene = before
        bpy.data.scenes.remove(scene)
        bpy.data.images.remove(image)
        bpy.ops.outliner.orphans_purge(do_recursive=True)
    return pixels.reshape(-1, 4)[:, :3]


def _scene(threads: int) -> bpy.types.Scene:
    now = bpy.context.scene
    scene = bpy.data.scenes.new("dnrpipe.bake")
    scene.frame_set(now.frame_current, subframe=now.frame_subframe)  # copies of materials keep their keys
    scene.render.engine = "CYCLES"
    scene.render.use_simplify = False
    if threads:
        scene.render.threads_mode = "FIXED"
        scene.render.threads = threads
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = SAMPLES
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.seed = 0
    return scene


def _material(name: str) -> bpy.types.Material:
    found = find_material(name)
    if found is None:
        raise ValueError(f"material '{name}' is gone from the scene file")
    return found


def _complete(pixels: np.ndarray, texels: np.ndarray, size: int) -> tuple[np.ndarray, int]:
    """(values of the region [N, 3], how many were not finite).

    Those, and texels that Cycles did not reach (rims, slivers), take a neighbour's value.
    """
    values = pixels[texels].copy()
    # Shader graphs can yield NaN; Cycles hands it through.
    bad = ~np.isfinite(values)
    values[bad] = EMPTY
    repaired = int(bad.any(1).sum())
    reached = np.asarray((values > EMPTY / 2).all(1))
    if reached.all() or not len(values):
        return values, repaired
    where = np.full(size * size, -1, np.int64)
    where[texels] = np.arange(len(texels))
    lost = np.flatnonzero(~reached)
    for step in (1, 2, 4, 8):
        for shift in (1, -1, size, -size, size + 1, size - 1, 1 - size, -1 - size):
            neighbour = np.clip(texels[lost] + step * shift, 0, size * size - 1)
            row = where[neighbour]
            usable = (row >= 0) & reached[row]
            values[lost[usable]] = values[row[usable]]
            lost = lost[~usable]
        if not len(lost):
            return values, repaired
    values[lost] = values[reached].mean(0) if reached.any() else 0.0
    return values, repaired
