"""The example scenes side by side, Cycles and ours, in docs/scenes.md (``make scenes``).

Cycles is asked for what the file says of the world and lamps, with our settings of everything else. Beside
each picture stand what the conversion told the user and where the two pictures differ, measured.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from dnrpipe.core.console import Console
from dnrpipe.core.images import read_rgba
from dnrpipe.core.workspace import file_sha256
from dnrpipe.workers.task_list import run_tasks
from dnrtrain.atomic import atomic_path, write_json, write_text

from . import ours
from .measure import Measured, compare, display, mean
from .sheet import GAIN, to_image

SEEDS = 2
TIMEOUT = 3600.0
JPEG_QUALITY = 85
BLOCKS = 4
WHERE = ("top", "upper middle", "lower middle", "bottom"), ("left", "centre left", "centre right", "right")


def main() -> int:
    """Exit code 1 when a scene could not be shown."""
    options = _options()
    blends = options.scenes or sorted(Path("blender_scenes").glob("*.blend"))
    console = Console()
    records = []
    with console.bar("scenes", len(blends)) as bar:
        for blend in blends:
            record = show(blend, options, console)
            records.append(record)
            console.say(_line(record))
            bar.advance(note=blend.stem)
    write_json(options.cache / "gallery" / "records.json", records)
    write_document(records, options)
    return 1 if any(record["error"] for record in records) else 0


def show(blend: Path, options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Render one scene with both and write docs/images/scenes/<name>.jpg (Cycles, ours, difference)."""
    record: dict[str, Any] = {"name": blend.stem, "error": None}
    content = [file_sha256(blend), options.side, options.cycles_spp]
    folder = options.cache / "gallery" / f"{blend.stem}-{_digest(content)}"
    expected = [folder / f"cycles.{seed}.exr" for seed in range(SEEDS)]
    size = (options.side, options.side)
    try:
        if not all(path.is_file() for path in expected):
            task = {"blend": str(blend.resolve()), "outputs": [str(p) for p in expected], "spp": options.cycles_spp}
            _cycles({**task, "size": size}, folder / "cycles.log")
        key = ours.code_hash(ours.CONVERSION)
        root = folder / f"{key}.dnr"
        if (root / "scene" / "prepared.json").is_file():
            workspace = ours.Workspace.open(root)
        else:
            workspace = ours.convert(blend, root)
        traced = folder / _digest([key, ours.tracing_hash(workspace.scene / "scene.xml"), options.spp])
        outputs = [traced / f"{seed}.exr" for seed in range(SEEDS)]
        if not all(path.is_file() for path in outputs):
            ours.trace(workspace, outputs, size=size, spp=options.spp)
    except ours.FidelityError as error:
        return {**record, "error": str(error)}
    pictures = [read_rgba(path) for path in expected], [read_rgba(path) for path in outputs]
    measured = compare(*pictures)
    shown = [display(mean(each)) for each in pictures]
    write_triptych(shown[0], shown[1], options.docs / "images" / "scenes" / f"{blend.stem}.jpg")
    record |= {
        "measured": vars(measured),
        "findings": ours.findings(workspace),
        "where": differences(shown[0], shown[1]),
    }
    return record


def write_triptych(cycles: np.ndarray, found: np.ndarray, target: Path) -> None:
    """Cycles, ours and their smoothed difference beside each other as JPEG."""
    both = np.concatenate([cycles, found, np.abs(smoothed(found - cycles)) * GAIN], axis=1)
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as temporary:
        picture: Image.Image = to_image(both)
        picture.save(temporary, "JPEG", quality=JPEG_QUALITY, optimize=True)


def smoothed(signed: np.ndarray) -> np.ndarray:
    """Mean of the 5 x 5 neighbourhood, [H, W, 3]: what is left of a difference when noise averages out."""
    padded = np.pad(signed, ((2, 2), (2, 2), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5, 1))  # [H, W, 3, 5, 5, 1]
    return windows.mean(axis=(-3, -2, -1))


