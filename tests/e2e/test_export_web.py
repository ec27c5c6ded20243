"""`dnrpipe export-web`: headless Chromium drives the page, from disk and from a static server."""

from __future__ import annotations

import functools
import http.server
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from e2e_harness import run

from dnrpipe.core.errors import UserError
from dnrpipe.export.browser import find_chromium, open_page, wait_for
from dnrpipe.export.gltf import Y_UP
from dnrpipe.export.web import runtime

pytestmark = [pytest.mark.slow, pytest.mark.e2e]

PIXELS = "Array.from(document.querySelector('canvas').getContext('2d').getImageData(0, 0, 64, 64).data)"

SETTLED = (
    "window.dnr.then(async page => { do await new Promise(done => setTimeout(done, 100));"
    " while (page.dirty || page.busy); return true })"
)


@pytest.fixture(scope="module")
def exported(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The page of the tiny workspace, and what the command printed. Three epochs: the agreement is what is tested."""
    if find_chromium() is None:
        pytest.skip("no Chromium on this machine")
    try:
        runtime()
    except UserError as error:
        pytest.skip(f"onnxruntime-web is not in the cache and cannot be fetched: {error}")
    out = tmp_path_factory.mktemp("web") / "page"
    done = run("export-web", str(tiny), "--out", str(out), "--epochs", "3", "--check", "--json", folder=tiny.parent)
    return out, json.loads(done.stdout)


@pytest.fixture
def server(exported: tuple[Path, dict[str, Any]]) -> Iterator[str]:
    """The folder on a static server without any headers of its own."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None: ...

    handler = functools.partial(Quiet, directory=str(exported[0]))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as found:
        threading.Thread(target=found.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{found.server_address[1]}/index.html"
        found.shutdown()


def test_the_browser_computes_what_torch_computes(exported: tuple[Path, dict[str, Any]]) -> None:
    _, answer = exported
    check = answer["check"]
    assert check["views"] == answer["test_views"] == 2
    assert check["psnr_torch"] > 60
    assert check["mask_agrees"] > 0.998
    assert check["psnr_files"] > 30  # other sub-pixel rules at edges, 64 x 64 pixels
    assert abs(check["psnr_truth"] - answer["psnr"]) < 0.5
    assert answer["psnr"] > answer["psnr_base"]


def test_dragging_and_choosing_change_the_picture_from_disk(exported: tuple[Path, dict[str, Any]]) -> None:
    with open_page((exported[0] / "index.html").as_uri()) as (page, errors):
        wait_for(page, SETTLED)
        before = page.evaluate(PIXELS)
        assert len(set(before)) > 30
        canvas = page.locator("canvas").bounding_box()
        assert canvas is not None
        x, y, width = canvas["x"], canvas["y"], canvas["width"]
        page.mouse.move(x + 0.3 * width, y + 0.5 * width)
        page.mouse.down()
        page.mouse.move(x + 0.6 * width, y + 0.5 * width, steps=10)
        page.mouse.up()
        wait_for(page, SETTLED)
        after = page.evaluate(PIXELS)
        changed = sum(a != b for a, b in zip(before, after, strict=True)) / len(before)
        assert changed > 0.05
        page.evaluate("(s => { s.value = 'normal'; s.onchange() })(document.getElementById('show'))")
        wait_for(page, SETTLED)
        assert page.evaluate(PIXELS) != after
        figures = page.evaluate("document.getElementById('figures').innerText")
        assert errors == []
        assert "WebAssembly" in figures and "dB PSNR over 2 ray-traced" in figures


def test_instances_stand_where_gltf_puts_them(exported: tuple[Path, dict[str, Any]]) -> None:
    """The page's own matrices: back from glTF's axes, and normals by the inverse transpose."""
    rng = np.random.default_rng(1)
    placement = np.eye(4)
    placement[:3] = rng.normal(size=(3, 4))
    stored = (Y_UP @ placement @ np.linalg.inv(Y_UP)).T.ravel().tolist()
    with open_page((exported[0] / "index.html").as_uri()) as (page, _):
        world = page.evaluate(f"worldMatrix({stored})")
        turned = np.array(page.evaluate(f"normalMatrix({world})")).reshape(3, 3).T
    assert np.allclose(np.array(world).reshape(4, 4).T, placement)
    linear = placement[:3, :3]
    assert np.allclose(turned, abs(np.linalg.det(linear)) * np.linalg.inv(linear).T)


def test_a_static_server_serves_it_too(exported: tuple[Path, dict[str, Any]], server: str) -> None:
    """Without offline.js, file by file."""
    (exported[0] / "offline.js").rename(exported[0] / "away.js")
    try:
        with open_page(server) as (page, _):
            assert wait_for(page, "window.dnr.then(page => page.scene.size)") == [64, 64]
            wait_for(page, "window.dnr.then(page => page.frame(page.view(), 'neural')).then(() => true)")
            assert page.evaluate("document.getElementById('message').textContent") == ""
    finally:
        (exported[0] / "away.js").rename(exported[0] / "offline.js")


def test_the_base_image_is_the_ray_traced_diffuse_light(tiny: Path) -> None:
    """Textures looked up at the G-buffer against the diffuse part of Mitsuba's base images."""
    from dnrpipe.core.console import Console
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.export.nerf import raytraced_views
    from dnrpipe.export.surface import surface_maps
    from dnrpipe.export.web_model import web_views
    from dnrpipe.stages.base_images import base_path
    from dnrtrain.exr import read_exr

    workspace = Workspace.open(tiny)
    views = raytraced_views(workspace)["test"]
    data = web_views(workspace, views, "test", surface_maps(workspace, Console(quiet=True)))
    assert data.tensors.base is not None
    for view, image in zip(views, data.tensors.base.numpy(), strict=True):
        channels, _ = read_exr(base_path(workspace, "test", view.name))
        whole = channels["coverage"] > 0.999  # edges mix surfaces
        ours = image[:, whole]
        theirs = np.stack([channels[f"diffuse.{c}"][whole] for c in "RGB"])
        assert abs(ours.mean() / theirs.mean() - 1) < 0.1
        assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.85  # 128 texels for the whole scene


def test_what_lies_in_the_folder(exported: tuple[Path, dict[str, Any]]) -> None:
    out, answer = exported
    assert "MIT License" in (out / "ort" / "LICENSE").read_text()
    listed = (out / ".dnrpipe-export").read_text().splitlines()
    assert listed[0] == "web" and sum((out / name).stat().st_size for name in listed[1:]) == answer["bytes"]
    assert (out / "scene.glb").read_bytes()[:4] == b"glTF"
    page = (out / "index.html").read_text() + (out / "viewer.js").read_text()
    assert "https://" not in page and "http://" not in page  # nothing from elsewhere
    scene = json.loads((out / "scene.json").read_text())
    assert (out / "light-front.bin").stat().st_size == 8 * scene["texels"] ** 2


def test_a_page_that_fails_is_an_error(tmp_path: Path) -> None:
    """The check sees an exception in the page."""
    if find_chromium() is None:
        pytest.skip("no Chromium on this machine")
    (tmp_path / "index.html").write_text("<script>window.dnr = Promise.reject(new Error('no light'))</script>")
    address = (tmp_path / "index.html").as_uri()
    with pytest.raises(UserError, match="no light"), open_page(address) as (page, _):
        wait_for(page, "window.dnr.then(() => true)")
    with pytest.raises(UserError, match="ERR_FILE_NOT_FOUND"), open_page(address + ".html"):
        pass
