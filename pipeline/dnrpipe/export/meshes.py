"""The bundle's meshes as arrays: what the camera can see, in the world of the .blend. No mitsuba here."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import UserError

SKIPPED = ("light-", "unseen-")
"""Shapes whose ids begin so are invisible to the camera: lamps, and what Ray Visibility hides from it."""


@dataclass(frozen=True)
class BundleMesh:
    """One mesh of one material.

    positions, normals: float32 [V, 3], world axes (Z up), scene units; unit normals (zero where the file has none).
    atlas: float32 [V, 2], (U, V) in the scene atlas, V up. uv: the artist's own [V, 2], V up, or None.
    faces: int32 [T, 3]. placements: float64 [K, 4, 4], where it stands; the identity alone where it is no instance.
    """

    name: str
    material: str
    positions: np.ndarray
    normals: np.ndarray
    atlas: np.ndarray
    uv: np.ndarray | None
    faces: np.ndarray
    placements: np.ndarray


def read_meshes(scene: Path) -> list[BundleMesh]:
    """Meshes of ``scene/scene.xml`` that the camera can see. Raises UserError: missing or damaged, or none."""
    bundle = scene / "scene.xml"
    remedy = "run `dnrpipe prepare --force`"
    try:
        text = bundle.read_text(encoding="utf-8")
        root = ET.fromstring(text)
    except FileNotFoundError:
        raise UserError(f"{bundle}: is missing; run `dnrpipe prepare` first") from None
    except (ET.ParseError, UnicodeDecodeError) as error:
        raise UserError(f"{bundle}: damaged ({error}); {remedy}") from None
    scale = re.search(r'<default name="unit_scale" value="([^"]+)"', text[:512])
    unit = float(scale[1]) if scale else 1.0
    placed: dict[str, list[np.ndarray]] = {}
    for instance in root.findall("shape[@type='instance']"):
        reference, matrix = instance.find("ref"), instance.find("transform/matrix")
        if reference is None or matrix is None or instance.get("id", "").startswith(SKIPPED):
            continue
        numbers = np.array([float(part) for part in matrix.attrib["value"].split()]).reshape(4, 4)
        numbers[:3, 3] /= unit
        placed.setdefault(reference.attrib["id"], []).append(numbers)
    found = [
        _mesh(shape, scene, unit, [np.eye(4)])
        for shape in root.findall("shape[@type='ply']")
        if not shape.get("id", "").startswith(SKIPPED)
    ]
    for group in root.findall("shape[@type='shapegroup']"):
        places = placed.get(group.attrib["id"], [])
        found += [_mesh(shape, scene, unit, places) for shape in group.findall("shape[@type='ply']") if places]
    if not found:
        raise UserError(f"{bundle}: has no mesh that the camera can see; {remedy}")
    return found


def read_ply(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns (float32 [V] by name) and faces (int32 [T, 3]) of a PLY of ours. Raises UserError when it is damaged."""
    try:
        raw = path.read_bytes()
        head, body = raw.split(b"end_header\n", 1)
        lines = head.decode("ascii").splitlines()
        (vertices,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex "))
        (count,) = (int(line.split()[2]) for line in lines if line.startswith("element face "))
        names = [line.split()[2] for line in lines if line.startswith("property float ")]
        table = np.frombuffer(body, "<f4", vertices * len(names)).reshape(vertices, len(names))
        kind = np.dtype([("n", "u1"), ("v", "<i4", 3)])
        faces = np.frombuffer(body, kind, count, offset=table.nbytes)["v"]
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: not a mesh of ours ({error}); run `dnrpipe prepare --force`") from None
    if len(faces) and (faces.min() < 0 or faces.max() >= vertices):
        raise UserError(f"{path}: faces name vertices that are not there; run `dnrpipe prepare --force`")
    return {name: table[:, i] for i, name in enumerate(names)}, faces


def _mesh(shape: ET.Element, scene: Path, unit: float, placements: list[np.ndarray]) -> BundleMesh:
    file, material = shape.find("string[@name='filename']"), shape.find("ref")
    assert file is not None
    columns, faces = read_ply(scene / file.attrib["value"])

    def stacked(*names: str) -> np.ndarray:
        return np.stack([columns[name] for name in names], axis=1)

    return BundleMesh(
        name=shape.get("id", "mesh"),
        material=material.attrib["id"].removeprefix("mat-") if material is not None else "default",
        positions=stacked("x", "y", "z") / np.float32(unit),
        normals=stacked("nx", "ny", "nz"),
        atlas=stacked("atlas_x", "atlas_y"),
        uv=stacked("s", "t") if "s" in columns else None,
        faces=faces,
        placements=np.stack(placements),
    )
