"""What a workspace holds, apart from times: to compare a disturbed run with an undisturbed one."""

from __future__ import annotations

import json
from pathlib import Path


def contents(workspace: Path) -> dict[str, object]:
    """What a run made, without times: pixels of every EXR, the selection, metrics, bytes of the weights."""
    from dnrtrain.exr import read_exr

    found: dict[str, object] = {}
    for path in sorted(workspace.rglob("[!.]*.exr")):
        if path.is_relative_to(workspace / "scene"):
            continue
        channels, _ = read_exr(path)
        found[str(path.relative_to(workspace))] = {k: v.tobytes() for k, v in channels.items()}
    found["selection"] = json.loads((workspace / "selection.json").read_text())
    for path in sorted(workspace.rglob("model.safetensors")):
        found[str(path.relative_to(workspace))] = path.read_bytes()
    metrics = json.loads((workspace / "evaluation" / "metrics.json").read_text())
    found["metrics"] = [
        [round(v, 6) for k, v in sorted(row.items()) if isinstance(v, float) and not k.startswith("seconds")]
        for row in metrics["views"]
    ]
    return found


def forget(workspace: Path, stage: str) -> None:
    """Bring a finished workspace back to before ``stage``."""
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.stages.pipeline import STAGES, clear

    clear(STAGES[stage], Workspace.open(workspace))


def torn(workspace: Path) -> list[Path]:
    """Files under their final name that do not read: there must be none at any moment."""
    from safetensors import SafetensorError, safe_open

    from dnrtrain.contract import ContractError
    from dnrtrain.exr import read_exr

    found = []
    for path in workspace.rglob("[!.]*"):
        try:
            if path.suffix == ".exr" and not path.is_relative_to(workspace / "scene"):
                read_exr(path)
            elif path.suffix == ".json":
                json.loads(path.read_text())
            elif path.suffix == ".safetensors":
                with safe_open(path, framework="pt"):
                    pass
        except (ContractError, ValueError, SafetensorError):
            found.append(path)
        except FileNotFoundError:
            continue  # removed while we looked
    return found


def finished_units(workspace: Path) -> dict[Path, int]:
    """Whole files that workers made, with the time of their making: what a fault must not cost."""
    return {path: path.stat().st_mtime_ns for path in workspace.rglob("[!.]*.exr") if "scene" not in path.parts}
