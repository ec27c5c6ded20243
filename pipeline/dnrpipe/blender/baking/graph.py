"""The nodes that decide a socket's value: walks them, names them, and hashes what they compute."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..shading.sockets import Scope, Source, resolve

VIEW_DEPENDENT = {
    "FRESNEL": "a mean over directions",
    "LAYER_WEIGHT": "a mean over directions",
    "LIGHT_PATH": "one value for every ray",
    "CAMERA": "a fixed value",
    "PARTICLE_INFO": "a fixed value",
    "HAIR_INFO": "a fixed value",
    "POINT_INFO": "a fixed value",
}
"""Nodes whose output depends on the ray or on what the frozen mesh does not keep; and what a bake uses instead."""
FROM_CAMERA = {"Camera": "camera", "Window": "window", "Reflection": "reflection"}
"""Texture Coordinate outputs that a bake freezes as they are seen by the scene's camera."""
AROUND = {"AMBIENT_OCCLUSION", "BEVEL"}
"""Nodes that look at the geometry around the point."""
PER_OBJECT = {"OBJECT_INFO"}
NESTED = 4  # settings within settings of a node (a curve mapping's curves are 2 deep); some point in circles
SKIPPED = {property.identifier for property in bpy.types.Node.bl_rna.properties} | {"object"}


def upstream(source: Source) -> list[Source]:
    """The source and all that its value depends on, each (node, scope) once, in a fixed order."""
    found: dict[tuple[int, ...], Source] = {}
    queue = [source]
    while queue:
        current = queue.pop(0)
        key = _identity(current.node, current.scope)
        if key in found:
            continue
        found[key] = current
        for socket in current.node.inputs:
            if socket.is_linked:
                below = resolve(socket, current.scope)
                if below.linked:
                    queue.append(below)
    return list(found.values())


def labels(sources: list[Source]) -> str:
    """Readable list of the node types, for findings."""
    return ", ".join(dict.fromkeys(source.node.bl_label for source in sources))


class GraphHasher:
    """Hashes of what sockets compute. Images are hashed once."""

    def __init__(self) -> None:
        self._images: dict[str, str] = {}

    def hash(self, source: Source) -> str:
        """Hash of the value at ``source``: nodes, their settings, defaults, images and objects. Names do not count."""
        nodes = upstream(source)
        index = {_identity(entry.node, entry.scope): i for i, entry in enumerate(nodes)}
        digest = hashlib.sha256(source.socket.identifier.encode())
        for entry in nodes:
            digest.update(repr(list(self._node(entry.node))).encode())
            for socket in entry.node.inputs:
                below = resolve(socket, entry.scope)
                if below.linked:
                    place: tuple[Any, ...] = (index[_identity(below.node, below.scope)], below.socket.identifier)
                else:
                    place = (_plain(below.default),)
                digest.update(repr((socket.identifier, *place)).encode())
        return digest.hexdigest()

    def _node(self, node: Any) -> Iterator[Any]:
        yield node.bl_idname
        yield from self.properties(node, SKIPPED)
        if node.type in {"VALUE", "RGB", "NORMAL"}:
            yield _plain(node.outputs[0].default_value)
        reference = getattr(node, "object", None)
        if reference is not None:
            yield [_plain(row) for row in reference.matrix_world]
        camera = None if bpy.context.scene is None else bpy.context.scene.camera
        if camera is not None and any(output.is_linked and output.name in FROM_CAMERA for output in node.outputs):
            yield [_plain(row) for row in camera.matrix_world]

    def properties(self, holder: Any, skipped: set[str], depth: int = 0) -> Iterator[Any]:
        """(name, plain value) of each setting of a node, a lamp or whatever lies in one, but for ``skipped``."""
        for prop in holder.bl_rna.properties:
            name = prop.identifier
            if name in skipped or name == "rna_type":
                continue
            if prop.type in {"BOOLEAN", "INT", "FLOAT", "ENUM", "STRING"}:
                yield name, _plain(getattr(holder, name))
            elif prop.type == "POINTER":
                yield name, self._pointer(getattr(holder, name), depth)
            elif prop.type == "COLLECTION" and name in {"elements", "points", "curves"}:
                yield name, [list(self.properties(item, set(), depth + 1)) for item in getattr(holder, name)]

    def _pointer(self, value: Any, depth: int) -> Any:
        if value is None:
            return None
        if isinstance(value, bpy.types.Image):
            return self._image(value)
        if isinstance(value, bpy.types.NodeTree):
            return "tree"  # its nodes are walked
        if isinstance(value, bpy.types.ID):
            return value.name_full
        if isinstance(value, bpy.types.Node):
            return value.name  # of a zone's other end; nodes point at each other
        if depth >= NESTED:
            return None
        return list(self.properties(value, set(), depth + 1))

    def _image(self, image: Any) -> str:
        key = image.name_full
        if key not in self._images:
            digest = hashlib.sha256()
            settings = (image.colorspace_settings.name, image.alpha_mode, image.source, tuple(image.size))
            digest.update(repr(settings).encode())
            for part in _contents(image):
                digest.update(part)
            self._images[key] = digest.hexdigest()
        return self._images[key]


def _contents(image: Any) -> Iterator[bytes]:
    """The bytes of an image; none where it has no file and no pixels."""
    if image.is_dirty or image.source == "GENERATED":
        values = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(values)
        yield values.tobytes()
    elif image.packed_files:
        for packed in image.packed_files:
            if packed.packed_file is not None:
                yield packed.packed_file.data
    else:
        path = Path(bpy.path.abspath(image.filepath, library=image.library))
        pattern = path.name.replace("<UDIM>", "*").replace("<UVTILE>", "*")
        for file in sorted(path.parent.glob(pattern)) if "*" in pattern else [path]:
            if file.is_file():
                yield file.read_bytes()


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value)
    if isinstance(value, set | frozenset):
        return sorted(value)
    if isinstance(value, bpy.types.ID):
        return value.name_full
    if hasattr(value, "__len__"):
        return [_plain(item) for item in value]
    return str(type(value))


def _identity(node: Any, scope: Scope) -> tuple[int, ...]:
    return (*(entered.as_pointer() for entered in scope), node.as_pointer())
