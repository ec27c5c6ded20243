"""`dnrpipe export-gltf`: the meshes with their atlas coordinates, and their diffuse outgoing light as a texture.

glTF 2.0, binary (.glb), right-handed, Y up: a point (x, y, z) of the .blend is written as (x, z, -y). TEXCOORD_0 is
the scene atlas, TEXCOORD_1 the artist's own layer where the bundle has it; glTF counts V downwards, so V becomes 1 - V.
The texture is shown unlit (KHR_materials_unlit): its light is in it already.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dnrtrain.atomic import atomic_path

from .. import __version__
from ..core.console import Console
from ..core.errors import UserError
from ..core.images import eight_bit
from ..core.scene_files import read_frame
from ..core.workspace import Workspace
from ..stages.base_images import light_path
from ..stages.pipeline import STAGES, require_inputs
from ..stages.session import settings_of_last_run
from .meshes import BundleMesh, read_meshes

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""World of the .blend (Z up) -> glTF's (Y up)."""
FLOAT, UNSIGNED = 5126, 5125
ARRAY, INDICES = 34962, 34963


def export_gltf(workspace: Workspace, out: Path, console: Console, *, light: bool = True) -> dict[str, Any]:
    """Write ``out`` (.glb). light: with the baked light as its texture, where the workspace has any.

    Raises UserError: not a .glb; with light, one that is out of date.
    """
    if out.suffix != ".glb" or out.is_dir():
        raise UserError(f"--out {out}: name a file that ends in .glb")
    meshes = read_meshes(workspace.scene)
    picture = None
    if light and light_path(workspace).is_file():
        settings = settings_of_last_run(workspace)
        require_inputs(STAGES["finetune"], workspace, settings, "export-gltf")  # else it is of another scene
        picture = light_picture(workspace, console)
    elif light:
        console.warn("no baked light in this workspace (model.base is not baked): the meshes are written without")
    with atomic_path(out) as temporary:
        temporary.write_bytes(glb(meshes, picture))
    return {
        "file": str(out),
        "bytes": out.stat().st_size,
        "meshes": len(meshes),
        "triangles": int(sum(len(mesh.faces) * len(mesh.placements) for mesh in meshes)),
        "texture": None if picture is None else list(picture.shape[:2]),
    }


def light_picture(workspace: Workspace, console: Console) -> np.ndarray:
    """Diffuse outgoing and emitted light of the atlas's fronts, display space: uint8 [n, n, 3], row 0 at V = 1."""
    import torch

    from dnrtrain.display import DisplayTransform

    from .surface import surface_maps

    radiance = torch.from_numpy(surface_maps(workspace, console).radiance[0, ..., :3].copy()).permute(2, 0, 1)
    shown = DisplayTransform(read_frame(workspace), workspace.scene)(radiance).permute(1, 2, 0).numpy()
    return eight_bit(shown[::-1])


def glb(meshes: Sequence[BundleMesh], picture: np.ndarray | None) -> bytes:
    """Binary glTF of the meshes, lit by ``picture`` (uint8 [n, n, 3]; first row at the top) or grey."""
    parts = _Parts()
    names = list(dict.fromkeys(mesh.material for mesh in meshes))
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"dnrpipe {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": []}],
        "nodes": [],
        "meshes": [],
        "materials": [_material(name, picture is not None) for name in names],
    }
    for mesh in meshes:
        attributes = {
            "POSITION": parts.vectors(_rotated(mesh.positions), bounds=True),
            "NORMAL": parts.vectors(_unit(_rotated(mesh.normals))),
            "TEXCOORD_0": parts.vectors(_flipped(mesh.atlas)),
        }
        if mesh.uv is not None:
            attributes["TEXCOORD_1"] = parts.vectors(_flipped(mesh.uv))
        primitive = {
            "attributes": attributes,
            "indices": parts.indices(mesh.faces),
            "material": names.index(mesh.material),
        }
        document["meshes"].append({"name": mesh.name, "primitives": [primitive]})
        for matrix in mesh.placements:
            node: dict[str, Any] = {"name": mesh.name, "mesh": len(document["meshes"]) - 1}
            if not np.array_equal(matrix, np.eye(4)):
                node["matrix"] = [float(x) for x in (Y_UP @ matrix @ np.linalg.inv(Y_UP)).T.ravel()]
            document["scenes"][0]["nodes"].append(len(document["nodes"]))
            document["nodes"].append(node)
    if picture is not None:
        png = io.BytesIO()
        Image.fromarray(picture).save(png, "PNG")
        document["extensionsUsed"] = ["KHR_materials_unlit"]
        document["images"] = [{"name": "light", "mimeType": "image/png", "bufferView": parts.view(png.getvalue())}]
        document["samplers"] = [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}]
        document["textures"] = [{"sampler": 0, "source": 0}]
    document |= {"accessors": parts.accessors, "bufferViews": parts.views}
    document["buffers"] = [{"byteLength": len(parts.data)}]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = bytes(parts.data)
    total = 12 + 8 + len(text) + 8 + len(body)
    head = struct.pack("<4sII", b"glTF", 2, total)
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body


class _Parts:
    """The binary buffer, and the views and accessors of it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)})
        if target is not None:
            self.views[-1]["target"] = target
        self.data += content + b"\0" * (-len(content) % 4)
        return len(self.views) - 1

    def vectors(self, values: np.ndarray, *, bounds: bool = False) -> int:
        values = np.ascontiguousarray(values, "<f4")
        limits = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()} if bounds else {}
        return self._accessor(values, ARRAY, FLOAT, count=len(values), type=f"VEC{values.shape[1]}", **limits)

    def indices(self, faces: np.ndarray) -> int:
        return self._accessor(np.ascontiguousarray(faces, "<u4"), INDICES, UNSIGNED, count=faces.size, type="SCALAR")

    def _accessor(self, values: np.ndarray, target: int, component: int, **more: Any) -> int:
        view = self.view(values.tobytes(), target)
        self.accessors.append({"bufferView": view, "componentType": component, **more})
        return len(self.accessors) - 1


def _material(name: str, lit: bool) -> dict[str, Any]:
    colour = {"baseColorTexture": {"index": 0, "texCoord": 0}} if lit else {"baseColorFactor": [0.8, 0.8, 0.8, 1]}
    surface = {"metallicFactor": 0.0, "roughnessFactor": 1.0, **colour}
    extensions = {"extensions": {"KHR_materials_unlit": {}}} if lit else {}
    return {"name": name, "doubleSided": True, "pbrMetallicRoughness": surface, **extensions}


def _rotated(vectors: np.ndarray) -> np.ndarray:
    return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=1)


def _unit(normals: np.ndarray) -> np.ndarray:
    """Unit length, as glTF demands; up where there is none."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), np.array([0, 1, 0], np.float32))


def _flipped(uv: np.ndarray) -> np.ndarray:
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)
