"""Exports for other tools: NeRF data sets, ONNX, glTF, a page for the browser."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..core.console import Console
from ..core.errors import UserError
from .options import OUTPUT_OPTIONS, open_session
from .options import options as with_options

if TYPE_CHECKING:
    from ..core.workspace import Workspace
    from ..stages.session import Session


_common = with_options(
    [
        click.argument("workspace", required=False, metavar="[WORKSPACE]"),
        click.option("-w", "--workspace", "named", metavar="DIR", help="The same, as other commands take it."),
        *OUTPUT_OPTIONS,
    ]
)


def _opened(workspace: str | None, named: str | None, as_json: bool, quiet: bool) -> tuple[Workspace, Console]:
    from ..core.workspace import Workspace, find_workspace

    root = find_workspace(_root(workspace, named))
    return Workspace.open(root), Console(json_mode=as_json, quiet=quiet)


@contextmanager
def _untrained(command: str, workspace: str | None, named: str | None, **output: bool) -> Iterator[Session]:
    """The workspace's session; where no view was ever selected, the shipped corrector is its renderer."""
    options = {"workspace": _root(workspace, named), "preset": None, "assignments": (), "force": False, **output}
    with open_session(command, options) as session:
        session.untrained()
        yield session


def _root(workspace: str | None, named: str | None) -> str | None:
    if workspace and named and workspace != named:
        raise UserError(f"two workspaces are named, {workspace} and {named}; name one")
    return workspace or named


@click.command("export-nerf")
@_common
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="New folder (default: SCENE-nerf).")
@click.option("--normalise", is_flag=True, help="Move and scale the scene into the unit sphere.")
def export_nerf(out: Path | None, normalise: bool, **options: Any) -> None:
    """Write ray-traced views and cameras as nerfstudio, gsplat/3DGS and instant-ngp read them.

    The selected views are the training set, the held-out views of `dnrpipe evaluate` the test set: 8-bit PNG with
    alpha in display space, transforms_{train,val,test}.json, transforms.json and a point cloud to start splats from.

    \b
    Examples:
      dnrpipe export-nerf scene.dnr --out scene-nerf
      ns-train splatfacto --data scene-nerf
      dnrpipe export-nerf scene.dnr --out unit --normalise && ns-train nerfacto blender-data --data unit
      instant-ngp scene-nerf/transforms_train.json
    """
    from ..export.nerf import export_nerf as export

    workspace, console = _opened(**options)
    answer = export(workspace, out or Path(f"{workspace.root.stem}-nerf"), console, normalise=normalise)
    console.say(f"{answer['folder']}: {answer['train']} training and {answer['test']} test views")
    console.result(answer)


@click.command("export-onnx")
@_common
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="New file (default: SCENE.onnx).")
def export_onnx(out: Path | None, **options: Any) -> None:
    """Write the trained renderer (network, neural textures, display transform) as one ONNX file.

    Any height and width, float32. Inputs are the channels of the workspace's EXR files (docs/export.md). The file is
    run by onnxruntime on some views and compared with torch: beyond a difference of 1e-3 nothing is written.

    \b
    Examples:
      dnrpipe export-onnx
      dnrpipe export-onnx scene.dnr --out scene.onnx --json
    """
    from ..export.onnx import export_onnx as export

    with _untrained("export-onnx", **options) as session:
        workspace, console = session.workspace, session.console
        answer = export(workspace, out or Path(f"{workspace.root.stem}.onnx"), console)
    console.say(
        f"{answer['file']}: {answer['bytes'] / 1e6:.1f} MB, opset {answer['opset']}, inputs"
        f" {', '.join(answer['inputs'])}; largest difference from torch {answer['largest_difference']:.1e}"
    )
    console.result(answer)


@click.command("export-gltf")
@_common
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE", help="New file (default: SCENE.glb).")
@click.option("--light/--no-light", default=True, show_default=True, help="Baked light as an unlit texture.")
def export_gltf(out: Path | None, light: bool, **options: Any) -> None:
    """Write the scene's meshes with their atlas coordinates as binary glTF (Y up).

    TEXCOORD_0 is the scene atlas that the neural texture lives in; the texture is what the surfaces send back
    diffusely, in display space. Mirrors, glass and highlights are not in it.

    \b
    Examples:
      dnrpipe export-gltf
      dnrpipe export-gltf scene.dnr --out scene.glb --no-light
    """
    from ..export.gltf import export_gltf as export

    if light:
        with _untrained("export-gltf", **options):
            pass  # its light is baked now
    workspace, console = _opened(**options)
    answer = export(workspace, out or Path(f"{workspace.root.stem}.glb"), console, light=light)
    console.say(
        f"{answer['file']}: {answer['meshes']} meshes, {answer['triangles']} triangles, {answer['bytes'] / 1e6:.1f} MB"
    )
    console.result(answer)


@click.command("export-web")
@_common
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="New folder (default: SCENE-web).")
@click.option(
    "--epochs",
    type=click.IntRange(1, 100_000),
    metavar="N",
    help="Training of the page's network (default 40, more for few views).",
)
@click.option(
    "--check", is_flag=True, help="Open the page in a headless Chromium and compare its pictures with torch's."
)
def export_web(out: Path | None, epochs: int | None, check: bool, **options: Any) -> None:
    """Write a folder whose page renders the neural view in a browser, without a server.

    WebGL2 draws G-buffer and baked light, onnxruntime-web (fetched from npm once) runs a network that is trained for
    them on the ray-traced views: a browser has no ray tracer for the base image of the workspace's own. Open index.html
    from disk, or put the folder on any static server, which needs no offline.js.

    \b
    Examples:
      dnrpipe export-web
      dnrpipe export-web scene.dnr --out page --check
      python -m http.server -d page
    """
    from ..export.web import export_web as export

    workspace, console = _opened(**options)
    answer = export(workspace, out or Path(f"{workspace.root.stem}-web"), console, epochs=epochs, check=check)
    own = answer["psnr_workspace"]
    console.say(
        f"{answer['folder']}/index.html: {answer['psnr']:.2f} dB over {answer['test_views']} held-out views"
        f" ({answer['psnr_unpacked']:.2f} before weights and light were packed, baked light alone"
        f" {answer['psnr_base']:.2f}" + (")" if own is None else f", the workspace's own renderer {own:.2f})")
    )
    offline, first = answer["bytes_offline"] / 1e6, answer["bytes_first_load"] / 1e6
    console.say(
        f"{answer['bytes'] / 1e6 - offline:.1f} MB, {first:.1f} MB to load from a server; {offline:.1f} MB more in"
        " offline.js, for pages opened from disk"
    )
    if check:
        found = answer["check"]
        console.say(
            f"in Chromium ({found['provider']}, {found['gl']}): {found['psnr_torch']:.1f} dB against torch on the same"
            f" inputs, {found['psnr_truth']:.2f} dB against ray tracing; {found['side']}²: {found['fps']:.1f} frames a"
            f" second, {found['frame_ms']:.0f} ms a frame, {found['network_ms']:.0f} of them the network"
        )
    console.result(answer)
