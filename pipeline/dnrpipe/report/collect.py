"""Workspace -> `ReportData`: reads the stages' files, computes statistics, lists what is missing."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from dnrtrain.contract import ContractError, DamagedFile, SceneFrame, View, read_cameras
from dnrtrain.records import ModelRecord, read
from dnrtrain.records import Selection as SelectionRecord

from ..core.errors import UserError
from ..core.ledger import CostRecord, CostSummary, Ledger, break_even_frames, summarise, traced_views, upfront_seconds
from ..core.scene_files import read_census, read_summary
from ..core.scene_records import FindingKind
from ..stages.records import METRICS, Metrics
from .advice import missing, notes, verdict
from .budget import build_budget
from .coverage import coverage_maps
from .data import ChosenView, FindingGroup, ReportData, Selection, Sphere, SphereView, Training
from .pictures import load_exr
from .quality import build_quality

KINDS: dict[FindingKind, tuple[str, bool]] = {
    "missing": ("The file refers to something that is not there.", True),
    "ignored": ("No counterpart in the ray tracer; left out of the ground truth.", True),
    "approximated": ("Converted to the nearest thing; the ground truth differs a little from Blender.", True),
    "baked": ("Evaluated once into a texture.", False),
    "exact": ("Converted without loss.", False),
}
ROW = ("object", "material", "feature", "note")
STEP_TITLES = {
    1: "Step 1: rasterised images, all candidates",
    2: "Step 2: ray-traced images, chosen views",
}
AGENT_TERMS = ("reward", "q")  # recorded beside the losses of step 1, but signed and no losses
Model = TypeVar("Model", bound=BaseModel)
R = TypeVar("R")


@dataclass(frozen=True)
class Outline:
    """A workspace's figures without pictures: quick enough to read while a stage runs.

    cameras: train and test. selected: the chosen views by their names in the ledger; None before there are any.
    """

    cameras: dict[str, list[View]]
    metrics: Metrics | None
    chosen: SelectionRecord | None
    selected: set[str] | None
    sphere: Sphere | None
    training: list[Training]
    records: list[CostRecord]
    costs: CostSummary


def outline(root: Path) -> Outline:
    """Read a workspace's figures. Raises UserError: a file is damaged."""
    cameras = {split: _read_views(root, split) for split in ("train", "test")}
    metrics = _read_model(root / "evaluation" / METRICS, Metrics, "evaluate")
    chosen = _read_model(root / "selection.json", SelectionRecord, "select")
    selected = {f"train/{name}" for name in chosen.views} if chosen else None
    ledger = Ledger(root / "costs.jsonl")
    records, candidates, truncated = ledger.read(), len(cameras["train"]) or None, ledger.truncated_records()
    return Outline(
        cameras=cameras,
        metrics=metrics,
        chosen=chosen,
        selected=selected,
        sphere=_sphere(root, cameras, chosen, metrics),
        training=[t for t in (_training(root, step) for step in (1, 2)) if t],
        records=records,
        costs=summarise(records, n_candidates=candidates, only=selected, truncated_records=truncated),
    )


