"""Choose the Mitsuba variant: cuda -> llvm -> scalar, each probed in a process of its own.

Dr.Jit aborts the whole process on a missing driver or an unsuitable LLVM (15 and 16 fail inside Mitsuba
3.9 on some CPUs, 14 is refused), so nothing is tried in the caller's process.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ..core.errors import UserError
from ..core.machine import remember, remembered

ORDER = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
PROBE_TIMEOUT = 120.0


@dataclass(frozen=True)
class VariantChoice:
    """A variant that rendered a test scene here, the environment it needs, and why not a faster one."""

    variant: str
    environment: dict[str, str]
    reason: str


@cache
def choose_variant(requested: str = "auto") -> VariantChoice:
    """The first variant of ``ORDER`` that renders here, or the requested one.

    Raises UserError: none works, or the requested one does not.
    """
    refused: list[str] = []
    for variant in ORDER if requested == "auto" else (requested,):
        for environment in _environments(variant):
            problem = _probe(variant, environment)
            if problem is None:
                library = environment.get("DRJIT_LIBLLVM_PATH", "")
                reason = "; ".join([f"{variant} works" + (f" with {library}" if library else ""), *refused])
                return VariantChoice(variant, environment, reason)
            refused.append(f"{variant}: {problem}")
    wanted = "no Mitsuba variant" if requested == "auto" else f"Mitsuba variant {requested} does not"
    raise UserError(
        f"{wanted} render{'s' if requested == 'auto' else ''} on this machine"
        f" ({'; '.join(refused)}); run `dnrpipe doctor`"
    )


def llvm_libraries() -> list[Path]:
    """LLVM shared libraries of this machine, newest first; those known to abort Mitsuba 3.9 left out."""
    found: dict[int, Path] = {}
    named = [Path(p) for p in ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")]
    usual = Path("/usr/lib")
    for folder in (*named, *sorted(usual.glob("*-linux-gnu")), *sorted(usual.glob("llvm-*/lib"))):
        for path in sorted(folder.glob("libLLVM*.so*")):
            match = re.match(r"libLLVM(?:\.so\.|-)(\d+)", path.name)
            if match and int(match.group(1)) >= 17:
                found.setdefault(int(match.group(1)), path)
    return [found[version] for version in sorted(found, reverse=True)]


def _environments(variant: str) -> list[dict[str, str]]:
    if not variant.startswith("llvm") or "DRJIT_LIBLLVM_PATH" in os.environ:
        return [{}]
    libraries = [{"DRJIT_LIBLLVM_PATH": str(path)} for path in llvm_libraries()]
    # Without a library known to be good, let Dr.Jit look for itself (macOS, Windows, odd prefixes).
    return libraries or ([{}] if ctypes.util.find_library("LLVM") or sys.platform != "linux" else [])


def _probe(variant: str, environment: dict[str, str]) -> str | None:
    """None when a small scene renders to finite, lit pixels; else one line on what went wrong.

    What works is remembered per machine and driver. What does not is tried again: a GPU may have been full.
    """
    if variant.startswith("cuda") and sys.platform == "linux":
        library = os.environ.get("DRJIT_LIBCUDA_PATH", "libcuda.so.1")
        try:
            ctypes.CDLL(library)
        except OSError:
            return f"no CUDA driver ({library})"
    name = f"mitsuba-{variant}"
    if remembered(name) == environment:
        return None
    problem = _try(variant, environment)
    if problem is None:
        remember(name, environment)
    return problem


def _try(variant: str, environment: dict[str, str]) -> str | None:
    try:
        done = subprocess.run(
            [sys.executable, "-m", "dnrpipe.raytrace.probe", variant],
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {PROBE_TIMEOUT:.0f} s"
    for line in reversed(done.stdout.splitlines()):
        if line.startswith("{"):
            answer = json.loads(line)
            return None if answer["ok"] else str(answer["error"])
    tail = [line for line in done.stderr.splitlines() if line.strip()]
    return f"ended with exit code {done.returncode}" + (f" ({tail[-1].strip()[:120]})" if tail else "")
