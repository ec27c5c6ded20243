"""The average of a node's output, as well as it is known: it stands for nodes that are neither images nor baked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .sockets import Scope, Source, find_input
from .textures import Constant, Value, constant


def procedural_mean(source: Source, evaluate: Callable[..., Value]) -> Constant:
    """Average of a node's output over space; ``evaluate(socket, scope)`` gives its inputs."""
    node = source.node
    scope: Scope = source.scope
    if node.type in {"TEX_CHECKER", "TEX_BRICK"} and source.socket.name == "Color":
        pair = [find_input(node, "Color1"), find_input(node, "Color2")]
        means = [evaluate(socket, scope).mean for socket in pair if socket is not None]
        return constant(np.mean(means, axis=0))
    if node.type == "BLACKBODY" or node.type == "WAVELENGTH":
        return constant(1.0)
    if source.socket.type in {"RGBA", "VECTOR", "VALUE"} and node.type.startswith("TEX_"):
        return constant(0.5)
    own = next((s for s in node.inputs if s.type in {"RGBA", "VALUE"} and s.enabled), None)
    return constant(0.5) if own is None else constant(evaluate(own, scope).mean)
