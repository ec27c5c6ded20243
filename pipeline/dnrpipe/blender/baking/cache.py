"""The cache of baked socket values: what is asked for, what is on disk, and what has still to be baked.

A conversion walks all materials and asks the cache for every value that it cannot compute itself. Where the value
is in the folder (files named by content hash), the cache returns it as a texture over the material's region of the
scene atlas. Where it is not, the cache returns a placeholder and lists the value in ``missing``. Then the conversion
does not count: `bake` bakes what is missing, and the scene is converted again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..findings import Findings
from ..geometry.frozen import ATLAS_LAYER, FrozenMesh
from ..reading.missing import is_file
from ..shading.sockets import Source
from ..shading.textures import Placement, Textured
from ..tasks import MaterialTaps, Tap, ValueKind
from .earlier import Earlier
from .graph import AROUND, FROM_CAMERA, PER_OBJECT, VIEW_DEPENDENT, GraphHasher, labels, upstream
from .mesh import MAX_OWN, is_object_space, object_info
from .regions import Atlas

BAKE_VERSION = 5  # raise when a bake of the same inputs would come out different
SCALARS_PER_BAKE = 3
ANIMATED_IMAGES = {"SEQUENCE", "MOVIE"}


@dataclass
class BakeCache:
    """Baked values of one conversion.

    folder: the cache. refused: keys that could not be baked; they are approximated instead. missing: (material, value)
    by key, to be baked. used: keys that were asked for. used_atlas: whether other values were resampled into the atlas.
    materials: that asked for either. earlier: the conversion of another frame, whose bakes are taken where they hold.
    """

    atlas: Atlas
    folder: Path
    refused: frozenset[str] = frozenset()
    missing: dict[str, tuple[str, Tap]] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    used_atlas: bool = False
    materials: set[str] = field(default_factory=set)
    earlier: Earlier | None = None
    _graphs: GraphHasher = field(default_factory=GraphHasher)
    _meshes: dict[int, str] = field(default_factory=dict)

    def value(self, material: str, kind: ValueKind, source: Source, socket: str, findings: Findings) -> Textured | None:
        """The value at ``source`` over the material's surface; None when it could not be baked.

        Colours and normals (n * 0.5 + 0.5, world space) have three channels, scalars one. socket: the name of the
        shader input it feeds, for the finding.
        """
        self.materials.add(material)
        region = self.atlas.region(material)
        if not len(region.texels):
            return None
        nodes = upstream(source)
        earlier = self.earlier
        key = self._key(
            material, kind, source, nodes, lambda mesh: earlier.stand_in(mesh, kind, nodes) if earlier else mesh
        )
        if key in self.refused:
            return None
        self.used.add(key)
        names = labels(nodes)
        channels = 1 if kind == "scalar" else 3
        placement = Placement(uv=ATLAS_LAYER, wrap="clamp", region=material)
        note = f"baked into a texture of {self.atlas.size}² texels over the whole scene: {names}"
        findings.add("baked", f"'{socket}'", note, material=material)
        self._warn(material, kind, nodes, findings)
        values = self._read(key, material, channels)
        if values is None and kind == "normal":
            values = self._turned(material, source, nodes)
        if values is not None:
            return Textured(values[:, None, :], False, placement)
        groups = tuple(group.name for group in source.scope)
        tap = Tap(kind=kind, groups=groups, node=source.node.name, socket=source.socket.identifier, key=key)
        self.missing[key] = material, tap
        return Textured(np.full((1, 1, channels), 0.5, np.float32), False, placement)

    def _read(self, key: str, material: str, channels: int) -> np.ndarray | None:
        """What was baked, float32 [N, channels]; None where it was not, or is damaged: then it is baked again."""
        try:
            values = np.load(self.folder / f"{key}.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None
        wanted = len(self.atlas.region(material).texels), channels
        return values.astype(np.float32) if values.shape == wanted else None

    def _turned(self, material: str, source: Source, nodes: list[Source]) -> np.ndarray | None:
        """Normals n * 0.5 + 0.5, float32 [N, 3], of the earlier frame, turned as their meshes have; None elsewhere."""
        parts = self.atlas.parts(material)
        if self.earlier is None:
            return None
        turns = self.earlier.turns([part.mesh for part in parts], source, nodes)
        if turns is None:
            return None
        values = self._read(self._key(material, "normal", source, nodes, self.earlier.before), material, 3)
        if values is None:
            return None
        ends = np.cumsum([len(part.triangles) for part in parts])
        own = turns[np.searchsorted(ends, self.atlas.region(material).triangle, side="right")]
        return (np.einsum("nij,nj->ni", own, 2 * values - 1) * 0.5 + 0.5).astype(np.float32)

    def layers(self) -> list[list[MaterialTaps]]:
        """What is missing, one bake a layer: it holds at most one emission per material."""
        stacks: dict[str, list[list[Tap]]] = {}
        for material, tap in self.missing.values():
            stack = stacks.setdefault(material, [])
            last = next((taps for taps in stack if taps[0].kind == "scalar" and len(taps) < SCALARS_PER_BAKE), None)
            if tap.kind == "scalar" and last is not None:
                last.append(tap)
            else:
                stack.append([tap])
        found: list[list[MaterialTaps]] = []
        for material, stack in stacks.items():
            found += [[] for _ in range(len(stack) - len(found))]
            for level, taps in zip(found, stack, strict=False):
                level.append(MaterialTaps(material=material, taps=tuple(taps)))
        return found

    def image(self, value: Textured) -> Textured:
        """A region's texture as a full image over the atlas, margins included."""
        assert value.placement.region is not None
        full = self.atlas.image({value.placement.region: value.linear()})
        return Textured(full, False, Placement(uv=ATLAS_LAYER, wrap="clamp"))

    def prune(self) -> None:
        """Remove cached bakes that this conversion did not use."""
        for path in self.folder.glob("*.npy"):
            if path.stem not in self.used:
                path.unlink(missing_ok=True)

    def _warn(self, material: str, kind: ValueKind, nodes: list[Source], findings: Findings) -> None:
        for node in (entry.node for entry in nodes):
            if node.type in VIEW_DEPENDENT:
                note = f"depends on the ray, which a bake has not: {VIEW_DEPENDENT[node.type]} is used"
                findings.add("approximated", f"{node.bl_label} node", note, material=material)
        for node in (entry.node for entry in nodes):
            if getattr(node, "image", None) is not None:
                _warn_of_image(node, material, findings)
            in_use = {output.name for output in node.outputs if output.is_linked}
            if node.type == "TEX_COORD":
                for name in sorted(in_use & set(FROM_CAMERA)):
                    note = "depends on the camera: baked once, as the scene's own camera sees it"
                    findings.add("approximated", f"{FROM_CAMERA[name]} coordinates", note, material=material)
            if node.type == "NEW_GEOMETRY" and "Random Per Island" in in_use:
                note = "every island has a number of its own, but not the same one as in Blender"
                findings.add("approximated", "Random Per Island", note, material=material)
            if node.type == "ATTRIBUTE" and node.attribute_type != "GEOMETRY":
                name = f"attribute '{node.attribute_name}' of the {node.attribute_type.lower()}"
                findings.add("ignored", name, "only attributes of the mesh are kept: 0 is used", material=material)
        if len(self.atlas.parts(material)) > MAX_OWN and any(is_object_space(entry.node) for entry in nodes):
            note = f"on more than {MAX_OWN} objects: baked as if their axes were the world's"
            findings.add("approximated", "object-space nodes", note, material=material)
        copied = [part.mesh.object_name for part in self.atlas.parts(material) if len(part.mesh.copies)]
        if copied and kind == "normal":
            note = "baked in the first instance's orientation; the others' bumps are lit as if turned like it"
            findings.add("approximated", "bump on instances", note, object=copied[0], material=material)

    def _key(
        self,
        material: str,
        kind: ValueKind,
        source: Source,
        nodes: list[Source],
        standing: Callable[[FrozenMesh], FrozenMesh],
    ) -> str:
        """Hash of all that decides a bake. standing: mesh -> the one that it is baked on."""
        for user in (entry.node.image_user for entry in nodes if shows_frames(entry.node)):
            user.frame_current = frame_shown(
                user, bpy.context.scene.frame_current
            )  # Blender counts only while it draws
        digest = hashlib.sha256(repr((BAKE_VERSION, self.atlas.size, kind)).encode())
        digest.update(self._graphs.hash(source).encode())
        types = {entry.node.type for entry in nodes}
        parts = self.atlas.parts(material)
        for part in parts:
            digest.update(self._mesh(standing(part.mesh)).encode())
            digest.update(part.triangles.tobytes())
            if types & PER_OBJECT:
                digest.update(repr(object_info(part.mesh)).encode())
        if types & AROUND:
            for mesh in self.atlas.meshes:
                digest.update(self._mesh(mesh).encode())
        return digest.hexdigest()[:32]

    def _mesh(self, mesh: FrozenMesh) -> str:
        if id(mesh) not in self._meshes:
            digest = hashlib.sha256(repr((mesh.active_uv, mesh.active_color, mesh.texture_space)).encode())
            digest.update(mesh.object_to_world.tobytes())
            for array in (mesh.positions, mesh.normals, mesh.atlas):
                digest.update(np.ascontiguousarray(array).data)
            for name, array in (*mesh.uv_layers.items(), *mesh.colors.items()):
                if not name.startswith("dnrpipe."):  # else made by the conversion itself
                    digest.update(name.encode())
                    digest.update(np.ascontiguousarray(array).data)
            self._meshes[id(mesh)] = digest.hexdigest()
        return self._meshes[id(mesh)]


