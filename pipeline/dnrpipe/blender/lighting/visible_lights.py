"""Which lamps of a scene renders see."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np


def visible_lights(scene: bpy.types.Scene) -> Iterator[tuple[Any, np.ndarray]]:
    """Lamp objects that renders see, instances included, with their world matrices (float64 [4, 4])."""
    layer = next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])
    hidden = _hidden_objects(layer.layer_collection)
    depsgraph = layer.depsgraph if layer.depsgraph is not None else bpy.context.evaluated_depsgraph_get()
    for obj in sorted(layer.objects, key=lambda o: o.name):
        if obj.type == "LIGHT" and not obj.hide_render and obj.name not in hidden:
            evaluated = obj.evaluated_get(depsgraph)
            yield evaluated, np.array(evaluated.matrix_world, dtype=np.float64)
    for instance in depsgraph.object_instances:
        if instance.is_instance and instance.object.type == "LIGHT" and instance.show_self:
            parent = instance.parent
            if parent is not None and (parent.hide_render or parent.name in hidden):
                continue
            yield instance.object, np.array(instance.matrix_world, dtype=np.float64)


def _hidden_objects(collection: bpy.types.LayerCollection, hidden: bool = False) -> set[str]:
    """Names of objects that only lie in excluded or render-hidden collections."""
    shown: set[str] = set()
    masked: set[str] = set()

    def visit(layer: bpy.types.LayerCollection, above: bool) -> None:
        off = above or layer.collection.hide_render
        target = masked if off or layer.exclude else shown
        target.update(obj.name for obj in layer.collection.objects)
        for child in layer.children:
            visit(child, off)

    visit(collection, hidden)
    return masked - shown
