"""Frozen meshes -> the bundle's ``ply`` shapes, ``shapegroup`` and ``instance`` elements, and ``meshes/*.ply``.

Dr.Jit traces every shape of a scene separately, for each kernel: 2,000 Mitsuba instances took 86 s a picture where
the same triangles in one mesh take 0.04 s (llvm; 100 instances 0.25 s). So copies are written out as triangles, and
meshes with the same material are joined when there are many. ``instance`` elements are for few copies of heavy meshes
that do not glow (a shapegroup holds no emitters); see `simplify` for many.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..findings import Findings
from ..geometry.frozen import ATLAS_LAYER, FrozenMesh
from ..geometry.simplify import WRITTEN_TRIANGLES
from ..shading.materials import Converted, MaterialConverter
from . import xmltree
from .ply import Welded, weld, write_ply

OPEN_MESH = 1e-3
"""A surface whose area vectors sum to more than this share of its area has a rim."""
UNSEEN_PREFIX = "unseen-"
"""Shapes whose id begins so are invisible to camera rays (Blender's Ray Visibility, Camera)."""
UNSEEN_ATTRIBUTE = "unseen"
"""Mitsuba's loader joins plain meshes of one material and drops their ids; those with an attribute it leaves alone."""
ATLAS_ATTRIBUTE = "atlas"
"""Place in the scene atlas, where light is baked, and the object's number: (U, V, number), the vertex attribute
``vertex_atlas`` of every mesh."""
STRANDS_PREFIX = "hair-"
"""Shapes whose id begins so are strands of hair."""
JOIN_ABOVE = 64  # shapes; up to here every mesh and material keeps a shape of its own


@dataclass
class Piece:
    """One mesh's faces with one material."""

    mesh: FrozenMesh
    converted: Converted
    welded: Welded
    two_sided: bool = False
    """It has a rim and glows or is filled: an emitter must shine from both sides."""

    @property
    def layout(self) -> tuple[object, ...]:
        """What must agree for pieces to be joined."""
        return self.converted.id, self.mesh.camera_visible, self.mesh.strands, self.welded.names


def export_shapes(
    meshes: Sequence[FrozenMesh], used: Sequence[Sequence[tuple[int, Converted]]], converter: MaterialConverter
) -> list[ET.Element]:
    """Write ``meshes/*.ply`` and return the shape elements. used: per mesh the (slot, material) pairs in use."""
    ids = xmltree.Ids()
    joined: dict[tuple[object, ...], list[Piece]] = {}
    elements: list[ET.Element] = []
    many = sum(map(len, used)) > JOIN_ABOVE
    extra = {id(mesh): mesh.triangles * len(mesh.copies) for mesh in meshes if len(mesh.copies)}
    instanced = _too_many(meshes, extra, WRITTEN_TRIANGLES)
    for number, (mesh, slots) in enumerate(zip(meshes, used, strict=True)):
        glowing = any(converter.emitter(converted) is not None for _, converted in slots)
        as_instances = id(mesh) in instanced and not glowing
        copies = mesh.copies[:0] if as_instances else mesh.copies
        pieces = [_piece(mesh, slot, converted, converter, copies) for slot, converted in slots]
        if as_instances:
            elements += _instances(mesh, pieces, converter, ids)
            continue
        for piece in pieces:
            joined.setdefault(piece.layout if many else (number, *piece.layout), []).append(piece)
    for pieces in joined.values():
        elements.append(_shape(pieces, converter, ids))
    return elements


def _too_many(meshes: Sequence[FrozenMesh], extra: dict[int, int], budget: int) -> set[int]:
    """Ids of the meshes whose copies do not fit: the heaviest first, until the rest does."""
    total = sum(extra.values())
    result = set()
    for mesh in sorted(meshes, key=lambda mesh: -extra.get(id(mesh), 0)):
        if total <= budget:
            break
        result.add(id(mesh))
        total -= extra.get(id(mesh), 0)
    return result


def _piece(
    mesh: FrozenMesh, slot: int, converted: Converted, converter: MaterialConverter, copies: np.ndarray
) -> Piece:
    corners = np.repeat(mesh.material_index == slot, 3)
    order = np.flatnonzero(corners)
    positions, normals = mesh.positions[order], mesh.normals[order]
    two_sided = False
    if converter.emitter(converted) is not None or converted.medium is not None:
        balance, volume = closure(positions)
        two_sided = balance >= OPEN_MESH
        if not two_sided and volume < 0:  # area emitters shine, and media begin, on the normal's sides
            order = order.reshape(-1, 3)[:, ::-1].ravel()
            positions, normals = mesh.positions[order], -mesh.normals[order]
    uv = _texture_coordinates(mesh, converted, converter.findings)
    attributes = [(name, values[order]) for name, values in _attributes(mesh, converted, converter.findings)]
    if not mesh.camera_visible:
        attributes.append((UNSEEN_ATTRIBUTE, np.ones((len(order), 1), np.float32)))
    number = np.full((len(order), 1), mesh.object_id, np.float32)
    place = np.concatenate([mesh.atlas[order], number], axis=1)
    attributes.append((ATLAS_ATTRIBUTE, place))
    welded = weld(positions, normals, None if uv is None else uv[order], attributes, copies)
    return Piece(mesh, converted, welded, two_sided)


def _shape(pieces: Sequence[Piece], converter: MaterialConverter, ids: xmltree.Ids) -> ET.Element:
    """``ply`` shape of one material: one mesh's faces, or those of all its meshes."""
    mesh, converted = pieces[0].mesh, pieces[0].converted
    material = xmltree.safe_name(converted.name or "default")
    if len(pieces) > 1:
        name = f"all-{material}"
    else:
        name = mesh.name if len(mesh.materials) == 1 else f"{mesh.name}-{material}"
    prefix = UNSEEN_PREFIX if not mesh.camera_visible else STRANDS_PREFIX if mesh.strands else "mesh-"
    identity = ids.take(prefix.removesuffix("-"), name)
    relative = f"meshes/{identity.removeprefix('mesh-')}.ply"
    write_ply(converter.store.scene_dir / relative, [piece.welded for piece in pieces])
    element = xmltree.plugin("shape", "ply", id=identity)
    xmltree.text(element, "filename", relative)
    xmltree.reference(element, converted.id)
    emitter = converter.emitter(converted)
    if emitter is not None:
        if any(piece.two_sided for piece in pieces):
            emitter.set("type", "dnr_area")
        element.append(emitter)
    if converted.medium is not None:
        xmltree.reference(element, converted.medium.attrib["id"], "interior")
    return element


def _instances(
    mesh: FrozenMesh, pieces: Sequence[Piece], converter: MaterialConverter, ids: xmltree.Ids
) -> Iterator[ET.Element]:
    """One ``shapegroup`` and an ``instance`` per placement."""
    group = xmltree.plugin("shape", "shapegroup", id=ids.take("group", mesh.name))
    for piece in pieces:
        group.append(_shape([piece], converter, ids))
    yield group
    prefix = "" if mesh.camera_visible else UNSEEN_PREFIX
    for number, matrix in enumerate((np.eye(4), *mesh.copies)):
        element = xmltree.plugin("shape", "instance", id=f"{prefix}instance-{group.attrib['id']}-{number}")
        xmltree.reference(element, group.attrib["id"])
        xmltree.matrix(element, "to_world", matrix)
        yield element


def _attributes(mesh: FrozenMesh, converted: Converted, findings: Findings) -> Iterator[tuple[str, np.ndarray]]:
    """The further UV layers and the colour attributes that the material reads, float32 [3T, 3] each."""
    count = len(mesh.positions)
    for number, layer in enumerate(converted.layers, 1):
        uv = uv_layer(mesh, layer)
        if uv is None:
            _note_missing(mesh, converted, f"UV layer '{layer}'" if layer else "UV layer", findings)
            uv = np.zeros((count, 2), np.float32)
        yield f"uv{number}", np.concatenate([uv, np.zeros((count, 1), np.float32)], axis=1)
    for number, name in enumerate(converted.colors):
        color = mesh.colors.get(name or mesh.active_color or "")
        if color is None:
            _note_missing(mesh, converted, f"colour attribute '{name}'", findings, "it is black")
            color = np.zeros((count, 4), np.float32)
        yield f"color{number}", color[:, :3]


def uv_layer(mesh: FrozenMesh, name: str | None) -> np.ndarray | None:
    """A UV layer [3T, 2] by name (ATLAS_LAYER: the scene atlas; '' or None: the active one); None: not there."""
    if name == ATLAS_LAYER:
        return mesh.atlas
    return mesh.uv_layers.get(name or mesh.active_uv or "")


def _texture_coordinates(mesh: FrozenMesh, converted: Converted, findings: Findings) -> np.ndarray | None:
    """The UV layer that the material's images use, [3T, 2]; None when the mesh has none and needs none."""
    uv = uv_layer(mesh, converted.uv)
    if uv is not None:
        return uv
    if converted.uv is None and not converted.textured:
        return next(iter(mesh.uv_layers.values()), None)
    _note_missing(mesh, converted, "UV layer" if converted.uv is None else f"UV layer '{converted.uv}'", findings)
    return np.zeros((len(mesh.positions), 2), dtype=np.float32)


def _note_missing(
    mesh: FrozenMesh, converted: Converted, what: str, findings: Findings, then: str = "coordinates are 0"
) -> None:
    findings.add(
        "missing", what, f"not on this mesh: {then}, as in Cycles", object=mesh.object_name, material=converted.name
    )


def closure(positions: np.ndarray) -> tuple[float, float]:
    """How open a surface is, and which way it faces.

    Returns |sum of area vectors| / sum of areas (0 for a closed surface, by the divergence theorem) and the
    signed volume (negative: normals point inwards).
    """
    triangles = positions.reshape(-1, 3, 3).astype(np.float64)
    triangles = triangles - triangles.mean(axis=(0, 1))
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    total = float(np.linalg.norm(cross, axis=1).sum())
    balance = float(np.linalg.norm(cross.sum(axis=0))) / max(total, 1e-20)
    volume = float(np.einsum("ij,ij->", triangles[:, 0], cross)) / 6
    return balance, volume
