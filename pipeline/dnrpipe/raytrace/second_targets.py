"""Two objects more of each kind that kernels call: a kernel never calls a class of which there is one object only.

Dr.Jit 1.5 calls the methods of a class's only object directly, and those of several through a table. It names a
function by its code's hash, but keeps a list for each of the two ways: a function that one kernel calls both ways, as
when an object is made between the two calls, is written twice, and LLVM ends the process ("invalid redefinition of
function 'func_...'"; `jitc_assemble_func` of drjit-core's ``eval.cpp``). With two objects more, all go through tables.
"""

from __future__ import annotations

from typing import Any


def second_targets(mi: Any) -> list[Any]:
    """Objects that no scene holds, to be kept as long as the variant records calls.

    Shapes (meshes, each with the BSDF and the texture that it makes itself), emitters, media (each with its phase
    function) and sensors, two of each: a scene may have none. Dr.Jit merges their functions, so that they cost a kernel
    some lines that no ray reaches (no time on the benchmark scene ``materials``).
    """
    film = {"type": "hdrfilm", "width": 1, "height": 1}
    kinds: list[dict[str, Any]] = [{"type": "point"}, {"type": "homogeneous"}, {"type": "perspective", "film": film}]
    loaded = [mi.load_dict(kind, parallel=False) for kind in (*kinds, *kinds)]
    return [*loaded, *(mi.Mesh("spare", 3, 1) for _ in range(2))]
