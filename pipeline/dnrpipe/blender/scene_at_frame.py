"""Worker that converts an open scene at other frames, into bundles that can be path-traced and nothing more."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import bpy

from dnrpipe.core.errors import UserError
from dnrpipe.core.scene_files import read_summary

from .baking.earlier import Earlier
from .baking.pending import bake_cache, converted, missing_bakes, place_atlas
from .bundle.export import export_bundle
from .findings import Findings
from .geometry.freeze import freeze_scene
from .geometry.frozen import FrozenMesh, load_geometry
from .geometry.render_graph import render_layer
from .motion.simulations import is_simulated, play
from .motion.suspects import find_suspects
from .reading.light import ensure_light
from .reading.names import find_material
from .reading.opening import BODILESS, open_scene
from .shading.materials import MaterialConverter
from .shading.textures import ImageReader, TextureStore
from .tasks import BakeOptions, PendingBakes, PrepareAnswer, SceneAtCommon, SceneAtTask


class Worker:
    """Opens a scene file once, and converts it at one frame per task.

    common: a `SceneAtCommon`, task: a `SceneAtTask`.
    """

    def __init__(self, common: dict[str, Any]) -> None:
        self.common = SceneAtCommon.model_validate(common)
        open_scene(self.common.source)
        self.scene: Any = bpy.context.scene
        self.world = render_layer(self.scene).world_override or self.scene.world
        self.objects = sorted(obj.name_full for obj in bpy.data.objects if obj.type not in BODILESS)
        self.played: int | None = None
        self.simulated = is_simulated(self.scene)
        self.earlier = load_geometry(self.common.scene_dir / "geometry.npz")
        _evaluate_materials(self.scene)

    def __call__(self, task: dict[str, Any]) -> dict[str, Any]:
        wanted = SceneAtTask.model_validate(task)
        options = self.common.bakes.model_copy(update={"refused": wanted.refused})
        return PrepareAnswer(bakes=self._convert(wanted.frame, wanted.output, options)).data()

    def _convert(self, frame: int, folder: Path, options: BakeOptions) -> PendingBakes | None:
        """Fill the folder with scene.xml, meshes/ and textures/; or say which textures have to be baked first.

        Raises UserError: nothing is visible at the frame.
        """
        scene, source = self.scene, self.common.source
        folder.mkdir(parents=True, exist_ok=True)
        scene.world = self.world
        if self.simulated and (self.played is None or self.played < frame):
            play(scene, frame, after=self.played)
            self.played = frame
        scene.frame_set(frame)
        try:
            meshes = freeze_scene(scene).meshes
        except UserError as nothing:
            raise UserError(f"{source}, frame {frame}: {nothing}") from None
        if not self.common.lit:
            ensure_light(scene, meshes)
        earlier, facts = Earlier(self.earlier), read_summary(self.common.scene_dir).atlas
        earlier.take_numbers(meshes, self.objects)
        filled, strangers = earlier.take_places(meshes)
        converter = self._converter(meshes, filled, folder, options, earlier)
        if any(_materials(mesh) & converter.bakes.materials for mesh in strangers if converter.bakes is not None):
            # They need places of their own, and so an atlas of this frame's: all is baked anew.
            shutil.rmtree(folder / "textures", ignore_errors=True)
            facts = place_atlas(meshes, folder)
            filled, converter = meshes, self._converter(meshes, meshes, folder, options, None)
        pending = missing_bakes(converter, filled, facts, folder, frame)
        if pending is None:
            export_bundle(meshes, converter)
            (folder / "geometry.npz").unlink(missing_ok=True)
        return pending

    def _converter(
        self,
        meshes: list[FrozenMesh],
        filled: list[FrozenMesh],
        folder: Path,
        options: BakeOptions,
        earlier: Earlier | None,
    ) -> MaterialConverter:
        findings, cache = Findings(), bake_cache(filled, options)
        cache.earlier = earlier
        store = TextureStore(folder, made=self.common.scene_dir)
        return converted(meshes, MaterialConverter(store, ImageReader(findings), findings, cache))


def _materials(mesh: FrozenMesh) -> set[str]:
    return {name for name in mesh.materials if name is not None}


def _evaluate_materials(scene: Any) -> None:
    """Have Blender evaluate every material that may change, also where the viewport hides what shows it.

    Scripts read what the viewport's evaluation left in the file's own data. A mesh without faces carries them.
    """
    names = sorted(find_suspects(scene).materials)
    if not names:
        return
    data = bpy.data.meshes.new("dnrpipe.materials")
    for name in names:
        data.materials.append(find_material(name))
    scene.collection.objects.link(bpy.data.objects.new("dnrpipe.materials", data))
