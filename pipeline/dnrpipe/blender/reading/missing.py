"""Files that the open file refers to: which are there, which are gone, and what stands for them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from dnrpipe.core.scene_records import FindingKind

from ..findings import Findings, first_of, printable
from ..shading.sockets import NOT_IN_CYCLES, UNDEFINED, computes
from .names import data_collections, node_trees

SHAPELESS_IMAGES = {"GENERATED", "VIEWER"}  # sources without a file
SHOWN = 5  # names per warning

STAND_INS = {
    "image": "drawn in magenta, as Blender does",
    "linked library": "its data are absent",
    "font": "its text takes Blender's own font",
    "volume": "its volume is absent",
    "cache": "what it animates stays as it was saved",
    "IES file": "its lamp shines alike in all directions",
}
"""What stands for a missing file, by kind."""


@dataclass(frozen=True)
class Reference:
    """A file that a data-block refers to. name: the data-block's; path: absolute, as Blender resolves it."""

    kind: str
    name: str
    path: Path

    @property
    def present(self) -> bool:
        """Whether the file is there; a cache may be a folder."""
        return is_file(self.path, or_folder=self.kind == "cache")


def references() -> list[Reference]:
    """Every outside file that the open file's pictures may depend on; packed data have none."""
    return sorted({*_images(), *_others()}, key=lambda r: (r.kind, r.name, str(r.path)))


def missing_files() -> list[Reference]:
    """References whose file is not there."""
    return [reference for reference in references() if not reference.present]


def missing_warnings(missing: list[Reference]) -> list[str]:
    """One line per kind of missing file, naming them."""
    lines = []
    for kind, stand_in in STAND_INS.items():
        gone = [f"'{printable(r.name)}' ({printable(str(r.path))})" for r in missing if r.kind == kind]
        if gone:
            what = f"{kind} {gone[0]} is" if len(gone) == 1 else f"{len(gone)} files of kind {kind} are"
            names = "" if len(gone) == 1 else f": {first_of(gone, SHOWN)}"
            names += " (all in census.json)" if len(gone) > SHOWN else ""
            lines.append(f"{what} missing ({stand_in}){names}")
    return lines


def strict_refusal(missing: list[Reference]) -> str:
    """One line for ``--strict``: everything that is missing."""
    listed = ", ".join(f"{r.kind} '{printable(r.name)}' ({printable(str(r.path))})" for r in missing)
    return f"{len(missing)} file(s) missing: {listed}; put them there, or leave out --strict"


def note_missing(findings: Findings) -> None:
    """Record missing files, and linked data-blocks that are not in their library.

    The census and the texture reader record whole images; single tiles of a UDIM image are recorded here.
    """
    tiled = {image.name_full for image in bpy.data.images if image.source == "TILED"}
    for reference in missing_files():
        if reference.kind != "image" or reference.name in tiled:
            findings.add(
                "missing",
                f"{reference.kind} '{printable(reference.name)}'",
                f"file not found: {printable(str(reference.path))}; {STAND_INS[reference.kind]}",
            )
    for collection in data_collections():
        for block in collection:
            if block.is_missing and not isinstance(block, bpy.types.Library):
                kind = block.bl_rna.name.lower()
                findings.add("missing", f"linked {kind} '{block.name_full}'", "not in its library; left out")
    for owner, tree in node_trees():
        if tree.bl_idname == "CompositorNodeTree":
            continue  # the pictures are taken before it
        for node in tree.nodes:
            if not computes(node):
                kind, why = _why_dropped(node)
                place = {"material": owner.name_full} if isinstance(owner, bpy.types.Material) else {}
                named = "" if place else f" of '{owner.name_full}'"
                findings.add(kind, f"node '{node.name}'{named}", why, **place)


def _why_dropped(node: Any) -> tuple[FindingKind, str]:
    """Kind of finding, and why the links of a node that does not compute are dropped."""
    dropped = "its links are dropped, as in Cycles"
    if node.bl_idname == UNDEFINED:
        return "missing", f"its type is unknown here (needs its add-on): {dropped}, which still sees a tree inside"
    if node.type in NOT_IN_CYCLES:
        return "ignored", f"{NOT_IN_CYCLES[node.type]}: {dropped}"
    return "missing", f"has no tree: {dropped}"


def external_files(path: Path) -> list[Path]:
    """Files beside ``path`` that the open scene was read from: images, libraries, .mtl and glTF buffers."""
    found = [reference.path for reference in references() if reference.present]
    if path.suffix.lower() == ".obj":
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        found += [path.parent / line.split(maxsplit=1)[1].strip() for line in lines if line.startswith("mtllib ")]
    elif path.suffix.lower() == ".gltf":
        buffers = json.loads(path.read_text(encoding="utf-8")).get("buffers", [])
        found += [path.parent / b["uri"] for b in buffers if "uri" in b and not b["uri"].startswith("data:")]
    return sorted({file.resolve() for file in found if file.is_file()})


def _images() -> Iterator[Reference]:
    for image in bpy.data.images:
        if image.packed_file or image.packed_files or image.source in SHAPELESS_IMAGES or not image.filepath:
            continue
        for path in image_files(image):
            yield Reference("image", image.name_full, path)


def image_files(image: Any) -> list[Path]:
    """The files of an image: one, or one per UDIM tile. Of a movie or sequence, the one it names."""
    path = bpy.path.abspath(image.filepath, library=image.library)
    if image.source != "TILED":
        return [Path(path)]
    numbers = [tile.number for tile in image.tiles] or [1001]
    files = []
    for number in numbers:
        u, v = (number - 1001) % 10, (number - 1001) // 10
        files.append(Path(path.replace("<UDIM>", str(number)).replace("<UVTILE>", f"u{u + 1}_v{v + 1}")))
    return files


def _others() -> Iterator[Reference]:
    for library in bpy.data.libraries:
        if not library.packed_file:
            yield Reference("linked library", library.name, Path(bpy.path.abspath(library.filepath)))
    for owner, tree in node_trees():
        for node in tree.nodes:
            if node.type == "TEX_IES" and node.mode == "EXTERNAL" and node.filepath:
                yield Reference("IES file", node.name, Path(bpy.path.abspath(node.filepath, library=owner.library)))
    used_fonts = [font for font in bpy.data.fonts if font.users]
    for kind, blocks in (("font", used_fonts), ("volume", bpy.data.volumes), ("cache", bpy.data.cache_files)):
        for block in blocks:
            if block.filepath not in ("", "<builtin>") and not getattr(block, "packed_file", None):
                path = Path(bpy.path.abspath(block.filepath, library=block.library))
                yield Reference(kind, block.name_full, path)


def is_file(path: Path, or_folder: bool = False) -> bool:
    """Whether the file is there. Names that the file system cannot hold are not."""
    try:
        return path.is_file() or (or_folder and path.exists())
    except (OSError, ValueError):
        return False
