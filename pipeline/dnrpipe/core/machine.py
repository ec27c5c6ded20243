"""What was found out about this machine, remembered between commands until its drivers or packages change.

<cache>/machine/<name>.json    {"machine": hash of what it depends on, "found": ...}
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from dnrtrain.atomic import write_json

from .workspace import digest

PACKAGES = ("bpy", "mitsuba", "drjit")
DRIVERS = ("libEGL*", "libGL*", "libLLVM*", "libcuda*", "libnvidia-gl*", "dri/*")
VECTORS = {"avx512f": "AVX-512", "avx2": "AVX2"}
"""Names of instruction sets by their flags, the widest first."""
VARIABLES = ("DISPLAY", "LIBGL_", "EGL_", "__EGL_", "__GLX_", "MESA_", "GALLIUM_", "CUDA_VISIBLE_DEVICES", "DRJIT_")
"""Beginnings of the names of environment variables that choose a driver."""


def cache_root() -> Path:
    """``$DNRPIPE_CACHE``, else ``~/.cache/dnrpipe``."""
    return Path(os.environ.get("DNRPIPE_CACHE") or Path.home() / ".cache" / "dnrpipe")


def remembered(name: str) -> Any:
    """What `remember` kept under ``name`` on this machine as it is now; None where there is nothing."""
    with suppress(OSError, ValueError):
        kept = json.loads(_path(name).read_bytes())
        if isinstance(kept, dict) and kept.get("machine") == machine_fingerprint():
            return kept.get("found")
    return None


def remember(name: str, found: Any) -> None:
    """Keep a JSON value. Where the cache cannot be written it is found out anew next time."""
    with suppress(OSError):
        write_json(_path(name), {"machine": machine_fingerprint(), "found": found})


def forget_all() -> None:
    """Everything is to be found out anew."""
    shutil.rmtree(cache_root() / "machine", ignore_errors=True)


@functools.cache
def machine_fingerprint() -> str:
    """Hash of the processor, the graphics and LLVM drivers, the packages, and the variables that choose among them."""
    variables = {name: value for name, value in os.environ.items() if name.startswith(VARIABLES)}
    return digest([platform.node(), os.cpu_count(), processor(), list(_versions()), list(_drivers()), variables])


def processor() -> str:
    """The processor's name and widest vectors, which decide how fast kernels are; the architecture's name where the
    system does not tell it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    told = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    flags = told.get("flags", "").split()
    vectors = next((name for flag, name in VECTORS.items() if flag in flags), None)
    name = told.get("model name", platform.machine())
    return f"{name}, {vectors}" if vectors else name


def memory_bytes() -> int | None:
    """The machine's memory; None where the system does not say."""
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return None
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _path(name: str) -> Path:
    return cache_root() / "machine" / f"{name}.json"


def _versions() -> Iterator[str]:
    for package in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            yield f"{package} {importlib.metadata.version(package)}"


def _drivers() -> Iterator[list[Any]]:
    with suppress(OSError):
        yield [Path("/proc/driver/nvidia/version").read_text()]
    yield sorted(path.name for path in Path("/dev/dri").glob("*"))
    for folder in (Path("/usr/lib64"), *sorted(Path("/usr/lib").glob("*-linux-gnu"))):
        for pattern in DRIVERS:
            for path in sorted(folder.glob(pattern)):
                with suppress(OSError):
                    found = path.stat()
                    yield [str(path), found.st_size, found.st_mtime_ns]
