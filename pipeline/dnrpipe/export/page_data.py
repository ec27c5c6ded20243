"""What the page loads, in few bytes: baked light as WebP pictures, meshes and the network's weights in 16 bits.

The network is trained on the light as the page unpacks it, and measured with the weights as the page has them: what
they lose is in every figure of the page.
"""

from __future__ import annotations

import gzip
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from PIL import Image

from dnrtrain.model import DNR

from .meshes import BundleMesh
from .surface import SurfaceMaps

CURVE = 50.0
"""Of codes log(1 + CURVE · x): at black as fine as sRGB's, at white half as fine."""
BRIGHTEST = 16.0
"""Times display white; brighter light becomes that. 8 bits for a lamp's thousands would leave too few for the rest."""
QUALITY = 95
"""Of the WebP files."""
NORMAL_STEPS = 1023
"""Per unit: a tenth of a degree, and half of what 15 bits take."""
LARGE = 1024
"""Values from which a tensor of the network is stored in 16 bits; smaller ones are no gain."""


@dataclass(frozen=True)
class PageLight:
    """Baked light as the page has it.

    files: WebP, front and, where backs are visible, back. codes: uint8 [sides, n, n, 4] as they unpack, row 0 at V = 0:
    log(1 + curve · x) / range · 255 of linear Rec.709 radiance x, and opacity · 255. cutouts: some texels are
    transparent.
    """

    files: list[bytes]
    codes: np.ndarray
    curve: float
    range: float
    cutouts: bool


def pack_light(maps: SurfaceMaps, exposure: float) -> PageLight:
    """Pack the surfaces' light. exposure: linear, of the display transform."""
    sides = maps.radiance if maps.thin else maps.radiance[:1]
    curve = CURVE * exposure
    brightest = min(float(sides[..., :3].max()), BRIGHTEST / exposure)
    reach = float(np.log1p(curve * max(brightest, 1e-6 / exposure)))
    codes = np.empty(sides.shape, np.uint8)
    codes[..., :3] = 255 * (np.log1p(curve * sides[..., :3].clip(0, brightest)) / reach) + 0.5
    codes[..., 3] = 255 * sides[..., 3].clip(0, 1) + 0.5
    cutouts = bool((codes[..., 3] < 128).any())
    files = [_webp(side if cutouts else side[..., :3]) for side in codes]
    unpacked = [np.asarray(Image.open(io.BytesIO(file)).convert("RGBA")) for file in files]
    return PageLight(files, np.stack(unpacked), curve, reach, cutouts)


def _webp(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    # exact: colours of transparent texels are looked up beside opaque ones.
    Image.fromarray(pixels).save(buffer, "WEBP", quality=QUALITY, method=6, exact=True)
    return buffer.getvalue()


def pack_meshes(meshes: Sequence[BundleMesh]) -> tuple[bytes, list[dict[str, Any]]]:
    """The meshes' arrays one after the other, and what `readMeshes` of viewer.js has to know of each.

    Of a mesh: indices, int32 differences; positions, uint16 of its box; normals, int16; atlas coordinates, uint16.
    """
    parts, records = [], []
    for mesh in meshes:
        low, extent = mesh.positions.min(axis=0), np.ptp(mesh.positions, axis=0)
        places = (mesh.positions - low) / np.where(extent > 0, extent, 1)
        normals = np.where(mesh.normals.any(axis=1, keepdims=True), mesh.normals, (0, 0, 1))  # shaders divide by length
        indices = np.diff(mesh.faces.ravel(), prepend=0)
        parts += [
            indices.astype("<i4"),
            (65535 * places + 0.5).astype("<u2"),
            np.rint(NORMAL_STEPS * normals).astype("<i2"),
            (65535 * mesh.atlas.clip(0, 1) + 0.5).astype("<u2"),
        ]
        records.append(
            {
                "vertices": len(mesh.positions),
                "triangles": len(mesh.faces),
                "low": low.tolist(),
                "extent": extent.tolist(),
                "placements": [placement.T.ravel().tolist() for placement in mesh.placements],
            }
        )
    return b"".join(part.tobytes() for part in parts), records


def round_weights(model: DNR) -> None:
    """Round the model's large tensors to what `halved` keeps of them, in place."""
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.numel() >= LARGE:
                parameter.copy_(parameter.half().float())


def halved(graph: bytes) -> bytes:
    """The ONNX file with its large float32 tensors as float16; a runtime widens them once, when it loads the file."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    proto = onnx.load_from_string(graph)
    kept, casts, narrow = [], [], []
    for node in proto.graph.node:  # torch writes some tensors as nodes
        if node.op_type == "Constant" and node.attribute[0].HasField("t"):
            node.attribute[0].t.name = node.output[0]
            proto.graph.initializer.append(node.attribute[0].t)
        else:
            kept.append(node)
    for tensor in proto.graph.initializer:
        if tensor.data_type == TensorProto.FLOAT and np.prod(tensor.dims) >= LARGE:
            half = numpy_helper.to_array(tensor).astype(np.float16)
            narrow.append(numpy_helper.from_array(half, f"{tensor.name}_half"))
            casts.append(helper.make_node("Cast", [f"{tensor.name}_half"], [tensor.name], to=TensorProto.FLOAT))
        else:
            narrow.append(tensor)
    inputs, outputs = proto.graph.input, proto.graph.output
    proto.graph.CopyFrom(helper.make_graph([*casts, *kept], proto.graph.name, inputs, outputs, narrow))
    onnx.checker.check_model(proto, full_check=True)
    return proto.SerializeToString()


def packed(content: bytes) -> bytes:
    """gzip; the same bytes for the same content."""
    return gzip.compress(content, 9, mtime=0)