def collect(root: Path, *, made_at: datetime | None = None) -> ReportData:
    """Read a workspace. Parts whose stage has not run are None and listed in ``missing``.

    Raises UserError: not a workspace, or one of its files is damaged; names the file and the remedy.
    """
    root = Path(root).resolve()
    manifest = _read_json(root / "manifest.json")
    if manifest is None:
        raise UserError(f"{root}: not a dnrpipe workspace; make one with `dnrpipe prepare SCENE`")
    known = outline(root)
    records, training, cameras = known.records, known.training, known.cameras
    quality = build_quality(root, known.metrics, records) if known.metrics else None
    selection = _selection(root, known.chosen, records, cameras["train"]) if known.chosen else None
    upfront = upfront_seconds(records, known.selected) if records else None
    break_even = None
    if quality and upfront and quality.traced_seconds and quality.frame_seconds:
        break_even = break_even_frames(upfront, quality.traced_seconds, quality.frame_seconds)
    sizes = {(v.width, v.height) for views in (*cameras.values(), _read_views(root, "val")) for v in views}
    source = manifest.get("source", {})
    source_name = Path(str(source.get("path", ""))).name or root.stem
    return ReportData(
        title=Path(source_name).stem or root.stem,
        workspace=root.name,
        source_name=source_name,
        source_sha256=str(source.get("sha256", "")),
        preset=str(manifest.get("preset") or manifest.get("settings", {}).get("preset") or "draft"),
        resolution=" and ".join(f"{w} × {h}" for w, h in sorted(sizes)) or None,
        made_at=(made_at or datetime.now(UTC)).strftime("%Y-%m-%d %H:%M UTC"),
        verdict=verdict(quality, selection),
        notes=notes(quality, selection, training, known.costs, manifest, upfront, break_even),
        missing=missing(root, cameras, selection, quality),
        quality=quality,
        selection=selection,
        sphere=known.sphere,
        training=training,
        costs=known.costs if records else None,
        budget=build_budget(root, quality, upfront),
        break_even=break_even,
        upfront_seconds=upfront,
        findings=_findings(root),
        summary=_summary(root),
        settings=_flatten(manifest.get("settings", {}), manifest.get("overrides", {})),
        versions=sorted((str(k), str(v)) for k, v in manifest.get("versions", {}).items()),
    )


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise UserError(f"{path}: damaged JSON ({error}); run `dnrpipe prepare` again") from None
    if not isinstance(value, dict):
        raise UserError(f"{path}: not a JSON object; run `dnrpipe prepare` again")
    return value


def _read_model(path: Path, model: type[Model], command: str) -> Model | None:
    """A record; None where there is none. Raises UserError that names the command that makes it again."""
    try:
        return read(path, model)
    except FileNotFoundError:
        return None
    except DamagedFile as damage:
        raise UserError(f"{path}: damaged ({damage.reason}); run `dnrpipe {command}` again") from None


def _of_scene(root: Path, name: str, reader: Callable[[Path], R]) -> R | None:
    """What ``reader`` finds in ``scene/``; None where the file is missing."""
    if not (root / "scene" / name).exists():
        return None
    try:
        return reader(root / "scene")
    except DamagedFile as error:
        raise UserError(f"{error.path}: {error.reason}; run `dnrpipe prepare` again") from None


def _read_views(root: Path, split: str) -> list[View]:
    path = root / "cameras" / f"{split}.json"
    if not path.exists():
        return []
    if (_read_json(path) or {}).get("frames") == []:  # a split may be empty (no validation views)
        return []
    try:
        return read_cameras(path)
    except ContractError as error:
        raise UserError(str(error)) from None


def _selection(
    root: Path, chosen: SelectionRecord, records: Sequence[CostRecord], candidates: Sequence[View]
) -> Selection:
    from dnrtrain.display import DisplayTransform

    frame = _read_model(root / "scene" / "frame.json", SceneFrame, "prepare")
    try:
        display = DisplayTransform(frame, root / "scene") if frame else None
    except ContractError as error:
        raise UserError(str(error)) from None
    tracing = {r.name: r for r in traced_views(records, "training")}
    views = []
    for order, name in enumerate(chosen.views, start=1):
        record = tracing.get(f"train/{name}")
        views.append(
            ChosenView(
                order=order,
                name=name,
                **(record.model_dump(include={"seconds", "spp", "noise"}) if record else {}),
                raster=load_exr(root, f"passes/train/{name}.exr", display) if display else None,
                traced=load_exr(root, f"raytraced/train/{name}.exr", display) if display else None,
                why=chosen.why[order - 1] if order <= len(chosen.why) else None,
            )
        )
    return Selection(
        **chosen.model_dump(include={"policy", "seed", "budget"}),
        views=views,
        traced=sum((root / "raytraced" / "train" / f"{name}.exr").is_file() for name in chosen.views),
        candidates=len(candidates),
        trained=(root / "checkpoints" / "step1" / "model.json").is_file(),
        measure=str(chosen.details["measure"]) if "measure" in chosen.details else None,
        coverage=coverage_maps(root, candidates, chosen.views),
    )


