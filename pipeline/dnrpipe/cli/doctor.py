"""`dnrpipe doctor`: what works on this machine, and what to install for what does not."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from ..core.errors import UserError
from ..core.machine import forget_all, memory_bytes

APT_LINE = (
    "apt-get install -y libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1"
    " libatomic1 libllvm19 libegl1 libgl1-mesa-dri"
)
MIN_FREE_GB = 2
TORCH_CODE = (
    "import torch; g = torch.cuda.is_available();"
    "where = torch.cuda.get_device_name() if g else f'{torch.get_num_threads()} CPU threads';"
    "print(torch.__version__, 'on', where)"
)


def examine() -> list[dict[str, Any]]:
    """One row per check: name, state (ok, warn, fail), text. Renderers are tried anew, in their own processes."""
    forget_all()
    return [
        _row("python", "ok", f"{platform.python_version()} on {platform.platform()}"),
        _machine(),
        _disk(),
        _import_check("bpy", "import bpy; print(bpy.app.version_string)", "render"),
        _raster(),
        _mitsuba(),
        _import_check(
            "denoiser",
            "import mitsuba_oidn as o; print('Open Image Denoise', o.oidn_version(), 'on the CPU')",
            "render",
        ),
        _import_check("torch", TORCH_CODE, "train"),
        _weights(),
        _module("OpenEXR", "OpenEXR"),
        _module("flip-evaluator", "flip_evaluator"),
        _module("ffmpeg", "imageio_ffmpeg"),
    ]


def _row(name: str, state: str, text: str) -> dict[str, Any]:
    return {"name": name, "state": state, "text": text}


def _machine() -> dict[str, Any]:
    memory = memory_bytes()
    told = "" if memory is None else f", {memory / 2**30:.0f} GiB memory"
    return _row("machine", "ok", f"{os.cpu_count()} cores{told}")


def _disk() -> dict[str, Any]:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    return _row("disk", "ok" if free >= MIN_FREE_GB else "warn", f"{free:.1f} GiB free in {Path.cwd()}")


def _import_check(name: str, code: str, extra: str) -> dict[str, Any]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    if done.returncode == 0:
        return _row(name, "ok", done.stdout.strip().splitlines()[-1])
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    reason = lines[-1].strip() if lines else f"exit code {done.returncode}"
    fix = f"pip install 'dnrpipe[{extra}]'" if "No module named" in reason else APT_LINE
    return _row(name, "fail", f"{reason}; try: {fix}")


def _raster() -> dict[str, Any]:
    from ..blender.passes.choice import choose_raster

    try:
        engine, reason = choose_raster("auto")
    except UserError as error:
        return _row("raster colour", "fail", str(error))
    return _row("raster colour", "ok" if engine == "eevee" else "warn", f"{engine}: {reason}")


def _mitsuba() -> dict[str, Any]:
    from ..raytrace.variants import choose_variant

    try:
        choice = choose_variant()
    except UserError as error:
        return _row("mitsuba", "fail", f"{error}; try: {APT_LINE}")
    slow = choice.variant == "scalar_rgb"
    return _row("mitsuba", "warn" if slow else "ok", choice.reason + (f"; faster with: {APT_LINE}" if slow else ""))


def _weights() -> dict[str, Any]:
    try:
        from dnrtrain.weights import WeightsMissing, load_weights
    except ModuleNotFoundError as error:
        return _row("weights", "fail", f"{error}; try: pip install 'dnrpipe[train]'")
    try:
        load_weights()
    except WeightsMissing:
        return _row("weights", "warn", "VGG16/LPIPS weights are not cached; run `dnrpipe weights`")
    return _row("weights", "ok", "VGG16, AlexNet and LPIPS weights are cached")


def _module(name: str, module: str) -> dict[str, Any]:
    if importlib.util.find_spec(module) is None:
        return _row(name, "fail", "not installed; try: pip install 'dnrpipe[render]'")
    return _row(name, "ok", importlib.metadata.version(module.replace("_", "-")))
