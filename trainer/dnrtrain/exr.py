"""EXR files: float32 channels and one JSON metadata attribute, written atomically."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .atomic import atomic_path
from .contract import ContractError

METADATA_KEY = "dnrpipe.json"


def write_exr(path: Path, channels: Mapping[str, np.ndarray], metadata: Mapping[str, Any]) -> None:
    """Write channels (each float32 [H, W]) as ZIP-compressed scanline EXR.

    ``metadata`` is stored as JSON in the header attribute ``dnrpipe.json``.
    Raises ContractError when a channel is not finite: files never carry a hidden NaN.
    """
    import OpenEXR

    pixels: dict[str, np.ndarray] = {}
    for name, values in channels.items():
        array = np.ascontiguousarray(values, dtype=np.float32)
        if not np.isfinite(array).all():
            bad = int((~np.isfinite(array)).sum())
            raise ContractError(f"{path}: channel {name} has {bad} non-finite pixels")
        pixels[name] = array
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        METADATA_KEY: json.dumps(dict(metadata), sort_keys=True),
    }
    try:
        with atomic_path(path) as temporary, OpenEXR.File(header, pixels) as file:
            file.write(str(temporary))
    except RuntimeError as error:  # the binding hides the system's reason in its text
        if os.strerror(errno.ENOSPC) in str(error):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None
        raise OSError(errno.EIO, str(error), str(path)) from None


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read all channels (float32 [H, W]) and the JSON metadata ({} when there is none).

    Raises ContractError when the file is missing, truncated or not an EXR.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise ContractError(f"{path}: no such file")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {k: np.asarray(c.pixels, dtype=np.float32) for k, c in file.channels().items()}
            metadata = json.loads(file.header().get(METADATA_KEY, "{}"))
    except ContractError:
        raise
    except Exception as error:  # the binding raises bare RuntimeError/ValueError for every damage
        raise ContractError(f"{path}: damaged EXR ({error}); delete it and run the stage again") from None
    return channels, metadata


def read_metadata(path: Path) -> dict[str, Any] | None:
    """The JSON metadata of an EXR, or None when the file is missing or damaged (reads the header only)."""
    import OpenEXR

    if not Path(path).is_file():  # asked first: the library writes a line to standard error otherwise
        return None
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            return json.loads(file.header().get(METADATA_KEY, "{}"))
    except Exception:  # torn or foreign: the caller makes the file again
        return None
