"""`dnrpipe inspect`: what is in a scene file and what becomes of it, without a workspace."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..blender.findings import finding_lines
from ..blender.tasks import InspectAnswer, InspectTask
from ..core.errors import UserError
from ..core.scene_records import Census, Finding, FindingKind
from ..core.settings import PassSettings
from ..effects.bundle import bundle_facts
from ..effects.plan import Effect, plan_effects
from .prepare import open_scene

LISTED = 12  # names per line
ORDER: tuple[FindingKind, ...] = ("approximated", "baked", "ignored", "missing")
MEANING: dict[FindingKind, str] = {
    "approximated": "approximated (converted, looks different in general)",
    "baked": "baked (turned into an image)",
    "ignored": "ignored (left out)",
    "missing": "missing (the scene refers to something that is not there)",
}


@dataclass(frozen=True)
class Inspection:
    """What is in a scene file.

    Args:
        census: with the findings of a conversion.
        effects: rows of the plan before its path depth pilot.
    """

    file: Path
    warnings: list[str]
    census: Census
    effects: tuple[Effect, ...]

    def findings(self, kind: FindingKind) -> list[Finding]:
        return [finding for finding in self.census.findings if finding.kind == kind]

    def data(self) -> dict[str, Any]:
        """All of it, as JSON-able values."""
        census = self.census.data()
        del census["findings"]
        return {
            "file": str(self.file),
            "warnings": self.warnings,
            "census": census,
            "exact": exact(self.census),
            "findings": {kind: [finding.data() for finding in self.findings(kind)] for kind in ("exact", *ORDER)},
            "effects": [effect.model_dump(mode="json", exclude={"cost", "error"}) for effect in self.effects],
        }


def inspect_scene(scene: Path) -> Inspection:
    """Inspect a scene file in a worker process. Raises UserError for unusable input."""
    require_file(scene)
    with tempfile.TemporaryDirectory(prefix="dnrpipe-inspect-") as folder:
        bundle = Path(folder) / "bundle"
        task = InspectTask(source=scene.resolve(), folder=bundle, bake_size=PassSettings().bake_size)
        found, _ = open_scene("dnrpipe.blender.inspection", task, InspectAnswer, Path(folder) / "log")
        facts = bundle_facts(bundle / "scene.xml") if bundle.exists() else {}  # nothing visible: nothing converted
    return Inspection(scene, found.warnings, found.census, plan_effects(found.census, facts).effects)


def require_file(scene: Path) -> None:
    """Raise UserError unless the scene is a file."""
    if scene.is_dir():
        raise UserError(f"{scene}: is a folder; name the scene file in it")
    if not scene.exists():
        raise UserError(f"{scene}: no such file")


def exact(census: Census) -> dict[str, list[str]]:
    """What is converted one to one: materials, lights and the world that no deviation names."""
    deviating = [finding for finding in census.findings if finding.kind in ORDER]
    materials = {finding.material for finding in deviating}
    objects = {finding.object for finding in deviating}
    worldly = any("world" in f.feature and not f.object and not f.material for f in deviating)
    return {
        "materials": [name for name in census.materials if name not in materials],
        "lights": [lamp.name for lamp in census.lights if lamp.name not in objects],
        "world": [census.world.name] if census.world and not worldly else [],
    }


def describe(found: Inspection) -> str:
    """The census as lines for people."""
    census, world = found.census, found.census.world
    counts = ", ".join(f"{count} {kind.lower()}" for kind, count in census.objects.items())
    version = ".".join(census.file_version.split(".")[:2])  # the rest is the file format's own count
    lines = [
        f"{found.file}: scene '{census.scene}', saved by Blender {version}",
        f"  objects: {counts or 'none that pictures show'}",
        f"  geometry: {census.instances} instances, {census.triangles} triangles",
        _named("  materials", list(census.materials)),
        _named("  lights", [lamp.name for lamp in census.lights]),
        f"  world: {world.name} ({world.kind})" if world else "  world: none",
        _named("  images", [image.name for image in census.images]),
    ]
    lines += [f"warning: {text}" for text in found.warnings]
    lines.append("converted exactly:")
    lines += [_named(f"  {kind}", names) for kind, names in exact(census).items()]
    lines += [f"  {line}" for line in finding_lines(found.findings("exact"))]
    for kind in ORDER:
        rows = found.findings(kind)
        lines.append(f"{MEANING[kind]}: {'' if rows else 'nothing'}".rstrip())
        lines += [f"  {line}" for line in finding_lines(rows)]
    on = [effect for effect in found.effects if effect.on]
    lines.append(f"effects that it calls for:{'' if on else ' none'}")
    lines += [f"  {effect.title}: {'; '.join(effect.evidence[:2])}" for effect in on]
    return "\n".join(lines)


def _named(label: str, names: list[str]) -> str:
    if not names:
        return f"{label}: none"
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return f"{label}: {len(names)}: {', '.join(repr(name) for name in names[:LISTED])}{more}"
