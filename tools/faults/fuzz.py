"""Mutated files of every format that is read: each is read or refused in one line, in bounded memory and time.

python -m tools.faults.fuzz [--count 2000] [--seed 0] [--target exr ...] [--json]

Runs in a process of its own with bounded address space; a crash of a reader ends it, and the parent says which file.
Exit code 0 when nothing escaped. Anything but UserError and ContractError counts as escaped.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools.faults.mutate import mutate_bytes, mutate_json

ADDRESS_SPACE = 12 << 30  # torch, numpy and OpenEXR reserve a few GB without touching them
MEMORY_MB = 1500
SECONDS = 5.0
"""CPU time one file may take."""


@dataclass(frozen=True)
class Target:
    """A format: ``good`` bytes of a file called ``name``, and what reads it. text: mutated as JSON."""

    name: str
    good: bytes
    read: Callable[[Path], Any]
    text: bool = False


def targets(folder: Path) -> dict[str, Target]:
    """All formats, made small in ``folder``; readers are the functions that commands use."""
    import numpy as np
    import torch

    from dnrpipe.blender.geometry.frozen import load_geometry
    from dnrpipe.core.cameras import own_splits, read_camera_file
    from dnrpipe.core.ledger import Ledger
    from dnrpipe.core.settings import CameraSettings
    from dnrpipe.core.workspace import Manifest, Source, Workspace
    from dnrpipe.raytrace.light_worker import read_light
    from dnrpipe.stages.base_images import BaseRenderer
    from dnrpipe.stages.verify import _picture
    from dnrtrain import checkpoint
    from dnrtrain.contract import SceneFrame, View, read_cameras, write_cameras
    from dnrtrain.display import DisplayTransform
    from dnrtrain.exr import read_exr, read_metadata, write_exr
    from dnrtrain.model import DNR
    from dnrtrain.records import ModelRecord
    from dnrtrain.settings import ModelSettings

    dice = np.random.default_rng(0)
    found: dict[str, Target] = {}

    def keep(kind: str, path: Path, read: Callable[[Path], Any], *, text: bool = False) -> None:
        found[kind] = Target(path.name, path.read_bytes(), read, text)

    path = folder / "a.exr"
    write_exr(path, {"R": dice.random((9, 7)), "mask": np.zeros((9, 7))}, {"fingerprint": "f"})
    keep("exr", path, lambda p: (read_metadata(p), read_exr(p)))

    view = View(name="a", width=8, height=8, fl_x=8, fl_y=8, cx=4, cy=4, c2w=tuple(map(tuple, np.eye(4).tolist())))
    path = folder / "train.json"
    write_cameras(path, [view, view.model_copy(update={"name": "b"})], "train")

    def cameras(p: Path) -> None:
        views = read_camera_file(p, CameraSettings())
        own_splits(p, views)
        read_cameras(p)

    keep("cameras", path, cameras, text=True)

    workspace = Workspace(folder, Manifest(source=Source(path="/a.blend", sha256="0" * 64)))  # pyright: ignore[reportCallIssue]
    workspace.finish_stage(
        "prepare", fingerprint="f", output="o", seconds=1.0, detail={"views": {"train": 6, "val": 1, "test": 2}}
    )
    workspace.manifest.overrides = {"select": {"budget": 3}}
    workspace.save()
    keep("manifest", folder / "manifest.json", _status, text=True)

    path = folder / "frame.json"
    frame = SceneFrame(near=1, far=2, center=(0, 0, 0), radius=1, display_lut="display.npz")
    path.write_text(frame.model_dump_json())
    lut = np.zeros((3, 3, 3, 3), np.float32)
    np.savez_compressed(folder / "display.npz", lut=lut, max=np.float32(16), k=np.float32(50))
    keep("display", folder / "display.npz", lambda p: DisplayTransform(frame.model_copy(), p.parent))

    def scene_frame(p: Path) -> None:
        from dnrpipe.core.scene_files import read_frame

        place = p.parent / "scene"
        place.mkdir(exist_ok=True)
        (place / "frame.json").write_bytes(p.read_bytes())
        read_frame(Workspace(p.parent, Manifest(source=Source(path="/a", sha256="0"))))  # pyright: ignore[reportCallIssue]

    keep("frame", path, scene_frame, text=True)

    path = folder / "selection.json"
    path.write_text(json.dumps({"policy": "farthest", "budget": 1, "seed": 0, "views": ["a"], "details": {}}))
    keep("selection", path, _selection, text=True)

    model = DNR(ModelSettings(texture_size=8, texture_channels=12, width=4, depth=1, texture_levels=2), seed=0)
    record = ModelRecord(
        model=model.settings.model_dump(), fingerprint="f", run="r", stage="step2", settings={}, seed=0,
        bfloat16=False, history=[],
    )  # fmt: skip
    checkpoint.save_model(folder / "model", model, record)
    weights, book = (folder / "model" / name for name in ("model.safetensors", "model.json"))

    def load_model(p: Path) -> None:
        place = p.parent / "model"
        place.mkdir(exist_ok=True)
        for good in (weights, book):
            (place / good.name).write_bytes(p.read_bytes() if good.name == p.name else found_bytes[good.name])
        checkpoint.load_model(place)

    found_bytes = {path.name: path.read_bytes() for path in (weights, book)}
    keep("safetensors", weights, load_model)
    keep("model", book, load_model, text=True)
    checkpoint.save(folder / "state.safetensors", {"a": torch.zeros(4)}, {"run": "r", "epoch": 1})
    keep("state", folder / "state.safetensors", lambda p: checkpoint.load(p))

    path = folder / "light.npz"
    np.savez(path, light=np.zeros((2, 4, 4, 3), np.float32), fingerprint=np.array("f"))

    def read_baked(path: Path) -> None:
        _ = BaseRenderer({}, {}, {"output": str(path), "fingerprint": "f"}, "f").light_is_baked
        read_light(path)

    keep("light", path, read_baked)
    path = folder / "geometry.npz"
    path.write_bytes(_geometry(folder))
    keep("geometry", path, load_geometry)

    path = folder / "costs.jsonl"
    line = {
        "time": 1.0,
        "run": "r",
        "stage": "prepare",
        "purpose": "training",
        "unit": "view",
        "name": "a",
        "seconds": 1,
    }
    path.write_text("\n".join(json.dumps(line) for _ in range(3)) + "\n")
    keep("ledger", path, lambda p: (Ledger(p).read(), Ledger(p).truncated_records()))

    from PIL import Image

    Image.fromarray(dice.integers(0, 255, (9, 7, 3), dtype=np.uint8)).save(folder / "a.png")
    keep("png", folder / "a.png", _picture)
    return found


def _geometry(folder: Path) -> bytes:
    import numpy as np

    from dnrpipe.blender.geometry.frozen import FrozenMesh, save_geometry

    flat = np.zeros((2, 3, 3), np.float32)
    mesh = FrozenMesh(
        name="a", object_name="a", object_id=1, positions=flat, normals=flat,
        material_index=np.zeros(2, np.int32), materials=["m"], uv_layers={"UVMap": flat[..., :2]}, active_uv="UVMap",
        atlas=flat[..., :2], colors={}, active_color=None, object_to_world=np.eye(4),
        texture_space=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), copies=np.eye(4)[None],
    )  # fmt: skip
    save_geometry(folder / "made.npz", [mesh])
    return (folder / "made.npz").read_bytes()


def _status(path: Path) -> None:
    """What `dnrpipe status` and `costs` do with a manifest."""
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.stages.pipeline import status
    from dnrpipe.stages.session import resolve_settings

    workspace = Workspace.open(path.parent)
    status(workspace, resolve_settings(workspace, {}, None))


def _selection(path: Path) -> None:
    import numpy as np

    from dnrpipe.core.scene_files import read_selection
    from dnrpipe.core.workspace import Manifest, Source, Workspace
    from dnrtrain.contract import View, write_cameras

    workspace = Workspace(path.parent, Manifest(source=Source(path="/a", sha256="0")))  # pyright: ignore[reportCallIssue]
    view = View(name="a", width=8, height=8, fl_x=8, fl_y=8, cx=4, cy=4, c2w=tuple(map(tuple, np.eye(4).tolist())))
    if not workspace.cameras("train").exists():
        write_cameras(workspace.cameras("train"), [view], "train")
    read_selection(workspace)


def fuzz(kind: str, target: Target, folder: Path, count: int, seed: int) -> dict[str, Any]:
    """Read ``count`` mutations; how many were read, refused, escaped (with the first errors that did)."""
    from dnrpipe.core.errors import UserError
    from dnrtrain.contract import ContractError

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / target.name
    path.write_bytes(target.good)
    target.read(path)  # the unchanged file must read: a fuzz of nonsense finds nothing
    tally: dict[str, Any] = {"read": 0, "refused": 0, "escaped": 0, "errors": [], "slowest": 0.0}
    for number in range(count):
        dice = random.Random(f"{kind}/{seed}/{number}")
        data = mutate_json(target.good.decode(), dice) if target.text else mutate_bytes(target.good, dice)
        path.write_bytes(data)
        started = time.process_time()
        try:
            target.read(path)
            tally["read"] += 1
        except (UserError, ContractError) as error:
            tally["refused"] += 1
            if "\n" in str(error) or not str(error):
                _escaped(tally, number, f"not one line: {error!r}")
        except Exception as error:  # what must not happen, whatever it is
            _escaped(tally, number, f"{type(error).__name__}: {error}")
        seconds = time.process_time() - started
        tally["slowest"] = max(tally["slowest"], seconds)
        if seconds > SECONDS:
            _escaped(tally, number, f"took {seconds:.1f} s")
    return tally


def _escaped(tally: dict[str, Any], number: int, text: str) -> None:
    tally["escaped"] += 1
    if len(tally["errors"]) < 5:
        tally["errors"].append(f"#{number}: {text[:300]}")


def run_here(names: list[str], count: int, seed: int) -> dict[str, Any]:
    """All targets in this process, whose address space is bounded from here on."""
    import os

    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    # OpenEXR's C code writes what it thinks of each file on standard error.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    with tempfile.TemporaryDirectory() as scratch:
        made = targets(Path(scratch))
        results = {
            kind: fuzz(kind, target, Path(scratch) / "mutated" / kind, count, seed)
            for kind, target in made.items()
            if not names or kind in names
        }
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"targets": results, "peak_mb": peak}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000, help="mutations per format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", action="append", default=[], help="one format only; repeatable")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        print(json.dumps(run_here(options.target, options.count, options.seed)))
        return 0
    command = [sys.executable, "-m", "tools.faults.fuzz", "--here", *sys.argv[1:]]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        print(f"the reading process ended with {done.returncode}: a reader crashed it", file=sys.stderr)
        return 1
    answer = json.loads(done.stdout)
    print(json.dumps(answer, indent=2) if options.json else table(answer))
    good = all(not row["escaped"] for row in answer["targets"].values()) and answer["peak_mb"] < MEMORY_MB
    return 0 if good else 1


def table(answer: dict[str, Any]) -> str:
    """The results as Markdown."""
    lines = ["| format | files | read | refused in one line | escaped |", "|---|---|---|---|---|"]
    for kind, row in answer["targets"].items():
        total = row["read"] + row["refused"]
        lines.append(f"| {kind} | {total} | {row['read']} | {row['refused']} | {row['escaped']} |")
        lines += [f"|  | {error} | | | |" for error in row["errors"]]
    lines.append(f"\nPeak memory {answer['peak_mb']:.0f} MB.")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
