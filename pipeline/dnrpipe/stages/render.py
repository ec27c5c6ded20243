"""`dnrpipe render`: novel views with the neural renderer, as PNG, EXR, MP4 or WebP."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dnrtrain import srgb
from dnrtrain.atomic import atomic_path, write_json
from dnrtrain.contract import View, write_cameras

from ..core.errors import UserError
from ..core.images import eight_bit, picture_of, write_png
from ..core.scene_files import read_frame
from ..core.workspace import digest, file_sha256
from .base_images import RENDERED, base_views
from .pipeline import STAGES, require_inputs
from .prepare import GEOMETRY_ENGINE, draw_passes
from .select import require_baked
from .stage import Run
from .trainer import torch_device
from .trust import measure_trust

if TYPE_CHECKING:
    from dnrtrain.model import DNR

FPS = 24


def render_novel(
    run: Run,
    views: Sequence[View],
    *,
    name: str,
    frames: str,
    movie: str,
    untrained: bool,
    alone: bool,
) -> dict[str, Any]:
    """Render the views into ``renders/<name>/``.

    G-buffers and frames that are there are kept when the cameras and the model are the same; a changed model redoes
    the frames.

    Args:
        run: of stage render.
        frames: png, exr or both. movie: mp4, webp or none.
        untrained: by the shipped corrector, into ``renders/<name>-untrained/``.
        alone: no frame remembers those before it, as none does where the renderer was trained on the scene.

    Raises UserError: no fine-tuned model, or cameras that no movie can hold.
    """
    from dnrtrain.dataset import load_views
    from dnrtrain.model import render

    workspace, settings = run.workspace, run.settings
    # What evaluate needs is what this needs; the shipped corrector needs the scene alone.
    require_inputs(STAGES["select" if untrained else "evaluate"], workspace, settings)
    if movie != "none" and len({(view.width, view.height) for view in views}) > 1:
        raise UserError("render: the cameras have several image sizes, which no movie can hold; use --movie none")
    name = f"{name}-untrained" if untrained else name
    folder = workspace.root / "renders" / name
    device = torch_device(settings)
    model, model_fingerprint, trained = _renderer(run, device, untrained)
    alone = alone or trained  # training saw no frames that remember: measured, 0.5 dB worse on materials
    fingerprint = digest([model_fingerprint, run.scene_fingerprint, alone, [v.model_dump(mode="json") for v in views]])
    record = folder / "frames.json"
    if folder.exists() and (not record.exists() or record.read_text().strip() != f'"{fingerprint}"'):
        for path in [*folder.glob("frame_*"), *folder.glob(f"{name}.*")]:
            path.unlink()
    write_json(record, fingerprint)
    write_cameras(folder / "cameras.json", views, name)
    paths = _inputs(run, views, folder, alone)
    kind = settings.model.base
    frame = read_frame(workspace)
    pictures: list[np.ndarray] = []
    seconds: list[float] = []
    with run.console.bar("frames", len(views)) as bar:
        for view, path in zip(views, paths, strict=True):
            data = load_views(
                [path],
                None,
                frame,
                cameras=[view],
                folder=workspace.scene,
                target=False,
                base=kind,
                base_files=[path] if kind in RENDERED else None,
            ).to(device)
            started = time.perf_counter()
            output = render(model, data)
            picture = picture_of(output.rgb[0])
            seconds.append(time.perf_counter() - started)
            if movie != "none":
                pictures.append(eight_bit(picture))
            if frames in ("png", "both"):
                write_png(folder / f"frame_{view.name}.png", picture)
            if frames in ("exr", "both"):
                write_frame_exr(folder / f"frame_{view.name}.exr", picture, output.radiance, data, view)
            size = {"width": view.width, "height": view.height}
            run.book("inference", "view", f"neural/{view.name}", seconds[-1], device=device, **size)
            bar.advance()
    target = None if movie == "none" else folder / f"{name}.{movie}"
    if target is not None:
        (write_mp4 if movie == "mp4" else write_webp)(target, pictures)
    return {
        "folder": str(folder),
        "frames": len(views),
        "neural_ms": 1000 * float(np.median(seconds)),
        "movie": target and str(target),
    }


def _renderer(run: Run, device: str, untrained: bool) -> tuple[DNR, str, bool]:
    """(the model, a hash of it, whether it was trained on views of the scene)."""
    from dnrtrain.checkpoint import load_model, read_record
    from dnrtrain.shipped import WEIGHTS, corrector

    if not untrained:
        folder = run.workspace.checkpoints("step2")
        record = read_record(folder)
        trained = record is not None and bool(record.views)
        return load_model(folder, device), run.workspace.manifest.stages["finetune"].output, trained
    require_baked(run.settings, "--untrained")
    model = corrector()
    trust = measure_trust(run, model)
    run.console.say(trust.told)
    return model.to(device), digest([file_sha256(WEIGHTS), trust.share]), False


def write_frame_exr(path: Path, picture: np.ndarray, radiance: Any, data: Any, view: View) -> None:
    """Linear Rec.709 with the coverage as alpha, premultiplied.

    radiance: the network's, straight, [1, 3, H, W], highlights included. None where it works in display space: then
    white is taken out of ``picture`` exactly, and nothing above display white comes back.
    """
    from dnrtrain.exr import write_exr

    alpha = data.tensors.coverage[0, 0].cpu().numpy()
    if radiance is not None:
        linear = radiance[0].float().permute(1, 2, 0).cpu().numpy()
    else:
        straight = np.where(
            alpha[..., None] > 0, (picture - (1 - alpha[..., None])) / np.maximum(alpha[..., None], 1e-3), 0
        )
        linear = srgb.decode(np.clip(straight, 0, 1))
    rgba = np.concatenate([linear * alpha[..., None], alpha[..., None]], axis=-1)
    write_exr(path, {c: rgba[..., i] for i, c in enumerate("RGBA")}, {"view": view.model_dump(mode="json")})


def write_mp4(path: Path, pictures: Iterable[np.ndarray], fps: float = FPS, *, edge: bool = False) -> None:
    """H.264 in MP4 by ffmpeg (imageio-ffmpeg carries it); uint8 [H, W, 3] each, one after the other.

    edge: odd sizes are padded with the picture's edge, instead of white.
    """
    import imageio_ffmpeg

    left = iter(pictures)
    first = next(left)
    height, width = first.shape[:2]
    pad = ((0, height % 2), (0, width % 2), (0, 0))
    with atomic_path(path) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (width + width % 2, height + height % 2),
            fps=fps,  # pyright: ignore[reportArgumentType]: it is printed with two digits
            quality=8,
            macro_block_size=2,
            ffmpeg_log_level="error",
        )
        writer.send(None)
        for picture in chain([first], left):
            padded = np.pad(picture, pad, mode="edge") if edge else np.pad(picture, pad, constant_values=255)
            writer.send(np.ascontiguousarray(padded))
        writer.close()


def write_webp(path: Path, pictures: Sequence[np.ndarray]) -> None:
    """Animated WebP by Pillow; loops for ever."""
    from PIL import Image

    first, *rest = [Image.fromarray(picture) for picture in pictures]
    with atomic_path(path) as temporary:
        first.save(temporary, save_all=True, append_images=rest, duration=1000 // FPS, loop=0, quality=85)


def _inputs(run: Run, views: Sequence[View], frames: Path, alone: bool) -> list[Path]:
    """Files with what the network sees of each view. Base images that are rendered bring the G-buffer along."""
    rendered = run.settings.model.base in RENDERED
    paths = [frames / ("base" if rendered else "gbuffers") / f"{view.name}.exr" for view in views]
    folder = paths[0].parent
    if {path.name for path in folder.glob("[!.]*.exr")} - {path.name for path in paths}:  # of other views
        shutil.rmtree(folder)
    if rendered:
        base_views(run, views, "novel", paths=paths, sequence=not alone)
    else:
        raster = run.settings.model.base == "raster"
        prepared = run.workspace.manifest.prepared
        assert prepared is not None  # the model is of its views
        engine = prepared.raster_engine if raster else GEOMETRY_ENGINE
        draw_passes(run, "G-buffers", views, paths, engine, raster=[raster] * len(views))
    return paths
