"""What the page loads is small and says the same."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dnrpipe.export.meshes import BundleMesh
from dnrpipe.export.page_data import BRIGHTEST, halved, pack_light, pack_meshes, packed, round_weights
from dnrpipe.export.surface import SurfaceMaps
from dnrtrain.contract import SceneFrame
from dnrtrain.model import DNR
from dnrtrain.settings import ModelSettings

FRAME = SceneFrame(near=1, far=3, center=(0, 0, 0), radius=1)


def maps(front: np.ndarray, back: np.ndarray | None = None) -> SurfaceMaps:
    """Surfaces of that radiance and opacity, float [n, n, 4]."""
    sides = np.stack([front, np.zeros_like(front) if back is None else back]).astype(np.float32)
    return SurfaceMaps(sides, np.zeros((*front.shape[:2], 3), np.float32), back is not None)


def ramp(brightest: float) -> np.ndarray:
    v, u = np.mgrid[0:64, 0:64] / 63
    return np.stack([brightest * u, brightest * v, 0.5 * brightest * (u + v), np.ones_like(u)], axis=-1)


@pytest.mark.parametrize("exposure", [0.25, 1.0, 8.0])
def test_light_survives_its_packing(exposure: float) -> None:
    """To two display steps of 256 on average, whatever the exposure; row 0 stays row 0."""
    image = ramp(1.2 / exposure)
    light = pack_light(maps(image), exposure)
    assert len(light.files) == 1 and not light.cutouts and light.codes.shape == (1, 64, 64, 4)
    found = np.expm1(light.codes[0, ..., :3] / 255 * light.range) / light.curve
    shown = [(exposure * x).clip(0, 1) ** (1 / 2.2) for x in (found, image[..., :3])]
    assert np.abs(shown[0] - shown[1]).mean() < 2 / 256
    assert np.array_equal(light.codes[0, ..., :3], np.asarray(Image.open(io.BytesIO(light.files[0]))))


def test_backs_and_holes_are_packed_too() -> None:
    front, back = ramp(1.0), ramp(0.3)
    front[:32, :, 3] = 0
    light = pack_light(maps(front, back), 1.0)
    assert len(light.files) == 2 and light.cutouts
    assert np.array_equal(light.codes[0, ..., 3] < 128, front[..., 3] < 0.5)


def test_a_lamp_does_not_take_the_codes_of_the_rest() -> None:
    image = ramp(1.0)
    image[60:, 60:, :3] = 5000.0
    light = pack_light(maps(image), 1.0)
    assert np.isclose(np.expm1(light.range) / light.curve, BRIGHTEST)


def test_meshes_unpack_to_what_they_were() -> None:
    """As readMeshes of viewer.js unpacks them."""
    rng = np.random.default_rng(0)
    meshes = []
    for count, triangles in ((100, 50), (7, 4)):
        normals = rng.normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        positions = rng.normal(size=(count, 3)).astype(np.float32)
        positions[:, 2] = 3.0  # flat
        mesh = BundleMesh(
            name="mesh",
            material="default",
            positions=positions,
            normals=normals.astype(np.float32),
            atlas=rng.random((count, 2), np.float32),
            uv=None,
            faces=rng.integers(0, count, (triangles, 3)).astype(np.int32),
            placements=rng.normal(size=(2, 4, 4)),
        )
        meshes.append(mesh)
    content, records = pack_meshes(meshes)
    at = 0

    def take(kind: str, count: int) -> np.ndarray:
        nonlocal at
        values = np.frombuffer(content, kind, count, at)
        at += values.nbytes
        return values

    for mesh, record in zip(meshes, records, strict=True):
        vertices = record["vertices"]
        assert np.array_equal(np.cumsum(take("<i4", 3 * record["triangles"])), mesh.faces.ravel())
        positions = take("<u2", 3 * vertices).reshape(-1, 3) / 65535 * record["extent"] + record["low"]
        normals = take("<i2", 3 * vertices).reshape(-1, 3) / 1023
        atlas = take("<u2", 2 * vertices).reshape(-1, 2) / 65535
        assert np.abs(positions - mesh.positions).max() < 1e-4 and np.abs(atlas - mesh.atlas).max() < 1e-5
        assert np.abs(normals - mesh.normals).max() < 1e-3
        assert np.allclose(np.array(record["placements"][1]).reshape(4, 4).T, mesh.placements[1])
    assert at == len(content)


def test_halved_weights_compute_the_same_in_half_the_bytes(tmp_path: Path) -> None:
    """As a model whose weights are rounded; torch's tables, which are nodes of the graph, are halved, too."""
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    from dnrtrain.onnx_export import export_onnx

    settings = ModelSettings(texture_size=32, width=16, depth=2, modalities="uv", aggregator="residual")
    model = DNR(settings, seed=0).eval()
    round_weights(model)
    export_onnx(tmp_path / "model.onnx", model, FRAME, tmp_path, {})
    whole = (tmp_path / "model.onnx").read_bytes()
    small = halved(whole)
    assert len(small) < 0.56 * len(whole)
    answers = []
    for graph in (whole, small):
        session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
        generator = torch.Generator().manual_seed(0)
        feeds = {
            entry.name: torch.rand(1, entry.shape[1], 24, 32, generator=generator).numpy()
            for entry in session.get_inputs()
        }
        answers.append(session.run(None, feeds)[0])
    assert answers[0].std() > 0.01
    assert np.abs(answers[0] - answers[1]).max() < 1e-3


def test_gzip_says_nothing_of_when() -> None:
    assert gzip.decompress(packed(b"light" * 100)) == b"light" * 100
    assert packed(b"light") == packed(b"light")
