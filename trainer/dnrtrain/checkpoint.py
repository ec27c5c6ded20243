"""Checkpoints and final models: safetensors + JSON, written atomically.

state.safetensors   after every epoch: weights, Adam's moments; JSON in its header (one file, so that
                    tensors and counters can never disagree); deleted when the stage is done
model.safetensors   final weights; the fingerprint in its header
(both with a SHA-256 of their tensors in the header: safetensors itself notices a wrong length only)
model.json          settings, fingerprint, history; written last, so its presence means "complete"
"""

from __future__ import annotations

import errno
import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from . import records
from .atomic import atomic_path
from .contract import ContractError, DamagedFile
from .model import DNR
from .records import ModelRecord, Progress
from .settings import ModelSettings
from .text import one_line

HEADER = "dnrtrain"
CHECKSUM = "sha256"
STATE = "state.safetensors"
Parts = dict[str, dict[str, Tensor]]
"""Tensors by name, by what they are of: a module, an optimiser."""


@dataclass(frozen=True)
class State:
    """An unfinished training: its parts (on the CPU), and how far it is."""

    parts: Parts
    progress: Progress


def save(path: Path, tensors: Mapping[str, Tensor], info: Mapping[str, Any]) -> None:
    """Write tensors and JSON into one safetensors file, atomically. NaN in ``info`` is refused."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # One entry: safetensors writes several in random order, and the same weights must be the same bytes.
    header = {HEADER: json.dumps({**info, CHECKSUM: checksum(plain)}, allow_nan=False)}
    try:
        with atomic_path(path) as temporary:
            save_file(plain, temporary, metadata=header)
    except SafetensorError as error:  # hides the system's reason in its text
        number = errno.ENOSPC if f"os error {errno.ENOSPC}" in str(error) else errno.EIO
        raise OSError(number, str(error), str(path)) from None


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """The tensors (on the CPU) and the JSON of `save`; None without the file. Raises DamagedFile: it does not read."""
    if not Path(path).exists():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            info = json.loads((file.metadata() or {})[HEADER])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, RuntimeError, RecursionError) as error:
        raise DamagedFile(path, str(error)) from None
    if not isinstance(info, dict):
        raise DamagedFile(path, "its header holds no JSON object")
    if info.pop(CHECKSUM, "") not in ("", checksum(tensors)):
        raise DamagedFile(path, "weights are not those that were written")
    return tensors, info


def checksum(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and bytes, in order of names."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's state as flat named tensors: ``{parameter index}.{step|exp_avg|exp_avg_sq}``."""
    state = optimiser.state_dict()["state"]
    return {f"{index}.{name}": value for index, entry in state.items() for name, value in entry.items()}


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Inverse of `optimiser_tensors`; the parameter groups stay as they are.

    Fused Adam walks parameters and moments by memory address, so moments take their parameter's strides
    (channels-last): files hold them contiguous.
    """
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for full_name, value in tensors.items():
        number, name = full_name.split(".", 1)
        index = int(number)
        if name != "step":
            value = torch.empty_like(parameters[index]).copy_(value)
        state.setdefault(index, {})[name] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def save_state(folder: Path, parts: Parts, progress: Progress) -> None:
    tensors = {f"{part}/{name}": tensor for part, tensors in parts.items() for name, tensor in tensors.items()}
    save(folder / STATE, tensors, progress.data())
    records.write(folder / records.PROGRESS, progress)


def load_state(folder: Path, run: str) -> State | None:
    """The state of the run's last whole epoch, or None when there is none. Raises DamagedFile."""
    saved = load(folder / STATE)
    if saved is None:
        return None
    tensors, info = saved
    try:
        progress = Progress.model_validate(info)
    except ValidationError as error:
        raise DamagedFile(folder / STATE, error.errors()[0]["msg"]) from None
    parts: Parts = defaultdict(dict)
    for name, tensor in tensors.items():
        part, _, own = name.partition("/")
        parts[part][own] = tensor
    return State(parts, progress) if progress.run == run else None


def save_model(folder: Path, model: DNR, record: ModelRecord) -> None:
    """Write ``model.safetensors``, then ``model.json``; drop the epoch state."""
    save(folder / "model.safetensors", model.state_dict(), {"fingerprint": record.fingerprint})
    records.write(folder / records.MODEL, record)
    (folder / STATE).unlink(missing_ok=True)
    (folder / records.PROGRESS).unlink(missing_ok=True)


def read_record(folder: Path) -> ModelRecord | None:
    """``model.json`` of a finished stage, or None when it is missing, damaged or of other weights."""
    try:
        record = records.read(folder / records.MODEL, ModelRecord)
        with safe_open(folder / "model.safetensors", framework="pt") as file:
            header = json.loads((file.metadata() or {})[HEADER])
        return record if record.fingerprint == header["fingerprint"] else None
    except (OSError, SafetensorError, KeyError, ValueError, TypeError, RecursionError):
        return None


def finished_record(folder: Path) -> ModelRecord:
    """Of a training that has just finished."""
    record = read_record(folder)
    assert record is not None
    return record


def step_seconds(record: ModelRecord, warm: int = 1) -> tuple[float, float]:
    """(wall, processor) seconds of an optimiser step, without the first ``warm`` epochs where there are more."""
    epochs = record.history[warm:] or record.history
    steps = sum(epoch.steps for epoch in epochs)
    return sum(epoch.seconds for epoch in epochs) / steps, sum(epoch.cpu_seconds for epoch in epochs) / steps


def load_model(folder: Path, device: str | torch.device = "cpu") -> DNR:
    """A finished stage's renderer, ready for inference.

    Raises:
        ContractError: nothing there, or it does not fit this version.
        DamagedFile: damaged, or weights and model.json are of different runs.
    """
    path = Path(folder) / "model.safetensors"
    record, saved = read_record(folder), load(path)
    if saved is not None and record is None:
        raise DamagedFile(path, "model.json is missing, damaged or of other weights")
    if record is None or saved is None:
        raise ContractError(f"{folder}: holds no finished model; run `dnrpipe finetune` (again)")
    try:
        settings = ModelSettings.model_validate(record.model)
        # The model is made before its weights are put in: a few bytes of JSON must not make it take 70 GB.
        texels = 0 if settings.aggregator in ("early", "none") else settings.texture_size**2 * settings.texture_channels
        if texels > max((tensor.numel() for tensor in saved[0].values()), default=0):
            raise ValueError(f"textures of {settings.texture_size} texels, but no tensor of {texels} numbers")
        model = DNR(settings, seed=0)
        model.load_state_dict(saved[0])
    except (ValidationError, RuntimeError, KeyError, ValueError) as error:
        reason = one_line(error)[:200]
        raise ContractError(f"{folder}: model does not fit this version ({reason}); train it again") from None
    model.use_bfloat16 = record.bfloat16
    return model.to(device).eval()
