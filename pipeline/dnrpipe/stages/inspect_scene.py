"""`dnrpipe inspect`: what is in a scene file and what becomes of it, without a workspace."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from ..blender.finding_lines import finding_lines
from ..core.errors import UserError
from ..core.settings import PassSettings
from ..effects.bundle import bundle_facts
from ..effects.plan import plan_effects
from .opening import open_scene

LISTED = 12  # names per line
ORDER = ("approximated", "baked", "ignored", "missing")
MEANING = {
    "approximated": "approximated (converted, looks different in general)",
    "baked": "baked (turned into an image)",
    "ignored": "ignored (left out)",
    "missing": "missing (the scene refers to something that is not there)",
}


def inspect_scene(scene: Path) -> dict[str, Any]:
    """Census and findings of a scene file, from a worker process.

    Returns {"file", "warnings", "census", "exact": {"materials", "lights", "world"}, "findings": kind -> rows,
    "effects": rows of the plan before its path depth pilot}. Raises UserError for unusable input.
    """
    if scene.is_dir():
        raise UserError(f"{scene}: is a folder; name the scene file in it")
    if not scene.exists():
        raise UserError(f"{scene}: no such file")
    with tempfile.TemporaryDirectory(prefix="dnrpipe-inspect-") as folder:
        bundle = Path(folder) / "bundle"
        task = {"source": str(scene.resolve()), "folder": str(bundle), "bake_size": PassSettings().bake_size}
        answer, _ = open_scene("dnrpipe.blender.inspection", scene, task, Path(folder) / "log")
        facts = bundle_facts(bundle / "scene.xml") if bundle.exists() else {}  # nothing visible: nothing converted
    census = answer["census"]
    findings = {kind: [f for f in census["findings"] if f["kind"] == kind] for kind in ("exact", *ORDER)}
    plan = plan_effects(census, facts)
    return {
        "file": str(scene),
        "warnings": answer["warnings"],
        "census": {key: value for key, value in census.items() if key != "findings"},
        "exact": exact(census),
        "findings": findings,
        "effects": [effect.model_dump(mode="json", exclude={"cost", "error"}) for effect in plan.effects],
    }


def exact(census: dict[str, Any]) -> dict[str, list[str]]:
    """What is converted one to one: materials, lights and the world that no deviation names."""
    deviating = [f for f in census["findings"] if f["kind"] in ORDER]
    materials = {f["material"] for f in deviating}
    objects = {f["object"] for f in deviating}
    world = census["world"]
    worldly = any("world" in f["feature"] and not f["object"] and not f["material"] for f in deviating)
    return {
        "materials": [name for name in census["materials"] if name not in materials],
        "lights": [lamp["name"] for lamp in census["lights"] if lamp["name"] not in objects],
        "world": [world["name"]] if world and not worldly else [],
    }


def describe(found: dict[str, Any]) -> str:
    """The census as lines for people."""
    census = found["census"]
    counts = ", ".join(f"{count} {kind.lower()}" for kind, count in census["objects"].items())
    world = census["world"]
    version = ".".join(census["file_version"].split(".")[:2])  # the rest is the file format's own count
    lines = [
        f"{found['file']}: scene '{census['scene']}', saved by Blender {version}",
        f"  objects: {counts or 'none that pictures show'}",
        f"  geometry: {census['instances']} instances, {census['triangles']} triangles",
        _named("  materials", list(census["materials"])),
        _named("  lights", [lamp["name"] for lamp in census["lights"]]),
        f"  world: {world['name']} ({world['kind']})" if world else "  world: none",
        _named("  images", [image["name"] for image in census["images"]]),
    ]
    lines += [f"warning: {text}" for text in found["warnings"]]
    lines.append("converted exactly:")
    lines += [_named(f"  {kind}", names) for kind, names in found["exact"].items()]
    lines += [f"  {line}" for line in finding_lines(found["findings"]["exact"])]
    for kind in ORDER:
        rows = found["findings"][kind]
        lines.append(f"{MEANING[kind]}: {'' if rows else 'nothing'}".rstrip())
        lines += [f"  {line}" for line in finding_lines(rows)]
    calls = any(effect["on"] for effect in found["effects"])
    lines.append(f"effects that it calls for:{'' if calls else ' none'}")
    lines += [f"  {e['title']}: {'; '.join(e['evidence'][:2])}" for e in found["effects"] if e["on"]]
    return "\n".join(lines)


def _named(label: str, names: list[str]) -> str:
    if not names:
        return f"{label}: none"
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return f"{label}: {len(names)}: {', '.join(repr(name) for name in names[:LISTED])}{more}"
