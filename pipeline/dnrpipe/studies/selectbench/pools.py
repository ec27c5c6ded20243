"""Pools: the sets of candidate views that policies choose from, each a workspace of its scene."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from dnrtrain.atomic import atomic_path, write_json
from dnrtrain.contract import View

from ...blender.geometry.frozen import load_geometry
from ...core.console import Console
from ...core.errors import UserError
from ...core.scene_files import read_summary
from ...core.settings import Settings
from ...core.workspace import Workspace, file_sha256
from ...stages.base_images import light_path
from ...stages.prepare import scene_and_views
from ...stages.stage import Run
from ..cells.scenes import Scene, prepared, scene_workspace
from .rigs import inside, walk

POOLS: dict[str, str] = {
    "dome": "on a hemisphere around the scene, evenly",
    "sphere": "on a full sphere around the scene, evenly",
    "path": "a filmed walk: near-duplicates at a few stops, some views that see nothing",
    "indoor": "within the bounds of the scene, among its surfaces, a wide lens",
}


@dataclass
class Pool:
    """One scene with one set of candidates, whose cameras stand. run: in its workspace, settings with its cameras."""

    scene: str
    name: str
    run: Run

    @cached_property
    def data(self) -> Scene:
        """Its views, passes rendered where they are missing. Raises UserError: fewer than the largest budget."""
        return prepared(self.folder, self.run, "bench-select")

    @property
    def folder(self) -> str:
        return f"{self.scene}-{self.name}"


def choose_pools(text: str) -> list[str]:
    """``"dome,path"`` or ``"all"`` in the table's order. Raises UserError for unknown names."""
    names = {part.strip() for part in text.split(",") if part.strip()}
    if "all" in names:
        names = set(POOLS)
    if unknown := sorted(names - POOLS.keys()):
        raise UserError(f"--pools {unknown[0]}: no such pool; choose of {', '.join(POOLS)}, all")
    if not names:
        raise UserError(f"--pools: names no pool; choose of {', '.join(POOLS)}, all")
    return [name for name in POOLS if name in names]


def place_pool(source: Path, pool: str, out: Path, settings: Settings, console: Console) -> Pool:
    """Make or find the pool's workspace ``<out>/scenes/<scene>-<pool>.dnr`` and say where its cameras stand.

    What does not depend on the cameras (conversion, baked textures) is made once per scene and copied. Raises
    UserError: the scene has no room for the pool.
    """
    first = _converted(source, out, settings, console)
    root = out / "scenes" / f"{source.stem}-{pool}.dnr"
    workspace = scene_workspace(source, root)
    for folder in ("scene", "bakes"):
        _copy_tree(first.root / folder, root / folder)
    settings = settings.model_copy(deep=True)
    if pool in ("dome", "sphere"):
        settings.cameras.source = pool
    else:
        file = root / "rig.json"
        summary = read_summary(first.scene)
        if pool == "path":
            views = walk(summary, settings.cameras)
        else:
            meshes = load_geometry(first.scene / "geometry.npz")
            views = inside(summary, settings.cameras, meshes, source.stem)
        write_rig(file, views)
        settings.cameras.source, settings.cameras.source_sha256 = str(file.resolve()), file_sha256(file)
    return Pool(source.stem, pool, Run(workspace, settings, console))


def write_rig(path: Path, views: dict[str, list[View]]) -> None:
    """Views as a camera file whose frames name their split, atomically."""
    frames = [
        {
            "file_path": view.name,
            "split": split,
            **{key: getattr(view, key) for key in ("fl_x", "fl_y", "cx", "cy")},
            "w": view.width,
            "h": view.height,
            "transform_matrix": [list(row) for row in view.c2w],
        }
        for split, members in views.items()
        for view in members
    ]
    write_json(path, {"camera_model": "OPENCV", "frames": frames})


def share_light(pools: Sequence[Pool]) -> None:
    """Give every pool of a scene the baked light of the first that has it; a light of other inputs is baked again."""
    files = [light_path(pool.data.workspace) for pool in pools]
    made = next((file for file in files if file.exists()), None)
    for file in files:
        if made is not None and not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(file) as temporary:
                shutil.copyfile(made, temporary)


def _converted(source: Path, out: Path, settings: Settings, console: Console) -> Workspace:
    """The scene converted, once for all its pools."""
    workspace = scene_workspace(source, out / "scenes" / f"{source.stem}.dnr")
    plain = settings.model_copy(deep=True)
    plain.cameras.source, plain.cameras.source_sha256 = "dome", ""
    scene_and_views(Run(workspace, plain, Console(json_mode=console.json_mode, quiet=True), id="bench-select"))
    return workspace


def _copy_tree(source: Path, target: Path) -> None:
    """Copy a folder whole or not at all; one that is there stays."""
    if target.exists() or not source.exists():
        return
    fresh = target.with_name(f"{target.name}.copy")
    if fresh.exists():
        shutil.rmtree(fresh)
    shutil.copytree(source, fresh)
    fresh.rename(target)
