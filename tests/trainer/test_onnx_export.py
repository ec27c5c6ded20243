"""The ONNX file computes what torch computes, for every kind of model, at sizes it was not traced with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import torch

from dnrtrain.contract import BASE_CHANNELS, FRESH_CHANNELS, GBUFFER_CHANNELS, RASTER_CHANNELS, SceneFrame
from dnrtrain.correction import to_log
from dnrtrain.dataset import load_views
from dnrtrain.exr import write_exr
from dnrtrain.model import DNR
from dnrtrain.settings import ModelSettings

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

from dnrtrain.onnx_export import OPSET, export_onnx, graph_inputs, input_names  # noqa: E402

SMALL: dict[str, Any] = {"texture_size": 32, "texture_levels": 3, "width": 8, "depth": 2}
KINDS: dict[str, dict[str, Any]] = {
    "paper": {"modalities": "uv+depth+normal", "aggregator": "concat"},
    "residual": {"modalities": "uv+normal", "aggregator": "residual", "spherical_harmonics": False},
    "early": {"modalities": "uv+depth", "aggregator": "early"},
    "vanilla, large texture": {"modalities": "uv", "texture_size": 256},
    "mlp": {"modalities": "uv", "network": "mlp", "base": "raster", "guides": True},
    "raster in display space": {"modalities": "uv", "base": "raster", "filter": 3},
    "default": {"modalities": "uv", "base": "baked", "guides": True, "filter": 3, "stride": 2, "output": "log"},
    "corrector": {
        "base": "baked",
        "guides": "camera",
        "aggregator": "none",
        "filter": 3,
        "stride": 2,
        "output": "log",
        "trust": 0.6,
    },
    "corrector, denoised": {"base": "baked", "guides": "camera", "aggregator": "none", "filter": 3, "output": "log"},
    "chain": {"modalities": "uv", "base": "direct", "guides": True, "chain": True, "output": "log"},
}


def _files(folder: Path, height: int, width: int, own: bool) -> tuple[dict[str, np.ndarray], Path, Path]:
    rng = np.random.default_rng(3)
    base = (*BASE_CHANNELS, *FRESH_CHANNELS) if own else BASE_CHANNELS
    draw = {name: rng.random((height, width), np.float32) for name in (*GBUFFER_CHANNELS, *base)}
    for name in ("mask", "chain.mask"):
        draw[name] = (draw[name] > 0.4).astype(np.float32)
    normal = rng.normal(size=(3, height, width)).astype(np.float32)
    normal *= draw["mask"] / np.linalg.norm(normal, axis=0)
    draw |= {f"normal.{c}": normal[i] for i, c in enumerate("XYZ")}
    draw["depth.Z"] = 1.0 + 6.0 * draw["depth.Z"]
    draw |= {f"base.{c}": 4.0 * draw[f"base.{c}"] for c in "RGB"}
    raster = {c: draw[f"base.{c}"] for c in RASTER_CHANNELS}
    write_exr(folder / "passes.exr", {name: draw[name] for name in GBUFFER_CHANNELS} | raster, {})
    write_exr(folder / "base.exr", {name: draw[name] for name in base}, {})
    return draw, folder / "passes.exr", folder / "base.exr"


def _frame(folder: Path, lut: bool) -> SceneFrame:
    if not lut:
        return synthetic.FRAME
    grid = np.linspace(0, 1, 9, dtype=np.float32)
    table = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1)
    np.savez(folder / "display.npz", lut=table[..., [1, 2, 0]] ** 1.7, max=8.0, k=20.0)
    return synthetic.FRAME.model_copy(update={"display_lut": "display.npz", "exposure": 0.5, "gamma": 1.2})


@pytest.mark.parametrize("lut", [False, True], ids=["srgb", "table"])
@pytest.mark.parametrize("kind", KINDS)
def test_same_picture_as_torch(tmp_path: Path, kind: str, lut: bool) -> None:
    if lut and "base" not in KINDS[kind]:
        pytest.skip("without a base image nothing passes the display transform")
    settings = ModelSettings.model_validate(SMALL | KINDS[kind])
    model = DNR(settings, seed=1).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # a new model's last layers are zero: it would not show what comes before
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    frame = _frame(tmp_path, lut)
    export_onnx(tmp_path / "model.onnx", model, frame, tmp_path, {"note": 1})
    session = onnxruntime.InferenceSession(str(tmp_path / "model.onnx"), providers=["CPUExecutionProvider"])
    record = json.loads(session.get_modelmeta().custom_metadata_map["dnrpipe"])
    assert record["opset"] == OPSET and record["model"]["aggregator"] == settings.aggregator and record["note"] == 1
    assert [entry.name for entry in session.get_inputs()] == input_names(settings)
    for height, width in ((32, 32), (37, 21)):
        channels, passes, base = _files(tmp_path, height, width, own=kind.endswith("denoised"))
        view = synthetic.look_at(np.array([2.0, 3.0, 2.0]), height, "v", width=width)
        rendered = settings.base in ("baked", "direct")
        batch = load_views(
            [passes], None, frame, cameras=[view], folder=tmp_path, target=False,
            base=settings.base, base_files=[base] if rendered else None,
        ).batch([0])  # fmt: skip
        with torch.no_grad():
            output = model(batch)
        answers = session.run(None, graph_inputs(channels, view, input_names(settings)))
        shown = output.rgb.clamp(0, 1).numpy()
        assert shown.std() > 0.03
        assert np.abs(answers[0] - shown).max() < 1e-4
        assert len(answers) == (1 if output.radiance is None else 2)
        if output.radiance is not None:
            pair = [to_log(found.clamp(max=1e3)) for found in (torch.from_numpy(answers[1]), output.radiance)]
            assert float((pair[0] - pair[1]).abs().max()) < 1e-3
