"""The corrector that comes with the package: trained on many scenes, for scenes that it never saw (model-card.md)."""

from __future__ import annotations

from pathlib import Path

import torch

from .. import checkpoint
from ..contract import ContractError
from ..model import DNR
from ..precision import decide_bfloat16
from ..records import ModelRecord
from ..settings import ModelSettings, Step2Settings
from ..textures import TexturePyramid

WEIGHTS = Path(__file__).with_name("corrector.safetensors")
"""float16; the settings are in its header. `tools.pretrain.train` makes it."""


def corrector(path: Path = WEIGHTS, precision: str = "auto") -> DNR:
    """The shipped corrector, or another that was trained as it was, on the CPU, ready for inference.

    precision: of its convolutions, see `decide_bfloat16`. bfloat16 halves the time and moves a picture by 1e-4.
    Raises DamagedFile: its file is.
    """
    saved = checkpoint.load(path)
    if saved is None:
        raise ContractError(f"{path}: is missing; install dnrpipe again")
    tensors, info = saved
    model = DNR(ModelSettings.model_validate(info["settings"]), seed=0)
    model.load_state_dict({name: value.float() for name, value in tensors.items()})
    model.use_bfloat16 = decide_bfloat16(precision, "cpu")
    return model.eval()


def save_untrained(folder: Path, model: DNR, step2: Step2Settings, fingerprint: str) -> None:
    """Write the shipped corrector ``model`` as the model of step 2, as if it had been trained on no view."""
    record = ModelRecord(
        model=model.settings.model_dump(mode="json"),
        fingerprint=fingerprint,
        run=fingerprint,
        stage="step2",
        settings=step2.model_dump(mode="json"),
        seed=0,
        bfloat16=model.use_bfloat16,
        history=[],
        views=[],
    )
    checkpoint.save_model(folder, model, record)


def with_corrector(settings: ModelSettings, seed: int) -> DNR:
    """A model of these settings that begins as the shipped corrector: what it has besides starts at zero.

    Raises ContractError: the settings are of another network, which the message names.
    """
    if conflict := settings.unlike_corrector():
        raise ContractError(conflict)
    model = DNR(settings, seed)
    model.load_state_dict(corrector().state_dict(), strict=False)
    with torch.no_grad():
        for part in model.modules():
            if isinstance(part, TexturePyramid):
                for level in part.levels:
                    level.zero_()
    return model
