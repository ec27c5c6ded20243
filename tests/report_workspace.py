"""A plausible workspace directory for the report's tests: an analytic ball, path-tracer-like noise, a ledger."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tests.scene_records import scene_census, scene_summary

from dnrpipe.core.ledger import CostRecord, Ledger
from dnrtrain.contract import SceneFrame, View, write_cameras
from dnrtrain.exr import write_exr

CENTER = (0.2, -0.1, 0.5)
CHOSEN = ["0004", "0011", "0001", "0007"]


def make_workspace(
    root: Path,
    *,
    candidates: int = 16,
    tests: int = 7,
    size: int = 48,
    evaluated: bool = True,
    lpips: bool = True,
    hostile: str = "",
    chosen: list[str] | None = None,
) -> Path:
    """Fill ``root`` with all files that the stages leave. ``hostile`` is put into names from the .blend."""
    rng = np.random.default_rng(7)
    chosen = CHOSEN if chosen is None else chosen
    views = {
        split: [_view(f"{i:04d}", i, n, size, turn) for i in range(n)]
        for split, n, turn in (("train", candidates, 0.0), ("val", 2, 1.0), ("test", tests, 2.0))
    }
    for split, members in views.items():
        write_cameras(root / "cameras" / f"{split}.json", members, split)
    frame = SceneFrame(near=1.0, far=9.0, center=CENTER, radius=1.2)
    _dump(root / "scene" / "frame.json", frame.model_dump())
    summary = scene_summary(
        bounds={"min": [-1, -1, -0.7], "max": [1.4, 1.1, 1.7], "center": CENTER, "radius": 1.2},
        triangles=18424,
        objects=6,
        repairs={"zero_area_triangles": 3},
        warnings=["image 'wood.png' is missing"],
    )
    _dump(root / "scene" / "summary.json", summary.data())
    _dump(root / "scene" / "census.json", scene_census(findings=_findings(hostile)).data())
    for view in views["train"]:
        raster = _ball(view, shading=0.55)
        write_exr(root / "passes" / "train" / f"{view.name}.exr", raster, {})
    for view in views["train"]:
        if view.name in chosen:
            write_exr(root / "raytraced" / "train" / f"{view.name}.exr", _ball(view, 1.0, rng), {"spp": 128})
    selection = {"policy": "rl-paper", "budget": len(chosen), "seed": 3, "views": chosen, "details": {}}
    _dump(root / "selection.json", selection)
    for step, epochs in ((1, 12), (2, 30)):
        record = {"model": {}, "fingerprint": "f", "run": "r", "stage": f"step{step}", "settings": {}, "seed": 3}
        record |= {"bfloat16": False, "history": _history(step, epochs)}
        _dump(root / "checkpoints" / f"step{step}" / "model.json", record)
    if evaluated:
        _evaluation(root, views["test"], rng, lpips)
    _ledger(root, views, chosen, size, evaluated)
    _dump(root / "manifest.json", _manifest(hostile, candidates, tests, size, len(chosen)))
    return root


def _manifest(hostile: str, candidates: int, tests: int, size: int, budget: int) -> dict[str, Any]:
    step2 = {"epochs": 30, "photometric": "l1", "loss": {"photometric": 1.0, "perceptual": 0.1}}
    return {
        "schema": 1,
        "source": {"path": f"/home/someone/secret/toy room{hostile.replace('/', '')}.blend", "sha256": "ab" * 32},
        "preset": "draft",
        "overrides": {"select": {"budget": budget}},
        "settings": {
            "preset": "draft",
            "cameras": {"source": "auto", "train": candidates, "val": 2, "test": tests, "width": size, "height": size},
            "raytrace": {"spp": 128, "evaluation_spp": 256, "max_depth": 12},
            "select": {"budget": budget, "policy": "rl-paper", "seed": 3, "step1": {"epochs": 12}},
            "finetune": {"step2": step2},
        },
        "stages": {},
        "versions": {"dnrpipe": "0.1.0", "bpy": "5.0.1", "mitsuba": "3.9.1", "torch": "2.13.0+cpu"},
    }


def _findings(hostile: str) -> list[dict[str, Any]]:
    return [
        {
            "kind": "approximated",
            "object": "Teapot" + hostile,
            "material": "Velvet" + hostile,
            "feature": "Principled sheen",
            "note": "sheen weight 0.4 is approximated; about 6 % RMSE",
        },
        {
            "kind": "approximated",
            "object": "Lamp",
            "material": None,
            "feature": "Area light spread",
            "note": "spread 90° has no equivalent: up to 4.5 times brighter on its axis",
        },
        {
            "kind": "ignored",
            "object": "Curtain",
            "material": "Cloth.002",
            "feature": "Layer Weight node",
            "note": "view-dependent factor; its default 0.5 is used",
        },
        {
            "kind": "missing",
            "object": None,
            "material": "Wood",
            "feature": "image 'wood.png'",
            "note": "file not found; shown in magenta",
        },
        {"kind": "exact", "object": "Ball", "material": "Gold", "feature": "Metallic", "note": ""},
    ]


def _view(name: str, index: int, count: int, size: int, turn: float) -> View:
    z = 0.08 + 0.85 * (index + 0.5) / count
    azimuth, ring = turn + index * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - z * z)
    back = np.array([ring * math.cos(azimuth), ring * math.sin(azimuth), z])  # camera's +Z
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = np.array(CENTER) + 4.2 * back
    focal = 1.4 * size
    return View(
        name=name,
        width=size,
        height=size,
        fl_x=focal,
        fl_y=focal,
        cx=size / 2,
        cy=size / 2,
        c2w=tuple(tuple(float(v) for v in row) for row in matrix),
    )


def _ball(view: View, shading: float, rng: np.random.Generator | None = None) -> dict[str, np.ndarray]:
    """A checkered, shaded ball: linear premultiplied R G B A."""
    origin, direction = view.position - np.array(CENTER), view.ray_directions().astype(np.float64)
    b = direction @ origin
    inside = b * b - (origin @ origin - 1.1**2)
    mask = inside > 0
    point = origin + direction * (-b - np.sqrt(np.maximum(inside, 0)))[..., None]
    normal = point / 1.1
    light = np.clip(normal @ np.array([0.5, -0.3, 0.8]), 0, 1) * shading + 0.12
    angle = np.arctan2(normal[..., 1], normal[..., 0])
    checks = ((np.floor(angle * 4) + np.floor(normal[..., 2] * 5)) % 2)[..., None]
    colour = checks * np.array([0.85, 0.32, 0.12]) + (1 - checks) * np.array([0.1, 0.35, 0.6])
    radiance = colour * light[..., None] * mask[..., None]
    if rng is not None:
        radiance *= rng.gamma(200, 1 / 200, mask.shape)[..., None]
    alpha = mask.astype(np.float32)
    return {**{c: radiance[..., i].astype(np.float32) for i, c in enumerate("RGB")}, "A": alpha}


def _display(channels: dict[str, np.ndarray]) -> np.ndarray:
    linear = np.stack([channels[c] for c in "RGB"], axis=-1)
    srgb = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-6) ** (1 / 2.4) - 0.055)
    return np.clip(srgb + (1 - channels["A"][..., None]), 0, 1)


def _evaluation(root: Path, views: list[View], rng: np.random.Generator, lpips: bool) -> None:
    from matplotlib import colormaps

    rows = []
    folder = root / "evaluation"
    folder.mkdir(parents=True)
    for index, view in enumerate(views):
        truth = _display(_ball(view, 1.0, rng))
        error = 0.015 + 0.012 * (index % 4)
        prediction = np.clip(truth + rng.normal(0, error, truth.shape) * (truth.min(-1, keepdims=True) < 1), 0, 1)
        difference = np.abs(prediction - truth).mean(-1)
        for kind, image in (
            ("truth", truth),
            ("prediction", prediction),
            ("flip", colormaps["magma"](np.clip(difference * 4, 0, 1))[..., :3]),
        ):
            Image.fromarray(np.rint(image * 255).astype(np.uint8)).save(folder / f"{view.name}.{kind}.png")
        psnr = float(-10 * np.log10(((prediction - truth) ** 2).mean()))
        rows.append(
            {
                "name": view.name,
                "psnr": psnr,
                "ssim": 0.98 - 8 * error**1.4,
                "lpips_alex": 2.1 * error if lpips else None,
                "lpips_vgg": 2.7 * error if lpips else None,
                "flip": float(difference.mean() * 2),
                "psnr_mask": psnr - 4.1,
                "ssim_mask": 0.95 - 8 * error**1.4,
                "ceiling_psnr": 41.0 + 0.3 * index,
                "seconds_traced": 2.2 + 0.1 * index,
                "seconds_neural": 0.0131,
                "spp": 256,
            }
        )
    mean = {k: (None if rows[0][k] is None else float(np.mean([r[k] for r in rows]))) for k in rows[0] if k != "name"}
    _dump(
        folder / "metrics.json",
        {
            "views": rows,
            "mean": mean,
            "perceptual": lpips,
            "trained_with_perceptual": lpips,
            "device": "cpu",
            "neural_ms": 13.1,
        },
    )


def _history(step: int, epochs: int) -> list[dict[str, Any]]:
    history = []
    for epoch in range(1, epochs + 1):
        fall = math.exp(-3 * epoch / epochs)
        wobble = 1 + 0.06 * math.sin(epoch * 2.1)
        if step == 1:
            losses = {"dnr": 0.03 * fall * wobble + 0.002, "rl": 0.4 * fall + 0.05 * wobble}
            losses |= {"reward": -0.03 * fall * wobble - 0.002, "q": -0.3 * fall - 0.02}
            val = {"psnr": 24.5 - 8 * fall * wobble}
        else:
            scales = {
                "photometric": 0.05,
                "ssim": 0.3,
                "perceptual": 0.8,
                "frequency": 1.6,
                "total_variation": 0.04,
                "regularisation": 0.011,
            }
            losses = {name: scale * (fall * wobble + 0.2) for name, scale in scales.items()}
            losses["total"] = sum(losses.values())
            val = {}
        skipped = 1 if step == 2 and epoch == 4 else 0
        history.append({"epoch": epoch, "losses": losses, "val": val, "seconds": 2.0 * wobble, "skipped": skipped})
    return history


def _ledger(root: Path, views: dict[str, list[View]], chosen: list[str], size: int, evaluated: bool) -> None:
    ledger = Ledger(root / "costs.jsonl")
    clock = 1.76e9

    def book(stage: Any, purpose: Any, unit: Any, name: str, seconds: float, **more: Any) -> None:
        values = {"cpu_seconds": seconds * 0.95, "device": "cpu", "width": size, "height": size, **more}
        ledger.append(
            CostRecord(
                time=clock,
                run=f"{stage}-1",
                stage=stage,
                purpose=purpose,
                unit=unit,
                name=name,
                seconds=seconds,
                **values,
            )
        )

    book("prepare", "training", "scene", "convert", 6.4)
    for split, members in views.items():
        for view in members:
            purpose = "evaluation" if split == "test" else "training"
            book("prepare", purpose, "view", f"{split}/{view.name}", 0.06, workers=2, peak_mb=412.0)
    for epoch in range(1, 13):
        book("select", "training", "epoch", f"epoch {epoch}", 2.0, steps=16)
    mitsuba = {"device": "mitsuba llvm_ad_rgb", "workers": 2, "peak_mb": 655.0}
    for index, name in enumerate(chosen):
        noise = 0.02 + 0.004 * (index % 3)
        book(
            "raytrace",
            "training",
            "view",
            f"train/{name}",
            4.0 + 0.7 * (index % 5),
            spp=128,
            noise=noise,
            **mitsuba,
        )
    for epoch in range(1, 31):
        book("finetune", "training", "epoch", f"epoch {epoch}", 2.0, steps=len(chosen))
    if evaluated:
        for view in views["test"]:
            book("evaluate", "evaluation", "view", f"test/{view.name}", 8.2, spp=256, **mitsuba)
            book("evaluate", "evaluation", "view", f"neural/{view.name}", 0.0131)


def _dump(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=1, allow_nan=False), encoding="utf-8")