def differences(cycles: np.ndarray, found: np.ndarray) -> str:
    """The part of the frame with the largest mean difference, and by how much it is brighter or darker."""
    height, width = (side // BLOCKS * BLOCKS for side in cycles.shape[:2])
    signed = (found - cycles)[:height, :width].mean(axis=2)
    blocks = signed.reshape(BLOCKS, height // BLOCKS, BLOCKS, width // BLOCKS).mean(axis=(1, 3))
    row, column = np.unravel_index(int(np.abs(blocks).argmax()), blocks.shape)
    value = float(blocks[row, column])
    if abs(value) < 0.004:  # one step of 8 bits
        return "no part of the frame differs by a visible amount in the mean"
    side = "brighter" if value > 0 else "darker"
    return f"most at {WHERE[0][row]} {WHERE[1][column]}: ours is {abs(value) * 255:.0f}/255 {side} there"


def write_document(records: Sequence[dict[str, Any]], options: argparse.Namespace) -> None:
    """docs/scenes.md."""
    lines = [
        "# The example scenes, Cycles and ours",
        "",
        f"Each scene of `blender_scenes/` from its camera at {options.side}²: Cycles ({SEEDS} × {options.cycles_spp} "
        f"samples per pixel), our bundle ({SEEDS} × {options.spp}), and their difference in display space × {GAIN:g},",
        "averaged over 5 × 5 pixels so that it shows beyond the noise. No denoiser on either side.",
        "Made by `make scenes`; the figures are those of `docs/fidelity.md`.",
    ]
    for record in records:
        lines += ["", f"## {record['name']}", ""]
        if record["error"]:
            lines.append(f"Could not be rendered: {record['error']}")
            continue
        m = Measured(**record["measured"])
        lines += [
            f"![{record['name']}: Cycles, ours, difference](images/scenes/{record['name']}.jpg)",
            "",
            f"PSNR {m.psnr:.1f} dB (noise alone {m.floor:.1f}), FLIP {m.flip:.3f}, energy {m.energy:.3f};"
            f" {record['where']}. {_told(record['findings'])}",
        ]
    write_text(options.docs / "scenes.md", "\n".join(lines) + "\n")


def _told(findings: Sequence[dict[str, Any]]) -> str:
    """One sentence on what the conversion did not do exactly."""
    counted: dict[tuple[str, str], list[str]] = {}
    for finding in findings:
        if finding["kind"] in ("approximated", "ignored", "missing", "baked"):
            names = counted.setdefault((finding["kind"], finding["feature"]), [])
            names.append(finding["material"] or finding["object"] or "")
    parts = []
    for kind in ("missing", "ignored", "approximated", "baked"):
        features = sorted({feature for k, feature in counted if k == kind})
        if features:
            more = f" and {len(features) - 6} more" if len(features) > 6 else ""
            parts.append(f"{kind}: {', '.join(features[:6])}{more}")
    return f"The conversion says: {'; '.join(parts)}." if parts else "Everything is converted exactly."


def _cycles(task: dict[str, Any], log: Path) -> None:
    for outcome in run_tasks("tools.fidelity.existing", {}, [task], workers=1, log=log, timeout=TIMEOUT):
        if outcome.result is None:
            raise ours.FidelityError(f"Cycles: {outcome.error}")


def _line(record: dict[str, Any]) -> str:
    if record["error"]:
        return f"{record['name']:14} FAILED: {record['error']}"
    m = Measured(**record["measured"])
    return f"{record['name']:14} psnr {m.psnr:5.1f} (floor {m.floor:5.1f})  flip {m.flip:.4f}  energy {m.energy:.4f}"


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.fidelity.gallery", description=__doc__)
    parser.add_argument("scenes", nargs="*", type=Path, help=".blend files; all of blender_scenes/ without")
    parser.add_argument("--cache", type=Path, default=Path(".cache/fidelity"), help="where renders are kept")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder that gets scenes.md and images/scenes/")
    parser.add_argument("--side", type=int, default=192, help="width and height in pixels")
    parser.add_argument("--cycles-spp", type=int, default=256, help="samples of each of two Cycles pictures")
    parser.add_argument("--spp", type=int, default=384, help="samples of each of our two pictures")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
