"""`dnrpipe export-web`: a folder whose page renders the neural view in a browser, without a server.

index.html, viewer.js    the page
scene.json               where the camera begins, what the packed files mean, figures of quality
scene.bin.gz             meshes (see `page_data`)
light-front.webp, -back  what surfaces send back diffusely (see `page_data`)
model.onnx.gz            the network (see `web_model`)
ort/                     onnxruntime-web for WebAssembly, and its licence
offline.js               all of the above once more as text: pages opened from disk may not read files

The page itself unpacks what ends in .gz: any static server will do, whatever it knows of compression.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from dnrtrain import onnx_export
from dnrtrain.atomic import atomic_path, write_text
from dnrtrain.contract import View
from dnrtrain.metrics import psnr
from dnrtrain.model import DNR, base_picture, render_views
from dnrtrain.records import read

from .. import __version__
from ..core.console import Console
from ..core.errors import UserError
from ..core.machine import cache_root
from ..core.scene_files import read_frame, read_summary
from ..core.workspace import Workspace
from ..stages.records import METRICS, Metrics
from ..stages.session import resolve_settings
from .browser import require_chromium
from .folder import claim, finish
from .meshes import read_meshes
from .nerf import raytraced_views
from .page_data import PageLight, halved, pack_light, pack_meshes, packed, round_weights
from .surface import SurfaceMaps, read_baked_light, surface_maps
from .web_model import check_page, train, web_views

TRAINING = ".training"
"""Of the export's folder, until it is done: the checkpoint. An interrupted export goes on where it stopped."""
OFFLINE = "offline.js"
LICENCE = "ort/LICENSE"
ORT_VERSION = "1.30.0"
ORT_SHA256 = "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71"
ORT_SCRIPT = "ort.wasm.bundle.min.mjs"
ORT_BINARY = "ort-wasm-simd-threaded.wasm"
"""The smallest one in the package; those that know WebGPU, too, have 17 to 28 MB instead of 14."""
NPM_SECONDS = 600.0
START_ELEVATION = 20.0
"""Degrees above the horizon where the page's camera begins, if training views stand there."""


def export_web(
    workspace: Workspace, out: Path, console: Console, *, epochs: int | None = None, check: bool = False
) -> dict[str, Any]:
    """Train the page's network, write the folder, and measure the network on the held-out views (by torch).

    out: new, or an earlier export of the same kind. epochs: of training; None: 40, more for few views. check: also
    open the page in a browser.

    Returns folder, the bytes of `folder_sizes`, the figures of `held_out`, `psnr_unpacked` (the same network before
    weights and light were packed, dB), and with `check` those of `check_page`.

    Raises UserError: no baked light, no ray-traced views or ones that are out of date, no npm, or a folder that is not
    ours to write; with `check` also no Chromium.
    """
    settings = resolve_settings(workspace, {}, None)
    views = raytraced_views(workspace)
    read_baked_light(workspace)
    meshes, records = pack_meshes(read_meshes(workspace.scene))
    vendored = runtime()
    if check:
        require_chromium()
    claim(out, "web")
    frame, training = read_frame(workspace), out / TRAINING
    maps = surface_maps(workspace, console)
    light = pack_light(maps, 2.0**frame.exposure)
    model = train(workspace, settings, console, views["train"], maps, light, training, epochs)
    unpacked = held_out(workspace, model, views["test"], maps, None)["psnr"]
    round_weights(model)
    quality = held_out(workspace, model, views["test"], maps, light)
    onnx_export.export_onnx(training / "model.onnx", model, frame, workspace.scene, {"dnrpipe": __version__})
    scene = {
        "name": workspace.root.stem,
        "dnrpipe": __version__,
        "center": list(frame.center),
        "radius": frame.radius,
        "size": [views["train"][0].width, views["train"][0].height],
        "lens": [views["train"][0].fl_x, views["train"][0].fl_y],
        "start": start(workspace, views["train"]),
        "light": {"curve": light.curve, "range": light.range},
        "cutouts": light.cutouts,
        "thin": maps.thin,
        "meshes": records,
        "quality": quality,
    }
    loaded = {
        "scene.bin.gz": packed(meshes),
        **dict(zip(("light-front.webp", "light-back.webp"), light.files, strict=False)),
        "model.onnx.gz": packed(halved((training / "model.onnx").read_bytes())),
        f"ort/{ORT_SCRIPT}": (vendored / ORT_SCRIPT).read_bytes(),
        f"ort/{ORT_BINARY}.gz": packed((vendored / ORT_BINARY).read_bytes()),
    }
    encoded = {name: base64.b64encode(content).decode("ascii") for name, content in loaded.items()}
    contents = {
        **{name: (files("dnrpipe.export") / "page" / name).read_bytes() for name in ("index.html", "viewer.js")},
        "scene.json": json.dumps(scene, separators=(",", ":"), allow_nan=False).encode(),
        **loaded,
        LICENCE: (vendored / "LICENSE").read_bytes(),
        OFFLINE: f"window.DNR_OFFLINE = {json.dumps({'scene': scene, 'files': encoded})};\n".encode(),
    }
    for name, content in contents.items():
        with atomic_path(out / name) as temporary:
            temporary.write_bytes(content)
    finish(out, "web", [out / name for name in contents])
    answer = {"folder": str(out), **folder_sizes(contents), **quality, "psnr_unpacked": unpacked}
    if check:
        data = web_views(workspace, views["test"], "test", maps, light)
        answer["check"] = check_page(out, views["test"], data, model, console)
    shutil.rmtree(training)
    return answer


