"""EXR files: float32 channels and one JSON metadata attribute, written atomically; a checksum finds damage.

OpenEXR checks what it compresses (deflate's Adler-32), but stores blocks that do not shrink as they are. Hence a
checksum of names and pixels in the header.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .atomic import atomic_path
from .contract import ContractError, DamagedFile

METADATA_KEY = "dnrpipe.json"
CHECKSUM_KEY = "dnrpipe.sha256"
MAX_SIDE = 65536
LARGEST_HALF = 65504.0
MAX_CHANNELS = 256
MAX_RATIO = 1100
"""Decompressed over compressed size: deflate ends at 1032."""


def write_exr(
    path: Path, channels: Mapping[str, np.ndarray], metadata: Mapping[str, Any], half: Collection[str] = ()
) -> None:
    """Write channels (each float32 [H, W]) as ZIP-compressed scanline EXR.

    ``metadata`` is stored as JSON in the header attribute ``dnrpipe.json``. half: names of channels that are written in
    16 bits; what is larger than they hold becomes the largest that they do.
    Raises ContractError when a channel is not finite: files never carry a hidden NaN.
    """
    import OpenEXR

    pixels: dict[str, np.ndarray] = {}
    for name, values in channels.items():
        array = np.ascontiguousarray(values, dtype=np.float32)
        if not np.isfinite(array).all():
            bad = int((~np.isfinite(array)).sum())
            raise ContractError(f"{path}: channel {name} has {bad} non-finite pixels")
        pixels[name] = np.clip(array, -LARGEST_HALF, LARGEST_HALF).astype(np.float16) if name in half else array
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        METADATA_KEY: json.dumps(dict(metadata), sort_keys=True),
        CHECKSUM_KEY: checksum(pixels),
    }
    try:
        with atomic_path(path) as temporary, OpenEXR.File(header, pixels) as file:
            file.write(str(temporary))
    except RuntimeError as error:  # the binding hides the system's reason in its text
        if os.strerror(errno.ENOSPC) in str(error):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None
        raise OSError(errno.EIO, str(error), str(path)) from None


def compress_by(threads: int) -> None:
    """From here on, let OpenEXR compress by so many threads of this process; the bytes are the same by any number."""
    import OpenEXR

    if hasattr(OpenEXR, "set_global_thread_count"):  # versions before have no way to say so
        OpenEXR.set_global_thread_count(threads)


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read all channels (float32 [H, W]) and the JSON metadata ({} when there is none).

    The header's promises are weighed against the file's size before anything is allocated.

    Raises ContractError when the file is missing, DamagedFile when it is truncated, not an EXR, larger than its bytes
    can hold, or not what its checksum says.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise ContractError(f"{path}: no such file")
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            _refuse_bomb(file.header(), Path(path).stat().st_size)
        # The binding prints what is wrong with a file on standard output, where commands print their JSON.
        with (
            contextlib.redirect_stdout(io.StringIO()),
            OpenEXR.File(str(path), separate_channels=True) as file,
        ):
            channels = {k: np.asarray(c.pixels, dtype=np.float32) for k, c in file.channels().items()}
            header = file.header()
            metadata = _metadata(header)
    except Exception as error:  # the binding raises bare RuntimeError/ValueError for every damage
        raise DamagedFile(path, f"EXR: {error}") from None
    if header.get(CHECKSUM_KEY, "") not in ("", checksum(channels)):
        raise DamagedFile(path, "EXR: pixels are not those that were written")
    return channels, metadata


def checksum(channels: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of names, shapes and float32 values, in order of names."""
    digest = hashlib.sha256()
    for name in sorted(channels):
        values = np.ascontiguousarray(channels[name], dtype="<f4")
        digest.update(f"{name} {values.shape}\n".encode())
        digest.update(values.data)
    return digest.hexdigest()


def _refuse_bomb(header: Mapping[str, Any], size: int) -> None:
    """Raise ValueError where the header promises more pixels than ``size`` bytes can hold."""
    low, high = header["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    count = len(header["channels"])
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and 0 < count <= MAX_CHANNELS):
        raise ValueError(f"its header says {width}x{height} pixels of {count} channels")
    if 2 * width * height * count > MAX_RATIO * size:
        raise ValueError(f"its header says {width}x{height} pixels of {count} channels, which {size} bytes cannot hold")


def _metadata(header: Mapping[str, Any]) -> dict[str, Any]:
    found = json.loads(header.get(METADATA_KEY, "{}"))
    if not isinstance(found, dict):
        raise ValueError(f"{METADATA_KEY} is not a JSON object")
    return found


def read_metadata(path: Path) -> dict[str, Any] | None:
    """The JSON metadata of an EXR, or None when the file is missing or damaged (reads the header only)."""
    import OpenEXR

    if not Path(path).is_file():  # asked first: the library writes a line to standard error otherwise
        return None
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            return _metadata(file.header())
    except Exception:  # truncated or foreign: the caller makes the file again
        return None