def _warn_of_image(node: Any, material: str, findings: Findings) -> None:
    """What Cycles bakes in magenta, and which frame of an animated image it bakes."""
    image = node.image
    name = f"image '{image.name}'"
    if image.source in ANIMATED_IMAGES:
        findings.add("approximated", f"animated {name}", "one frame is used", material=material)
    path = Path(bpy.path.abspath(image.filepath_from_user(image_user=node.image_user), library=image.library))
    lost = image.source == "SEQUENCE" and not image.packed_files and not is_file(path)
    # Scripts read no pixels of a sequence.
    if lost or (image.source not in {"TILED", "SEQUENCE"} and not _is_readable(image)):
        note = f"cannot read '{path if lost else image.filepath or image.name}'; magenta stands for it"
        findings.add("missing", name, note, material=material)


def shows_frames(node: Any) -> bool:
    """Whether a node shows an image that changes with the frame."""
    return getattr(getattr(node, "image", None), "source", None) in ANIMATED_IMAGES


def frame_shown(user: Any, now: int) -> int:
    """Number in the file name of a sequence's image at a frame of the scene (Blender's BKE_image_user_frame_get)."""
    count, frame = max(user.frame_duration, 1), now - user.frame_start
    return user.frame_offset + 1 + (frame % count if user.use_cyclic else min(max(frame, 0), count - 1))


def _is_readable(image: Any) -> bool:
    if image.has_data:
        return True
    readable = len(image.pixels) > 0  # reads the file
    image.buffers_free()
    return readable
