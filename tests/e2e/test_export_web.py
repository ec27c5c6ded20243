"""`dnrpipe export-web`: headless Chromium drives the page, from disk and from a static server."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from e2e_harness import run
from tools.bench_page import StaticServer, bench

from dnrpipe.core.errors import UserError
from dnrpipe.export.browser import find_chromium, open_page, wait_for
from dnrpipe.export.web import runtime

pytestmark = [pytest.mark.slow, pytest.mark.e2e]

LIMIT = 8_000_000
"""Bytes of the folder without offline.js, and of what a server sends."""

PIXELS = "Array.from(document.querySelector('canvas').getContext('2d').getImageData(0, 0, 64, 64).data)"

SETTLED = (
    "window.dnr.then(async page => { do await new Promise(done => setTimeout(done, 100));"
    " while (page.left || page.busy); return true })"
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


def test_the_browser_computes_what_torch_computes(exported: tuple[Path, dict[str, Any]]) -> None:
    _, answer = exported
    check = answer["check"]
    assert check["views"] == answer["test_views"] == 2
    assert check["psnr_torch"] > 60
    assert check["mask_agrees"] > 0.998
    assert check["psnr_files"] > 30  # other sub-pixel rules at edges, 64 x 64 pixels
    assert abs(check["psnr_truth"] - answer["psnr"]) < 0.5
    assert answer["psnr"] > answer["psnr_base"]
    assert abs(answer["psnr"] - answer["psnr_unpacked"]) < 0.2
    assert check["side"] == 256 and check["fps"] > 0


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
        assert "WebAssembly" in figures


def test_browsers_unpack_light_as_torch_sees_it(exported: tuple[Path, dict[str, Any]]) -> None:
    """Also beside and below the holes of a cut-out: colours are not multiplied by opacity on the way to the texture."""
    from dnrpipe.export.page_data import pack_light
    from dnrpipe.export.surface import SurfaceMaps

    v, u = np.mgrid[0:32, 0:32] / 31
    opacity = np.where(u + v < 1, 0.0, np.where(u < 0.5, 0.6, 1.0))
    radiance = np.stack([u, v, 0.3 + 0.5 * u, opacity], axis=-1)[None].astype(np.float32)
    light = pack_light(SurfaceMaps(radiance, np.zeros((32, 32, 3), np.float32), False), 1.0)
    read = """async (text) => {
        const raster = (await window.dnr).raster, gl = raster.gl, values = new Uint8Array(4096);
        window.DNR_OFFLINE.files["test.webp"] = text;
        const texture = raster.light(await picture("test.webp"));
        gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        gl.readPixels(0, 0, 32, 32, gl.RGBA, gl.UNSIGNED_BYTE, values);
        return Array.from(values);
    }"""
    with open_page((exported[0] / "index.html").as_uri()) as (page, _):
        wait_for(page, SETTLED)
        found = np.array(page.evaluate(read, base64.b64encode(light.files[0]).decode())).reshape(32, 32, 4)
    assert light.cutouts and np.ptp(light.codes[..., 3]) == 255
    assert np.abs(found - light.codes[0].astype(int)).max() <= 2


def test_normals_turn_by_the_inverse_transpose(exported: tuple[Path, dict[str, Any]]) -> None:
    placement = np.eye(4)
    placement[:3] = np.random.default_rng(1).normal(size=(3, 4))
    with open_page((exported[0] / "index.html").as_uri()) as (page, _):
        turned = np.array(page.evaluate(f"normalMatrix({placement.T.ravel().tolist()})")).reshape(3, 3).T
    linear = placement[:3, :3]
    assert np.allclose(turned, abs(np.linalg.det(linear)) * np.linalg.inv(linear).T)


@pytest.mark.robustness
def test_a_static_server_sends_little(exported: tuple[Path, dict[str, Any]]) -> None:
    """File by file, without offline.js; one that isolates origins gets threads, and the same picture."""
    out, answer = exported
    meshes, pictures = gzip.decompress((out / "scene.bin.gz").read_bytes()), []
    isolation = {"Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Embedder-Policy": "require-corp"}
    for headers, several in (({}, False), (isolation, True)):
        with StaticServer(out, headers) as server, open_page(server.address) as (page, _):
            wait_for(page, SETTLED)
            pictures.append(page.evaluate(PIXELS))
            assert page.evaluate("document.getElementById('message').textContent") == ""
            threads = int(page.evaluate("document.getElementById('figures').innerText.match(/threads: (\\d+)/)[1]"))
            assert threads == (min(4, page.evaluate("navigator.hardwareConcurrency")) if several else 1)
            # A server that says "Content-Encoding: gzip" makes the browser unpack the file before the page sees it.
            assert page.evaluate("unpacked('scene.bin').then(bytes => bytes.length)") == len(meshes)
            page.route("**/scene.bin.gz", lambda route: route.fulfill(body=meshes))
            assert page.evaluate("unpacked('scene.bin').then(bytes => bytes.length)") == len(meshes)
    assert max(abs(a - b) for a, b in zip(*pictures, strict=True)) <= 2
    found = bench(out, 64)
    assert found["first_load"] == answer["bytes_first_load"] <= LIMIT
    assert found["fps"] > 0 and found["offline"] == answer["bytes_offline"]


def test_the_page_starts_level_and_says_its_figures(exported: tuple[Path, dict[str, Any]], tiny: Path) -> None:
    """Up is up, the camera a bit above the horizon; both renderers' PSNR and the frames a second are there at once."""
    out, answer = exported
    own = json.loads((tiny / "evaluation" / "metrics.json").read_text())["mean"]["psnr"]
    with open_page((out / "index.html").as_uri()) as (page, errors):
        wait_for(page, SETTLED)
        pose = np.array(page.evaluate("window.dnr.then(page => page.view().c2w)"))
        fps = page.locator("#fps")
        assert fps.is_visible()
        counted = re.fullmatch(r"([\d.]+) frames a second", fps.inner_text())
        assert counted and float(counted[1]) > 0
        table = page.evaluate("document.getElementById('figures').innerText")
        assert errors == []
    rows = dict(line.split("\t") for line in table.splitlines())
    right, up, back = pose[:3, :3].T
    assert abs(right[2]) < 1e-9 and up[2] > 0.8
    assert 5 < math.degrees(math.asin(back[2])) < 30
    assert rows["this page"].startswith(f"{answer['psnr']:.1f} dB PSNR over 2 ray-traced held-out views")
    assert rows["workspace's renderer"].startswith(f"{own:.1f} dB PSNR")
    assert answer["psnr_workspace"] == own


