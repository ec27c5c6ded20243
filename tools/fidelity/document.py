"""docs/fidelity.md and its contact sheets, from the kept records."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from dnrtrain.atomic import write_text

from .formulas import FORMULAS
from .measure import BAKED_DB, ENERGY, EXACT_DB, NOISE_SHARE, Measured, holds
from .reference_settings import BOUNCES
from .run import SEEDS, Plan
from .sheet import write_sheet

Verdict = Literal["holds", "fails", "listed", "error"]
MARKS: dict[Verdict, str] = {"holds": "✓", "fails": "**✗**", "listed": "–", "error": "**error**"}
NOTE_LENGTH = 90
SAYING = ("missing", "ignored", "approximated", "baked")

INTRO = """# Fidelity of the conversion

One feature per scene, {count} scenes built by script (`tools/fidelity/`). Each is rendered by Blender's Cycles and,
after `dnrpipe prepare`'s conversion, by our Mitsuba worker: {spp} and {ours} samples per pixel and seed, {seeds} seeds
each, {bounces} bounces, box filter, linear EXR, transparent film, nothing clamped or denoised. Made by `make fidelity`;
one scene again: `python -m tools.fidelity --only NAME --docs docs` (renders are kept by content in `.cache/fidelity`).

- **says**: what the conversion itself claims (`scene/census.json`). *exact*: no finding; *baked*: turned into images;
  *approximated*: it told the user so.
- **rmse**: relative error of linear radiance, with the noise of both pictures taken off. **PSNR**, **FLIP**: display
  space over white. **floor**: the PSNR that two renderers which agree exactly would show at this noise. All but FLIP
  count covered pixels only.
- **energy**: sum of radiance, ours over Cycles, ± from the two seeds.
- ✓ the claim holds: exact needs PSNR ≥ {exact:g} dB, or nothing but noise (squared error below {share:g}× what noise
  alone gives), and energy within {energy_exact:.0%}; baked needs {baked:g} dB and {energy_baked:.0%}.
  An approximation claims nothing: its error is listed (–).
"""


def verdict(record: dict[str, Any]) -> Verdict:
    """Whether a record bears out what the conversion claims."""
    if record["error"]:
        return "error"
    answer = holds(record["claim"], Measured(**record["measured"]))
    return "listed" if answer is None else "holds" if answer else "fails"


def write_document(records: Sequence[dict[str, Any]], folder: Path, plan: Plan) -> None:
    """``folder``/fidelity.md and ``folder``/images/fidelity-<group>.jpg."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault(record["group"], []).append(record)
    text = INTRO.format(
        count=len(records),
        spp=plan.cycles_spp,
        ours=plan.ours_spp,
        seeds=SEEDS,
        bounces=BOUNCES,
        exact=EXACT_DB,
        share=NOISE_SHARE,
        baked=BAKED_DB,
        energy_exact=ENERGY["exact"],
        energy_baked=ENERGY["baked"],
    )
    parts = [text, _summary(records), _formulas(records)]
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for group, members in groups.items():
        name = f"fidelity-{re.sub(r'[^a-z]+', '-', group.lower()).strip('-')}.jpg"
        write_sheet(members, folder / "images" / name)
        parts.append(f"## {group}\n\n{_table(members)}\n\n![{group}: Cycles, ours, difference](images/{name})\n")
    write_text(folder / "fidelity.md", "\n".join(parts))


def _summary(records: Sequence[dict[str, Any]]) -> str:
    lines = ["| says | scenes | claim holds | fails | median PSNR | median energy error |", "|---|---|---|---|---|---|"]
    for claim in ("exact", "baked", "approximated"):
        own = [r for r in records if not r["error"] and r["claim"] == claim]
        if own:
            verdicts = [verdict(r) for r in own]
            psnr = sorted(r["measured"]["psnr"] for r in own)[len(own) // 2]
            energy = sorted(abs(r["measured"]["energy"] - 1) for r in own)[len(own) // 2]
            held = "–" if claim == "approximated" else str(verdicts.count("holds"))
            failed = "–" if claim == "approximated" else str(verdicts.count("fails"))
            lines.append(f"| {claim} | {len(own)} | {held} | {failed} | {psnr:.1f} dB | {energy:.2%} |")
    broken = [r["name"] for r in records if r["error"]]
    tail = f"\n\nCould not be measured: {', '.join(broken)}." if broken else ""
    return "\n".join(lines) + tail + "\n"


def _table(records: Sequence[dict[str, Any]]) -> str:
    lines = [
        "| feature | says | rmse | PSNR | floor | FLIP | energy | | what the conversion tells the user |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for record in records:
        if record["error"]:
            lines.append(f"| {record['title']} | | | | | | | {MARKS['error']} | {_cell(record['error'])} |")
            continue
        m = Measured(**record["measured"])
        numbers = f"{m.rmse:.3f} | {m.psnr:.1f} | {m.floor:.1f} | {m.flip:.3f} | {m.energy:.3f} ± {m.energy_error:.3f}"
        head = f"| {_cell(record['title'])} | {record['claim']}"
        lines.append(f"{head} | {numbers} | {MARKS[verdict(record)]} | {_note(record['findings'])} |")
    return "\n".join(lines)


def _note(findings: Sequence[dict[str, Any]]) -> str:
    told = [finding for kind in SAYING for finding in findings if finding["kind"] == kind]
    return _cell(f"{told[0]['feature']}: {told[0]['note']}") if told else ""


def _cell(text: str) -> str:
    text = " ".join(text.split()).replace("|", "\\|")
    return text if len(text) <= NOTE_LENGTH else text[: NOTE_LENGTH - 1].rstrip() + "…"


def _formulas(records: Sequence[dict[str, Any]]) -> str:
    lines = [
        "## What other formulas give",
        "",
        "The same bundles with one formula exchanged for what the existing Blender add-on for Mitsuba does (for the",
        "spot, Mitsuba's own falloff). Reference: the same Cycles pictures.",
        "",
        "| scene | formula | rmse ours → theirs | PSNR | energy |",
        "|---|---|---|---|---|",
    ]
    count = 0
    for record in records:
        for name, values in record.get("formulas", {}).items():
            if values is None:
                continue
            m, o = Measured(**record["measured"]), Measured(**values)
            lines.append(
                f"| {record['group']}: {_cell(record['title'])} | {FORMULAS[name][0]} | {m.rmse:.3f} → {o.rmse:.3f}"
                f" | {m.psnr:.1f} → {o.psnr:.1f} | {m.energy:.3f} → {o.energy:.3f} |"
            )
            count += 1
    return "\n".join(lines) + "\n" if count else ""