def folder_sizes(contents: dict[str, bytes]) -> dict[str, int]:
    """Bytes of all files, of those that only a page opened from disk reads, and of those that a server sends."""
    whole = sum(map(len, contents.values()))
    offline = len(contents[OFFLINE])
    return {"bytes": whole, "bytes_offline": offline, "bytes_first_load": whole - offline - len(contents[LICENCE])}


def held_out(
    workspace: Workspace, model: DNR, views: Sequence[View], maps: SurfaceMaps, light: PageLight | None
) -> dict[str, Any]:
    """Mean PSNR of the page's network and of its base image on the held-out views, over white, dB; by torch.

    Also `psnr_workspace`: of the workspace's own renderer by ``evaluation/metrics.json``; None without that file.
    """
    data = web_views(workspace, views, "test", maps, light)
    target = data.tensors.target
    assert target is not None
    own = workspace.evaluation / METRICS
    return {
        "test_views": len(views),
        "psnr": float(psnr(render_views(model, data), target).mean()),
        "psnr_base": float(psnr(base_picture(data.tensors), target).mean()),
        "psnr_workspace": read(own, Metrics).mean["psnr"] if own.is_file() else None,
    }


def start(workspace: Workspace, views: Sequence[View]) -> dict[str, float]:
    """Where the page's camera begins on its orbit: azimuth and elevation, radians; distance, scene units.

    A bit above the horizon, as far as the network was trained for that, and on the side of the scene's own camera.
    """
    center = np.array(read_frame(workspace).center)
    trained = np.stack([view.position for view in views]) - center
    distance = np.linalg.norm(trained, axis=1)
    elevation = np.arcsin(trained[:, 2] / distance)
    own = [camera for camera in read_summary(workspace.scene).cameras if camera.active]
    aside = np.array(own[0].c2w)[:3, 3] - center if own else trained[0]
    return {
        "azimuth": math.atan2(aside[1], aside[0]),
        "elevation": float(np.clip(math.radians(START_ELEVATION), elevation.min(), elevation.max())),
        "distance": float(np.median(distance)),
    }


def runtime() -> Path:
    """The folder of onnxruntime-web (script, binary, ``LICENSE``) in the cache; fetched by npm once, and checked.

    Raises UserError: no npm, no network, or other bytes than expected.
    """
    folder = cache_root() / f"onnxruntime-web-{ORT_VERSION}"
    if all((folder / name).is_file() for name in (ORT_SCRIPT, ORT_BINARY, "LICENSE")):
        return folder
    npm = shutil.which("npm")
    if npm is None:
        raise UserError("npm is not installed: the page needs onnxruntime-web from it, once; install Node.js")
    with tempfile.TemporaryDirectory(prefix="dnrpipe-") as scratch:
        command = [npm, "pack", f"onnxruntime-web@{ORT_VERSION}", "--silent"]
        try:
            done = subprocess.run(
                command, cwd=scratch, capture_output=True, text=True, timeout=NPM_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            raise UserError(
                f"npm did not deliver onnxruntime-web {ORT_VERSION} within {NPM_SECONDS:g} s; try again with a network"
            ) from None
        (archive,) = [*Path(scratch).glob("*.tgz")] or [None]
        if done.returncode != 0 or archive is None:
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise UserError(f"npm did not deliver onnxruntime-web {ORT_VERSION} ({reason}); try again with a network")
        found = hashlib.sha256(archive.read_bytes()).hexdigest()
        if found != ORT_SHA256:
            raise UserError(f"onnxruntime-web {ORT_VERSION} from npm has other bytes than expected (sha256 {found})")
        with tarfile.open(archive) as content:
            for name in (ORT_SCRIPT, ORT_BINARY):
                member = content.extractfile(f"package/dist/{name}")
                assert member is not None
                with atomic_path(folder / name) as temporary:
                    temporary.write_bytes(member.read())
    licence = files("dnrpipe.export") / "page" / "onnxruntime-LICENSE"
    write_text(folder / "LICENSE", licence.read_text(encoding="utf-8").format(version=ORT_VERSION))
    return folder
