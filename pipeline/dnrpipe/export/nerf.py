"""`dnrpipe export-nerf`: ray-traced views and their cameras as nerfstudio, 3-D Gaussian splatting and instant-ngp
read them.

    transforms_{train,val,test}.json  the layout of NeRF-Synthetic: paths without suffix, one ``camera_angle_x``
    transforms.json                   nerfstudio's: all frames, paths with suffix, names of each split, the points
    images/<split>/<view>.png         8 bit, straight alpha, display space
    points3d.ply                      points on the visible surface with colours, to start splats from

Poses are camera-to-world with OpenGL's camera axes in the world of the .blend (Z up), as all of these expect. The
validation file names the test views: the pipeline ray-traces no others, and readers want the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from dnrtrain.atomic import atomic_path, write_json
from dnrtrain.contract import RASTER_CHANNELS, View, require_channels
from dnrtrain.display import ALPHA_FLOOR, DisplayTransform
from dnrtrain.exr import read_exr

from ..core.console import Console
from ..core.errors import UserError
from ..core.images import eight_bit
from ..core.scene_files import read_frame, read_selection, split_views
from ..core.workspace import Workspace
from ..stages.pipeline import STAGES, require_inputs
from ..stages.raytrace import reference_is_made
from ..stages.session import settings_of_last_run
from .folder import claim, finish

POINTS = 100_000
"""Points of the cloud at most: as many as 3-D Gaussian splatting draws at random where there is none."""
SPLITS = ("train", "test")


def export_nerf(workspace: Workspace, out: Path, console: Console, *, normalise: bool = False) -> dict[str, Any]:
    """Write the data set of a workspace whose selected views are ray-traced; returns what the command prints.

    normalise: move and scale the scene so that its bounding sphere is the unit sphere around the origin, which
    readers with a fixed box (nerfstudio's ``blender-data``: ±1.5) want; else poses stay in scene units.

    Raises UserError: nothing ray-traced yet, pictures that are out of date, or a folder that is not ours to write.
    """
    views = raytraced_views(workspace)
    frame = read_frame(workspace)
    display = DisplayTransform(frame, workspace.scene)
    claim(out, "nerf")
    scale, shift = (1.0 / frame.radius, -np.asarray(frame.center)) if normalise else (1.0, np.zeros(3))
    files: list[Path] = []
    with console.bar("images", sum(map(len, views.values()))) as bar:
        for split in SPLITS:
            for view in views[split]:
                path = out / "images" / split / f"{view.name}.png"
                write_rgba(path, workspace.raytraced(split, view.name), display)
                files.append(path)
                bar.advance()
    points, colours = _points(workspace, views["train"], display)
    cloud = out / "points3d.ply"
    write_points(cloud, (points + shift) * scale, colours)
    moved = {split: [_moved(view, scale, shift) for view in members] for split, members in views.items()}
    intrinsics = [_intrinsics(view) for split in SPLITS for view in moved[split]]
    shared = intrinsics[0] if all(other == intrinsics[0] for other in intrinsics) else None
    first = views["train"][0]
    if shared is None:
        console.warn("the views have different lenses: readers of NeRF-Synthetic take the first one's for all of them")
    elif abs(first.cx - first.width / 2) >= 1e-3 or abs(first.cy - first.height / 2) >= 1e-3:
        console.warn("the principal point is not the image's centre: readers of NeRF-Synthetic ignore that")
    extra = {"scale": scale, "shift": [float(x) for x in shift]}
    for name, split in (("train", "train"), ("val", "test"), ("test", "test")):
        path = out / f"transforms_{name}.json"
        write_json(path, _transforms(moved[split], f"./images/{split}/{{}}", shared, extra))
        files.append(path)
    write_json(out / "transforms.json", _nerfstudio(moved, shared, extra))
    finish(out, "nerf", [*files, cloud, out / "transforms.json"])
    return {
        "folder": str(out),
        "train": len(views["train"]),
        "test": len(views["test"]),
        "points": len(points),
        **extra,
    }


def write_rgba(path: Path, image: Path, display: DisplayTransform) -> None:
    """A ray-traced EXR as 8-bit PNG: display RGB of the un-premultiplied colour, straight alpha."""
    channels, _ = read_exr(image)
    require_channels(image, channels, RASTER_CHANNELS, "run `dnrpipe raytrace-selected` again")
    alpha = torch.from_numpy(channels["A"]).clamp(0.0, 1.0)
    rgba = torch.cat([_shown(channels, alpha, display) * (alpha > 0), alpha[None]]).permute(1, 2, 0).numpy()
    with atomic_path(path) as temporary:
        Image.fromarray(eight_bit(rgba), "RGBA").save(temporary)


def _shown(channels: dict[str, np.ndarray], alpha: torch.Tensor, display: DisplayTransform) -> torch.Tensor:
    """Display RGB [3, H, W] of the un-premultiplied colour."""
    return display(torch.from_numpy(np.stack([channels[c] for c in "RGB"])) / alpha.clamp_min(ALPHA_FLOOR))


def write_points(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    """Points [P, 3] and colours uint8 [P, 3] as binary PLY with the properties that 3-D Gaussian splatting reads."""
    channels = ("red", "green", "blue")
    columns = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in channels]
    table = np.zeros(len(points), columns)
    for i in range(3):
        table["xyz"[i]] = points[:, i]
        table[channels[i]] = colours[:, i]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in columns]
    lines += ["end_header", ""]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(lines).encode("ascii") + table.tobytes())


def raytraced_views(workspace: Workspace) -> dict[str, list[View]]:
    """The ray-traced views, train: the selected ones in the order chosen; test: the held-out ones.

    Raises UserError: some are not ray-traced yet, or pictures are of other cameras or settings than those of now.
    """
    settings = settings_of_last_run(workspace)
    require_inputs(STAGES["finetune"], workspace, settings, "export")  # it reads the same views
    cameras = split_views(workspace)
    by_name = {view.name: view for view in cameras["train"]}
    chosen = [by_name[name] for name in read_selection(workspace).views if name in by_name]
    missing = [view.name for view in chosen if not workspace.raytraced("train", view.name).is_file()]
    if missing or not chosen:
        raise UserError(
            f"{workspace.root}: {len(missing)} of {len(chosen)} selected views are not ray-traced; run"
            " `dnrpipe raytrace-selected` first"
        )
    test = [view for view in cameras["test"] if workspace.raytraced("test", view.name).is_file()]
    old = [view.name for view in test if not reference_is_made(workspace, settings, view)]
    if old:
        raise UserError(
            f"{workspace.root}: {len(old)} of {len(test)} held-out views were ray-traced for other cameras or settings;"
            " run `dnrpipe evaluate` first"
        )
    if not test:
        raise UserError(f"{workspace.root}: no held-out view is ray-traced; run `dnrpipe evaluate` first")
    return {"train": chosen, "test": test}


def _moved(view: View, scale: float, shift: np.ndarray) -> View:
    matrix = view.matrix
    matrix[:3, 3] = (matrix[:3, 3] + shift) * scale
    return view.model_copy(update={"c2w": tuple(tuple(float(x) for x in row) for row in matrix)})


def _intrinsics(view: View) -> dict[str, float]:
    return {
        **view.intrinsics,
        "camera_angle_x": 2 * math.atan(0.5 * view.width / view.fl_x),
        "camera_angle_y": 2 * math.atan(0.5 * view.height / view.fl_y),
    }


def _transforms(
    views: Sequence[View], file_path: str, shared: dict[str, float] | None, extra: dict[str, Any]
) -> dict[str, Any]:
    """Intrinsics stand once where all views share them; else in each frame, the first one's angle also once."""
    frames = [
        {
            "file_path": file_path.format(view.name),
            **({} if shared is not None else _intrinsics(view)),
            "transform_matrix": [list(row) for row in view.c2w],
        }
        for view in views
    ]
    angle = {"camera_angle_x": _intrinsics(views[0])["camera_angle_x"]}
    return {**(shared or angle), "dnrpipe": extra, "frames": frames}


def _nerfstudio(views: dict[str, list[View]], shared: dict[str, float] | None, extra: dict[str, Any]) -> dict[str, Any]:
    parts = {split: _transforms(views[split], f"images/{split}/{{}}.png", shared, extra) for split in SPLITS}
    names = {split: [frame["file_path"] for frame in parts[split]["frames"]] for split in SPLITS}
    return {
        **parts["train"],
        "camera_model": "OPENCV",
        "ply_file_path": "points3d.ply",
        "train_filenames": names["train"],
        "val_filenames": names["test"],
        "test_filenames": names["test"],
        "frames": [*parts["train"]["frames"], *parts["test"]["frames"]],
    }


def _points(workspace: Workspace, views: Sequence[View], display: DisplayTransform) -> tuple[np.ndarray, np.ndarray]:
    """Positions [P, 3] (world) of the pixels of the training views that see a surface, and their display colours."""
    points, colours = [], []
    for view in views:
        surface, _ = read_exr(workspace.passes("train", view.name))
        image, _ = read_exr(workspace.raytraced("train", view.name))
        inside = (surface["mask"] > 0.5) & (image["A"] > 0.5)
        points.append(np.stack([surface[f"position.{c}"][inside] for c in "XYZ"], axis=1))
        shown = _shown(image, torch.from_numpy(image["A"]), display).permute(1, 2, 0).numpy()
        colours.append(eight_bit(shown[inside]))
    place, colour = np.concatenate(points), np.concatenate(colours)
    if len(place) > POINTS:
        kept = np.random.default_rng(0).choice(len(place), POINTS, replace=False)
        place, colour = place[kept], colour[kept]
    return place, colour
