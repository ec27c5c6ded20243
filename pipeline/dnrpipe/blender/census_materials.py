"""What one material's node tree implies for light transport. Only nodes that reach the active output count."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

from dnrpipe.core.scene_records import MaterialFacts

from .baking.trees import IMPLICIT_GENERATED
from .shading.sockets import find_input, output_node, resolve, surface_source, walk

PROCEDURAL = {*IMPLICIT_GENERATED, "TEX_MUSGRAVE", "TEX_WHITE_NOISE"}
"""Texture nodes without image."""
VIEW_DEPENDENT = {"FRESNEL", "LAYER_WEIGHT", "LIGHT_PATH", "CAMERA", "AMBIENT_OCCLUSION"}
VOLUME_NODES = {"VOLUME_ABSORPTION", "VOLUME_SCATTER", "PRINCIPLED_VOLUME", "VOLUME_COEFFICIENTS"}
REFRACTIVE = {"BSDF_GLASS", "BSDF_REFRACTION"}
TRANSMISSIVE = REFRACTIVE | {"BSDF_TRANSLUCENT"}
HAIR = {"BSDF_HAIR", "BSDF_HAIR_PRINCIPLED"}
GLOSSY = REFRACTIVE | HAIR | {"BSDF_GLOSSY", "BSDF_METALLIC", "EEVEE_SPECULAR"}
NOT_REFLECTING = {"EMISSION", "HOLDOUT", "BACKGROUND", "BSDF_TRANSPARENT", "MIX_SHADER", "ADD_SHADER", *VOLUME_NODES}
STRUCTURE = {"GROUP", "GROUP_INPUT", "REROUTE"}
GLASS, COAT = ("Transmission Weight", "Transmission"), ("Coat Weight", "Clearcoat")


def describe_material(material: Any, objects: list[str]) -> MaterialFacts:
    """The facts of one material. objects: some that show it."""
    tree = material.node_tree
    nodes = list(_reachable(tree))
    kinds = {node.type for node in nodes}
    principled = [node for node in nodes if node.type == "BSDF_PRINCIPLED"]
    glossy = [n for n in nodes if n.type in GLOSSY] + [n for n in principled if _specular(n)]
    refracting = [n for n in nodes if n.type in REFRACTIVE] + [n for n in principled if _active(n, *GLASS)]
    rough = [_roughness(node) for node in glossy]
    return MaterialFacts(
        bsdfs=sorted({node.bl_label for node in nodes if _is_shader(node)}),
        nodes=dict(sorted(Counter(node.bl_label for node in nodes).items())),
        procedural=sorted(node.bl_label for node in nodes if node.type in PROCEDURAL),
        reflects=tree is None or any(_is_shader(n) and n.type not in NOT_REFLECTING for n in nodes),
        glossy=bool(glossy),
        transparent="BSDF_TRANSPARENT" in kinds or any(_active(n, "Alpha", off=1.0) for n in principled),
        transmissive=bool(kinds & TRANSMISSIVE) or bool(refracting),
        refractive=bool(refracting),
        ior=max((_ior(n) for n in refracting), default=None),
        emissive=any(_emits(n) for n in nodes if n.type in {"EMISSION", "BSDF_PRINCIPLED"}),
        subsurface="SUBSURFACE_SCATTERING" in kinds
        or any(_active(n, "Subsurface Weight", "Subsurface") for n in principled),
        metallic=bool(kinds & {"BSDF_GLOSSY", "BSDF_METALLIC"}) or any(_active(n, "Metallic") for n in principled),
        normal_map="NORMAL_MAP" in kinds,
        bump="BUMP" in kinds,
        volume=bool(kinds & VOLUME_NODES) or surface_source(tree, "Volume") is not None,
        displacement=surface_source(tree, "Displacement") is not None,
        thin_film=any(_active(n, "Thin Film Thickness") for n in nodes),
        hair=bool(kinds & HAIR),
        view_dependent=sorted({node.bl_label for node in nodes if node.type in VIEW_DEPENDENT}),
        min_roughness=min((value for value in rough if value is not None), default=None),
        roughness_linked=any(value is None for value in rough),
        objects=objects,
    )


def _reachable(tree: Any) -> Iterator[Any]:
    """Nodes that the active output depends on, those inside groups included, each once.

    A group counts whole: which of its outputs is used is not followed.
    """
    output, inside = output_node(tree)
    todo, seen, groups = ([] if output is None else [*inside, output]), set(), set()
    while todo:
        node = todo.pop()
        if node.as_pointer() in seen:
            continue
        seen.add(node.as_pointer())
        yield node
        if node.type == "GROUP":
            yield from walk(node.node_tree, groups)
        todo += [link.from_node for socket in node.inputs for link in socket.links if not link.is_muted]


def _is_shader(node: Any) -> bool:
    return any(socket.type == "SHADER" for socket in node.outputs) and node.type not in STRUCTURE


def _active(node: Any, *names: str, off: float = 0.0) -> bool:
    """Whether a scalar input is linked or differs from the value that switches the feature off."""
    socket = find_input(node, *names)
    if socket is None:
        return False
    source = resolve(socket)
    return source.linked or abs(source.number - off) > 1e-6


def _specular(node: Any) -> bool:
    """Whether a Principled BSDF has a mirror-like lobe: base, metal, glass or coat."""
    features = (("Specular IOR Level", "Specular"), ("Metallic",), GLASS, COAT)
    return any(_active(node, *names) for names in features)


def _emits(node: Any) -> bool:
    strength = ("Strength",) if node.type == "EMISSION" else ("Emission Strength",)
    colour = find_input(node, *(("Color",) if node.type == "EMISSION" else ("Emission Color", "Emission")))
    if colour is None or (find_input(node, *strength) is not None and not _active(node, *strength)):
        return False
    source = resolve(colour)
    return source.linked or any(v > 0 for v in source.colour)


def _roughness(node: Any) -> float | None:
    """Roughness of a lobe, of its coat where that is smoother; None where it is linked."""
    values = []
    names: list[tuple[str, ...]] = [("Roughness",)]
    if _active(node, *COAT):
        names.append(("Coat Roughness", "Clearcoat Roughness"))
    for name in names:
        socket = find_input(node, *name)
        source = None if socket is None else resolve(socket)
        if source is not None and source.linked:
            return None
        values.append(0.0 if source is None else source.number)
    return min(values)


def _ior(node: Any) -> float:
    socket = find_input(node, "IOR")
    source = None if socket is None else resolve(socket)
    return 1.45 if source is None or source.linked else source.number
