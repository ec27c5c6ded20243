"""Tables over all scenes of what `moving` measured: who is ahead within a time, who flickers, from when ours pays.

A renderer's figures are means over the moves. The rival's best is the better of those with gathered samples and
without.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dnrpipe.studies.cells.results import number
from dnrpipe.studies.frames.ours import REMEMBERS, is_own

from . import equal_time
from .standing import CLASSES, class_limits

FLICKER = ("flicker", "flicker_rms")
FIGURES = ("ms", "psnr", "lpips_alex", *FLICKER)
Rows = dict[str, dict[str, float]]


def over_moves(scene: Mapping[str, Any]) -> Rows:
    """Every renderer's FIGURES, means over the moves."""
    moves = [move["rows"] for move in scene["moving"].values()]
    return {
        name: {key: float(np.mean([rows[name][key] for rows in moves])) for key in FIGURES if key in row}
        for name, row in moves[0].items()
    }


def best_within(rows: Rows, limit_ms: float, *, ours: bool) -> str | None:
    """The renderer of the highest PSNR that takes at most so long, of ours or of the rival's."""
    fast = [name for name, row in rows.items() if row["ms"] <= limit_ms and is_own(name) == ours]
    return max(fast, key=lambda name: rows[name]["psnr"]) if fast else None


def lines(scenes: Sequence[Mapping[str, Any]]) -> list[str]:
    """The tables of all scenes whose moves were measured; empty where there is none."""
    known = [scene for scene in scenes if "moving" in scene]
    if not known:
        return []
    first = next(iter(known[0]["moving"].values()))
    table = [
        f"Moving cameras, {' and '.join(known[0]['moving'])} of {first['frames']} frames: means over both, of six"
        f" frames each, against {first['reference_spp']} samples. The rival's samples are gathered over the frames"
        " where that is better. Flicker: mean absolute difference of the change from frame to frame, after"
        " reprojection, from the reference's, x 1000, which counts that one's noise; beside it, and in the last column,"
        " its root mean square without that noise (by two halves of the reference).",
        "",
        "| scene | within | ours | dB | LPIPS | flicker | its best | dB | LPIPS | flicker"
        " | lead | of its flicker | without noise |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for scene in known:
        rows = over_moves(scene)
        for limit in class_limits(scene["size"])[: len(CLASSES) - 1]:
            pair = [best_within(rows, limit, ours=ours) for ours in (True, False)]
            cells = [scene["scene"], f"{limit:.0f} ms"]
            for name in pair:
                row = rows[name] if name else {}
                shown = "-" if name is None else f"{equal_time.short(name)}, {row['ms']:.0f} ms"
                cells += [shown, number(row.get("psnr"), 2), number(row.get("lpips_alex"), 4)]
                cells += [" / ".join(number(1000 * row[key] if key in row else None, 1) for key in FLICKER)]
            mine, rival = pair
            if mine and rival:
                lead = rows[mine]["psnr"] - rows[rival]["psnr"]
                shares = (f"{rows[mine][key] / rows[rival][key]:.0%}" if key in rows[rival] else "-" for key in FLICKER)
                cells += [f"{lead:+.2f}", *shares]
            else:
                cells += ["-", "-", "-"]
            table.append(f"| {' | '.join(cells)} |")
    counted = equal_time.lines([_as_standing(scene) for scene in known])
    if counted:
        table += ["", "The same frames, everything before the first one counted:", "", *counted]
    return table


def _as_standing(scene: Mapping[str, Any]) -> dict[str, Any]:
    """What `equal_time` reads, with the moves' rows in place of those of single views; ours are those that remember."""
    rows = over_moves(scene)
    ours = [name for name in rows if is_own(name) and REMEMBERS in name]
    kept = {key: scene[key] for key in ("scene", "upfront") if key in scene}
    return {**kept, "rows": rows, "standing": ours}
