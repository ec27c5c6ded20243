"""`dnrpipe export-web`: a folder whose page renders the neural view in a browser, without a server.

index.html, viewer.js   the page
scene.json              cameras, sizes, display figures
scene.glb               meshes with atlas coordinates (see `gltf`)
light-front.bin, -back  what surfaces send back diffusely: RGBA float16 [n, n, 4], row 0 at V = 0, A = opacity
model.onnx              the network (see `web_model`)
ort/                    onnxruntime-web and its licence
offline.js              all of the above once more as text: pages opened from disk may not read files
"""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dnrtrain import onnx_export
from dnrtrain.atomic import atomic_path, write_json, write_text
from dnrtrain.contract import View
from dnrtrain.metrics import psnr
from dnrtrain.model import DNR, compose, render_views
from dnrtrain.records import read

from .. import __version__
from ..core.console import Console
from ..core.errors import UserError
from ..core.machine import cache_root
from ..core.scene_files import read_frame, read_selection
from ..core.workspace import Workspace
from ..stages.records import METRICS, Metrics
from ..stages.session import resolve_settings
from .browser import require_chromium
from .folder import claim, finish
from .gltf import glb
from .meshes import read_meshes
from .nerf import raytraced_views
from .surface import SurfaceMaps, read_baked_light, surface_maps
from .web_model import check_page, half, train, web_views

TRAINING = ".training"
"""Of the export's folder: the checkpoint, so that an interrupted export goes on where it stopped."""
EMBEDDED = ("scene.glb", "light-front.bin", "light-back.bin", "model.onnx")
ORT_VERSION = "1.30.0"
ORT_SHA256 = "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71"
ORT_FILES = (
    "ort.wasm.bundle.min.mjs",
    "ort-wasm-simd-threaded.wasm",
    "ort.webgpu.bundle.min.mjs",
    "ort-wasm-simd-threaded.asyncify.wasm",
)


def export_web(
    workspace: Workspace, out: Path, console: Console, *, epochs: int | None = None, check: bool = False
) -> dict[str, Any]:
    """Train the page's network, write the folder, and measure the network on the held-out views (by torch).

    out: new, or an earlier export of the same kind. epochs: of training; None: 40, more for few views. check: also
    open the page in a browser. Returns folder, bytes, the figures of `held_out`, with `check` those of `check_page`.

    Raises UserError: no baked light, no ray-traced views, no npm, or a folder that is not ours to write; with `check`
    also no Chromium.
    """
    settings = resolve_settings(workspace, {}, None)
    views = raytraced_views(workspace)
    read_baked_light(workspace)
    meshes = read_meshes(workspace.scene)
    vendored = runtime()
    if check:
        require_chromium()
    claim(out, "web")
    maps = surface_maps(workspace, console)
    model = train(workspace, settings, console, views["train"], maps, out / TRAINING, epochs)
    quality = held_out(workspace, model, views["test"], maps)
    front, back = half(maps.radiance)
    contents = {
        "scene.glb": glb(meshes, None),
        "light-front.bin": front.tobytes(),
        "light-back.bin": back.tobytes() if maps.thin else b"",
        **{name: (files("dnrpipe.export") / "page" / name).read_bytes() for name in ("index.html", "viewer.js")},
        **{f"ort/{name}": (vendored / name).read_bytes() for name in (*ORT_FILES, "LICENSE")},
    }
    for name, content in contents.items():
        with atomic_path(out / name) as temporary:
            temporary.write_bytes(content)
    frame, scene = read_frame(workspace), _scene(workspace, views, maps, quality)
    onnx_export.export_onnx(out / "model.onnx", model, frame, workspace.scene, {"dnrpipe": __version__})
    write_json(out / "scene.json", scene)
    embedded = (*EMBEDDED, *(f"ort/{name}" for name in ORT_FILES[:2]))
    encoded = {name: base64.b64encode((out / name).read_bytes()).decode("ascii") for name in embedded}
    write_text(out / "offline.js", f"window.DNR_OFFLINE = {json.dumps({'scene': scene, 'files': encoded})};\n")
    written = [out / name for name in (*contents, "model.onnx", "scene.json", "offline.js")]
    finish(out, "web", written)
    answer = {"folder": str(out), "bytes": sum(path.stat().st_size for path in written), **quality}
    if check:
        data = web_views(workspace, views["test"], "test", maps)
        answer["check"] = check_page(out, views["test"], data, model, console)
    return answer


def held_out(workspace: Workspace, model: DNR, views: Sequence[View], maps: SurfaceMaps) -> dict[str, Any]:
    """Mean PSNR of the page's network and of its base image on the held-out views, over white, dB; by torch."""
    data = web_views(workspace, views, "test", maps)
    tensors = data.tensors
    assert tensors.target is not None and tensors.base is not None and tensors.display is not None
    with torch.no_grad():
        shown = render_views(model, data)
        base = compose(tensors.display(tensors.base), tensors.coverage)
    own = workspace.evaluation / METRICS
    return {
        "test_views": len(views),
        "psnr": float(psnr(shown, tensors.target).mean()),
        "psnr_base": float(psnr(base, tensors.target).mean()),
        "psnr_workspace": read(own, Metrics).mean["psnr"] if own.is_file() else None,
    }


def _scene(workspace: Workspace, views: dict[str, list[View]], maps: SurfaceMaps, quality: dict[str, Any]) -> Any:
    frame = read_frame(workspace)
    first = views["train"][0]
    return {
        "name": workspace.root.stem,
        "dnrpipe": __version__,
        "center": list(frame.center),
        "radius": frame.radius,
        "texels": maps.radiance.shape[1],
        "thin": maps.thin,
        "size": [first.width, first.height],
        "quality": quality,
        "start": first.model_dump(mode="json"),
        "distance": float(np.median([np.linalg.norm(view.position - frame.center) for view in views["train"]])),
        "trained_on": len(read_selection(workspace).views),
    }


def runtime() -> Path:
    """The folder of onnxruntime-web (ORT_FILES, ``LICENSE``) in the cache; fetched by npm the first time, and checked.

    Raises UserError: no npm, no network, or other bytes than expected.
    """
    folder = cache_root() / f"onnxruntime-web-{ORT_VERSION}"
    if all((folder / name).is_file() for name in (*ORT_FILES, "LICENSE")):
        return folder
    npm = shutil.which("npm")
    if npm is None:
        raise UserError("npm is not installed: the page needs onnxruntime-web from it, once; install Node.js")
    with tempfile.TemporaryDirectory(prefix="dnrpipe-") as scratch:
        command = [npm, "pack", f"onnxruntime-web@{ORT_VERSION}", "--silent"]
        done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, timeout=600, check=False)
        (archive,) = [*Path(scratch).glob("*.tgz")] or [None]
        if done.returncode != 0 or archive is None:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise UserError(f"npm did not deliver onnxruntime-web {ORT_VERSION} ({reason}); try again with a network")
        found = hashlib.sha256(archive.read_bytes()).hexdigest()
        if found != ORT_SHA256:
            raise UserError(f"onnxruntime-web {ORT_VERSION} from npm has other bytes than expected (sha256 {found})")
        with tarfile.open(archive) as content:
            for name in ORT_FILES:
                member = content.extractfile(f"package/dist/{name}")
                assert member is not None
                with atomic_path(folder / name) as temporary:
                    temporary.write_bytes(member.read())
    licence = files("dnrpipe.export") / "page" / "onnxruntime-LICENSE"
    write_text(folder / "LICENSE", licence.read_text(encoding="utf-8").format(version=ORT_VERSION))
    return folder
