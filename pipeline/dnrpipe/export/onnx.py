"""`dnrpipe export-onnx`: the trained renderer as one ONNX file, checked against torch on the workspace's own views."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch

from dnrtrain import onnx_export
from dnrtrain.atomic import atomic_path
from dnrtrain.checkpoint import load_model
from dnrtrain.contract import View
from dnrtrain.correction import to_log
from dnrtrain.exr import read_exr
from dnrtrain.model import DNR

from .. import __version__
from ..core.console import Console
from ..core.errors import UserError
from ..core.scene_files import read_frame, split_views
from ..core.workspace import Workspace
from ..stages.base_images import RENDERED, base_path
from ..stages.trainer import load
from ..stages.trust import SPLIT, trust_views

TOLERANCE = 1e-3
"""Largest difference from torch that passes: a quarter of an 8-bit step. Display space."""
CHECKED = 3
"""Views to compare; the last also at an odd size, since the file promises any."""
ODD = (61, 45)


def export_onnx(workspace: Workspace, out: Path, console: Console) -> dict[str, Any]:
    """Write the fine-tuned model to `out`, compare it with torch by onnxruntime, and return the differences.

    Raises UserError: no model, views without files, or the two differ by more than TOLERANCE; then `out` is not
    written.
    """
    if out.suffix != ".onnx" or out.is_dir():
        raise UserError(f"--out {out}: name a file that ends in .onnx")
    model = load_model(workspace.checkpoints("step2"))
    model.use_bfloat16 = False
    frame = read_frame(workspace)
    split, views = _views(workspace, model.settings.base)
    extra = {"dnrpipe": __version__, "view_transform": frame.view_transform, "near": frame.near, "far": frame.far}
    with atomic_path(out) as temporary:
        onnx_export.export_onnx(temporary, model, frame, workspace.scene, extra)
        with console.bar("comparing with torch", len(views)) as bar:
            found = [_compare(temporary, workspace, model, view, split, bar) for view in views]
        worst = max(row["difference"] for row in found)
        if not worst <= TOLERANCE:
            raise UserError(
                f"{out}: not written: its pictures differ from torch's by {worst:.2g}, more than {TOLERANCE:g}"
            )
    return {
        "file": str(out),
        "bytes": out.stat().st_size,
        "opset": onnx_export.OPSET,
        "inputs": {name: onnx_export.channel_count(name) for name in onnx_export.input_names(model.settings)},
        "outputs": onnx_export.output_names(model.settings),
        "largest_difference": worst,
        "views": found,
    }


def view_inputs(workspace: Workspace, view: View, split: str, base: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    """A view's files as the graph's inputs."""
    file = base_path(workspace, split, view.name) if base in RENDERED else workspace.passes(split, view.name)
    channels, _ = read_exr(file)
    if base == "raster":
        channels |= {f"base.{c}": channels[c] for c in "RGBA"}
    return onnx_export.graph_inputs(channels, view, names)


def _views(workspace: Workspace, base: str) -> tuple[str, list[View]]:
    """Some views that have all files, held-out ones first."""
    cameras = split_views(workspace) | {SPLIT: trust_views(workspace)}
    file = partial(base_path, workspace) if base in RENDERED else workspace.passes
    for split in ("test", "train", SPLIT):
        found = [view for view in cameras.get(split, []) if file(split, view.name).is_file()]
        if found:
            return split, found[:CHECKED]
    raise UserError(f"{workspace.root}: no view has its files; run `dnrpipe evaluate` first")


def _compare(path: Path, workspace: Workspace, model: DNR, view: View, split: str, bar: Any) -> dict[str, Any]:
    """Largest differences of one view's picture from torch's, whole and cut to an odd size; median milliseconds."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    base = model.settings.base
    batch = load(workspace, [view], split, base=base).batch([0])
    inputs = view_inputs(workspace, view, split, base, onnx_export.input_names(model.settings))
    height, width = (min(side, odd) for side, odd in zip((view.height, view.width), ODD, strict=True))
    differences, seconds = {}, []
    for name, rows, columns in (("whole", view.height, view.width), ("cut", height, width)):
        part = batch._map(lambda tensor, r=rows, c=columns: tensor[..., :r, :c])
        with torch.no_grad():
            output = model(part)
        given = {key: np.ascontiguousarray(value[..., :rows, :columns]) for key, value in inputs.items()}
        started = time.perf_counter()
        answers = session.run(None, given)
        seconds.append(time.perf_counter() - started)
        # Highlights of 1,000 differ by rounding alone by more than 1e-3: radiance is compared where the network works.
        expected = [output.rgb.clamp(0.0, 1.0)] + ([] if output.radiance is None else [to_log(output.radiance)])
        answers = [torch.from_numpy(answers[0]), *(to_log(torch.from_numpy(a)) for a in answers[1:])]
        differences[name] = max(float((a - b).abs().max()) for a, b in zip(answers, expected, strict=True))
    bar.advance(note=f"{max(differences.values()):.1e}")
    return {
        "name": view.name,
        "split": split,
        "difference": max(differences.values()),
        **differences,
        "milliseconds": 1000 * seconds[0],
    }
