"""Which rasteriser this machine can run. Imports no bpy: the trial runs in a subprocess."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from typing import NamedTuple

from dnrpipe.core.errors import UserError
from dnrpipe.core.machine import remember, remembered
from dnrpipe.workers.processes import how_ended

from ..tasks import RasterTrial

ENGINES = ("eevee", "workbench", "cycles-direct")
TIMEOUT = 120.0  # seconds
NO_ANSWER = "no frame within"
SLOWEST_FRAME = 1.0  # seconds per 256² frame (a GPU: milliseconds); beyond it direct light is the better bargain


def choose_raster(requested: str) -> tuple[str, str]:
    """The engine to rasterise with, and why. ``requested``: auto, eevee, workbench or cycles-direct.

    auto is EEVEE if it survives a trial and a 256² frame takes at most SLOWEST_FRAME, else Cycles with
    direct light only. Raises UserError when a requested engine does not run here, or is unknown.
    """
    if requested == "cycles-direct":
        return requested, "requested"
    if requested in ENGINES:
        trial = try_engine(requested)
        if trial.seconds is not None:
            return requested, "requested"
        raise UserError(
            f"raster engine '{requested}' does not run here: {trial.reason}; install libegl1 and "
            "libgl1-mesa-dri, or use --set passes.raster=cycles-direct"
        )
    if requested != "auto":
        raise UserError(f"unknown raster engine '{requested}'; choose auto, {', '.join(ENGINES)}")
    trial = try_engine("eevee")
    if trial.seconds is None:
        return "cycles-direct", f"EEVEE does not run here: {trial.reason}"
    if trial.seconds > SLOWEST_FRAME:
        return "cycles-direct", f"EEVEE takes {trial.seconds:.1f} s per 256x256 frame here"
    return "eevee", f"EEVEE takes {trial.seconds:.2f} s per 256x256 frame here"


class Trial(NamedTuple):
    """seconds: of a frame; None where the engine does not run, for a reason."""

    seconds: float | None
    reason: str = ""


@functools.cache
def try_engine(engine: str) -> Trial:
    """Render two small frames with ``engine`` in a subprocess, once per machine and driver (`machine.remembered`)."""
    name = f"raster-{engine}"
    if (kept := remembered(name)) is not None:
        return Trial(*kept)
    trial = _try(engine)
    if not trial.reason.startswith(NO_ANSWER):  # a busy machine is no property of the driver
        remember(name, trial)
    return trial


def _try(engine: str) -> Trial:
    command = [sys.executable, "-m", "dnrpipe.blender.passes.probe", engine]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        return Trial(None, f"{NO_ANSWER} {TIMEOUT:.0f} s")
    reason = f"its trial {how_ended(done.returncode)}"
    if done.returncode < 0:
        return Trial(None, reason)
    lines = [line for line in done.stdout.splitlines() if line.startswith('{"ok"')]
    if done.returncode == 0 and lines:
        answer: RasterTrial = json.loads(lines[-1])
        return Trial(answer["seconds_next"]) if answer["ok"] else Trial(None, "its trial frame is empty")
    errors = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return Trial(None, f"{reason} ({errors[-1][:200]})" if errors else reason)