def _training(root: Path, step: int) -> Training | None:
    checkpoint = _read_model(
        root / "checkpoints" / f"step{step}" / "model.json", ModelRecord, ("select", "finetune")[step - 1]
    )
    if checkpoint is None or not checkpoint.history:
        return None
    history = checkpoint.history
    first = min(entry.epoch for entry in history)
    curves: dict[str, list[tuple[int, float]]] = {}
    psnr: list[tuple[int, float]] = []
    for entry in history:
        number = entry.epoch - first + 1
        for term, value in entry.losses.items():
            curves.setdefault(term, []).append((number, value))
        if (quality := entry.val.get("psnr")) is not None:
            psnr.append((number, quality))
    return Training(
        step=step,
        title=STEP_TITLES[step],
        epochs=len(history),
        seconds=math.fsum(entry.seconds for entry in history),
        skipped=sum(entry.skipped for entry in history),
        losses={term: points for term, points in curves.items() if term not in AGENT_TERMS},
        agent={term: points for term, points in curves.items() if term in AGENT_TERMS},
        psnr=psnr,
    )


def _sphere(
    root: Path, cameras: dict[str, list[View]], chosen: SelectionRecord | None, metrics: Metrics | None
) -> Sphere | None:
    shown = [("candidate", view) for view in cameras["train"]] + [("test", view) for view in cameras["test"]]
    if not shown:
        return None
    summary = _of_scene(root, "summary.json", read_summary)
    sphere = summary.bounds if summary else _read_model(root / "scene" / "frame.json", SceneFrame, "prepare")
    if sphere is None:
        axes = list(zip(*(view.position for _, view in shown), strict=True))
        center, radius = tuple(statistics.fmean(float(value) for value in axis) for axis in axes), 0.0
    else:
        center, radius = sphere.center, sphere.radius
    offsets = [tuple(float(p - c) for p, c in zip(view.position, center, strict=True)) for _, view in shown]
    scale = max(max(math.hypot(*offset) for offset in offsets), 1e-9)
    order = {name: i for i, name in enumerate(chosen.views, start=1)} if chosen else {}
    psnr = {view.name: view.psnr for view in metrics.views} if metrics else {}
    views = []
    for (role, view), offset in zip(shown, offsets, strict=True):
        number = order.get(view.name) if role == "candidate" else None
        x, y, z = (value / scale for value in offset)
        views.append(
            SphereView(
                name=view.name,
                role="chosen" if number else "test" if role == "test" else "candidate",
                order=number,
                position=(x, y, z),
                psnr=psnr.get(view.name) if role == "test" else None,
            )
        )
    return Sphere(views=views, scale=scale, radius=min(1.0, radius / scale))


def _findings(root: Path) -> list[FindingGroup]:
    census = _of_scene(root, "census.json", read_census)
    groups = []
    for kind, (meaning, serious) in KINDS.items():
        found = [finding for finding in census.findings if finding.kind == kind] if census else []
        rows = [{key: getattr(finding, key) or "" for key in ROW} for finding in found]
        if rows:
            groups.append(FindingGroup(kind=kind, meaning=meaning, serious=serious, findings=rows))
    return groups


def _summary(root: Path) -> list[tuple[str, str]]:
    summary = _of_scene(root, "summary.json", read_summary)
    if summary is None:
        return []
    rows = [
        ("triangles", f"{summary.triangles:,}".replace(",", " ")),
        ("objects", f"{summary.objects:,}".replace(",", " ")),
        ("blender", summary.blender_version),
    ]
    for part, facts in (("atlas", summary.atlas.data()), ("repairs", summary.repairs)):
        for key, value in sorted(facts.items()):
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            rows.append((f"{part} {key}".replace("_", " "), shown))
    return rows + [("warning", text) for text in summary.warnings]


def _flatten(settings: dict[str, Any], overrides: dict[str, Any], prefix: str = "") -> list[tuple[str, str, bool]]:
    """Nested settings as (dotted key, value, given by the user?) rows in their own order."""
    rows: list[tuple[str, str, bool]] = []
    for key, value in settings.items():
        given = overrides.get(key) if isinstance(overrides, dict) else None
        if isinstance(value, dict):
            rows += _flatten(value, given if isinstance(given, dict) else {}, f"{prefix}{key}.")
        else:
            rows.append((prefix + key, str(value), given is not None))
    return rows
