"""Short-lived EXR files between Blender's processes and numpy. No bpy here."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

RAM_DISK = Path("/dev/shm")
PREFIX = "dnrpipe-passes-"  # then the process id
BYTES_PER_PIXEL = 15 * 4  # the G-buffer file, the largest


@contextmanager
def scratch_folder(pixels: int) -> Iterator[Path]:
    """A temporary folder for render outputs: on the RAM disk when four such files fit there, else on disk."""
    need = 4 * pixels * BYTES_PER_PIXEL
    fits = RAM_DISK.is_dir() and os.access(RAM_DISK, os.W_OK) and shutil.disk_usage(RAM_DISK).free > need
    # Temporary folders whose process was killed: nothing else frees the memory that they hold.
    for folder in RAM_DISK.glob(f"{PREFIX}*-*") if fits else ():
        owner = folder.name.removeprefix(PREFIX).partition("-")[0]
        if owner.isdigit() and not Path("/proc", owner).exists():
            shutil.rmtree(folder, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=f"{PREFIX}{os.getpid()}-", dir=RAM_DISK if fits else None) as made:
        yield Path(made)


def read_channels(path: Path, prefix: str = "") -> dict[str, np.ndarray]:
    """All channels of an EXR file, float32 [H, W], row 0 on top; ``prefix`` is taken off their names."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    return {name.removeprefix(prefix): values for name, values in channels.items()}