def test_the_base_image_is_the_ray_traced_diffuse_light(tiny: Path) -> None:
    """Textures looked up at the G-buffer against the diffuse part of Mitsuba's base images."""
    from dnrpipe.core.console import Console
    from dnrpipe.core.workspace import Workspace
    from dnrpipe.export.nerf import raytraced_views
    from dnrpipe.export.page_data import pack_light
    from dnrpipe.export.surface import surface_maps
    from dnrpipe.export.web_model import web_views
    from dnrpipe.stages.base_images import base_path
    from dnrtrain.exr import read_exr

    workspace = Workspace.open(tiny)
    views = raytraced_views(workspace)["test"]
    maps = surface_maps(workspace, Console(quiet=True))
    data = web_views(workspace, views, "test", maps, pack_light(maps, 1.0))
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
    whole = {path.relative_to(out).as_posix(): path.stat().st_size for path in out.rglob("*") if path.is_file()}
    assert listed[0] == "web" and {*listed[1:], ".dnrpipe-export"} == whole.keys()
    assert answer["bytes"] == sum(whole.values()) - whole[".dnrpipe-export"]
    assert answer["bytes_offline"] == whole["offline.js"]
    assert sum(whole.values()) - whole["offline.js"] <= LIMIT
    page = (out / "index.html").read_text() + (out / "viewer.js").read_text()
    assert "https://" not in page and "http://" not in page  # nothing from elsewhere


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
