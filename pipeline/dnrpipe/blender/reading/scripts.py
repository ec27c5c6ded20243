"""Python inside scene files: never executed, always reported."""

from __future__ import annotations

import bpy

from ..findings import Findings, first_of
from .names import data_collections, node_trees

SHOWN = 4


def script_warnings() -> list[str]:
    """One line on the drivers that stand still because they are Python, one on scripts that wanted to run."""
    lines = []
    drivers = [f"{owner}.{path}" for owner, path in refused_drivers()]
    if drivers:
        names = first_of(drivers, SHOWN)
        lines.append(f"{len(drivers)} Python driver(s) not executed, their values stay as saved: {names}")
    scripts = [text.name for text in bpy.data.texts if text.use_module]
    if scripts:
        lines.append(f"embedded script(s) not executed: {', '.join(scripts[:SHOWN])}")
    return lines


def note_drivers(findings: Findings) -> None:
    """Record every driver that was not executed."""
    for owner, path in refused_drivers():
        findings.add("ignored", "Python driver", f"'{path}' stays as saved: scripts are never executed", object=owner)


def refused_drivers() -> list[tuple[str, str]]:
    """(data-block, property) of drivers with an expression that only Python could evaluate.

    Blender evaluates arithmetic by itself ("simple expressions") and a safe subset of Python; what it
    refused is marked invalid once it was evaluated.
    """
    found = []
    blocks = [(block, block) for collection in data_collections() for block in collection]
    # Trees inside materials, worlds and lights are no data-blocks of their own.
    blocks += [(owner, tree) for owner, tree in node_trees() if owner != tree]
    for owner, block in blocks:
        animation = getattr(block, "animation_data", None)
        for curve in [] if animation is None else animation.drivers:
            driver = curve.driver
            if driver.type == "SCRIPTED" and not driver.is_simple_expression and not driver.is_valid:
                found.append((owner.name_full, curve.data_path))
    return sorted(found)
