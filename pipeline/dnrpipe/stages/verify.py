"""Check every file of a workspace: does it read, is it what was written, do the parts fit together?

EXRs and weights carry checksums of their contents; ``scene/prepared.json`` those of the converted scene. JSON, pictures
and archives must read. Nothing is rendered and nothing is executed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dnrtrain.contract import NPZ_ERRORS, SPLITS, ContractError, DamagedFile, read_cameras
from dnrtrain.exr import read_exr

from ..core.console import Console
from ..core.errors import UserError
from ..core.scene_files import read_conversion, read_frame, read_json, read_selection
from ..core.workspace import Workspace, file_sha256
from .base_images import light_path
from .pipeline import STAGES, discard, owner_of


@dataclass(frozen=True)
class Fault:
    """One file with something wrong.

    stage: the command that makes it again, or None. leftover: left by a run that was killed.
    """

    path: Path
    reason: str
    stage: str | None = None
    leftover: bool = False


def examine(workspace: Workspace, console: Console) -> tuple[int, list[Fault]]:
    """Read all files of the workspace -> (files checked, what is wrong with any). Raises nothing for damage."""
    work = list(_checks(workspace))
    faults: list[Fault] = []
    with console.bar("checking files", len(work)) as bar:
        for path, check in work:
            try:
                bar.advance(note=path.name)
                check(path)
            except DamagedFile as damage:
                if damage.path != path:  # a file that this one refers to; it has its own check
                    continue
                faults.append(_fault(workspace, path, f"damaged ({damage.reason})"))
            except (ContractError, UserError, OSError) as error:
                faults.append(_fault(workspace, path, str(error).removeprefix(f"{path}: ")))
    # Temporary names of `dnrtrain.atomic.atomic_path` whose process has gone.
    leftovers = sorted(path for path in workspace.root.rglob(".*.tmp*") if path.is_file())
    faults += [Fault(path, "left behind by a run that was killed", None, True) for path in leftovers]
    return len(work), faults


def _fault(workspace: Workspace, path: Path, reason: str) -> Fault:
    owner = owner_of(path, workspace)
    return Fault(path, reason, owner.command if owner else None)


def repair(workspace: Workspace, faults: list[Fault]) -> list[str]:
    """Throw away what is damaged or left over -> the commands that make it again, in pipeline order.

    Files of no stage stay, but for leftovers: what they are is for their owner to say.
    """
    due = set()
    for fault in faults:
        owner = owner_of(fault.path, workspace)
        if fault.leftover or fault.path == light_path(workspace):
            fault.path.unlink(missing_ok=True)
        elif owner is not None:
            discard(fault.path, owner, workspace)
            due.add(owner.command)
    return [stage.command for stage in STAGES.values() if stage.command in due]


def _checks(workspace: Workspace) -> Iterator[tuple[Path, Callable[[Path], object]]]:
    """Each file that is there, with the function that raises when something is wrong with it."""
    root = workspace.root
    yield from ((path, read_cameras) for path in map(workspace.cameras, SPLITS) if path.exists())
    yield from _scene(workspace)
    for folder in ("passes", "raytraced", "base", "renders", "shots"):
        yield from ((path, read_exr) for path in sorted((root / folder).rglob("[!.]*.exr")))
    if workspace.selection.exists():
        yield workspace.selection, lambda _: read_selection(workspace)
    for step in ("step1", "step2"):
        folder = workspace.checkpoints(step)
        yield from ((path, _weights) for path in sorted(folder.glob("[!.]*.safetensors")))
        yield from ((path, read_json) for path in sorted(folder.glob("[!.]*.json")))
    for folder in ("evaluation", "renders", "shots"):
        yield from ((path, read_json) for path in sorted((root / folder).rglob("[!.]*.json")))
        yield from ((path, _picture) for path in sorted((root / folder).rglob("[!.]*.png")))
    if (light := light_path(workspace)).exists():
        yield light, _archive
    if workspace.ledger.path.exists():
        yield workspace.ledger.path, lambda path: _ledger(workspace, path)


def _scene(workspace: Workspace) -> Iterator[tuple[Path, Callable[[Path], object]]]:
    if not workspace.scene.exists():
        return
    yield workspace.scene / "prepared.json", lambda _: read_conversion(workspace.scene)
    yield workspace.scene / "frame.json", lambda _: read_frame(workspace)
    try:
        files = read_conversion(workspace.scene).files
    except (UserError, DamagedFile):
        return  # said by the check of the marker itself
    for name, wanted in files.items():
        path = workspace.scene / name
        if path.resolve().is_relative_to(workspace.scene.resolve()):
            yield path, lambda path, wanted=wanted: _same(path, wanted)


def _same(path: Path, wanted: str) -> None:
    if not path.is_file():
        raise DamagedFile(path, "is gone")
    if file_sha256(path) != wanted:
        raise DamagedFile(path, "is not what was written")


def _weights(path: Path) -> None:
    from dnrtrain.checkpoint import load, read_record

    load(path)
    if path.name == "model.safetensors" and read_record(path.parent) is None:
        raise DamagedFile(path, "model.json is missing, damaged or of other weights")


def _picture(path: Path) -> None:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise DamagedFile(path, f"PNG: {error}") from None


def _archive(path: Path) -> None:
    try:
        with np.load(path, allow_pickle=False) as data:
            for name in data.files:
                data[name]  # reads it, and compares zip's checksum
    except NPZ_ERRORS as error:
        raise DamagedFile(path, str(error)) from None


def _ledger(workspace: Workspace, path: Path) -> None:
    truncated = workspace.ledger.truncated_records()
    if truncated:
        raise DamagedFile(path, f"{truncated} lines do not read and are left out of all sums")
