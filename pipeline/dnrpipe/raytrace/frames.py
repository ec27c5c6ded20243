"""Frames one after the other: path tracing at a few samples and auxiliary images, by kernels that are recorded once.

Python that describes a frame to Dr.Jit (our integrators and BSDFs) takes ten times longer than the kernel of a frame at
one sample per pixel. `recorded.Recorded` keeps the kernel. What differs between frames goes in as opaque numbers:
camera, seed, samples; a Mitsuba sensor per view would be recorded anew each time, so rays are made here. Each kind of
picture is recorded at its first one, which takes longer than the others.

Notation
    n     rays of a launch: H x W x samples, those of a pixel side by side
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dnrpipe.core.errors import UserError
from dnrtrain.contract import View

from .auxiliary import shown_first
from .engine import Engine
from .lobes import lets_through, mean_of
from .recorded import Recorded, prepare_emitters
from .sensors import Camera, opaque_camera, scaled_view
from .texels import ATTRIBUTE
from .visibility import first_visible_of, straight_on

MAX_RAYS = 1 << 24
"""Of a launch: bounds its memory (2 GiB). What needs more is the mean of several launches."""
OPEN = 1e-3
"""Alpha up to which nothing covers a pixel, and from 1 less which all of it is covered."""


@dataclass(frozen=True)
class Auxiliary:
    """Auxiliary images as `auxiliary` defines them; float32, means over primary rays.

    albedo    [H, W, 3] diffuse reflectance, behind mirrors and glass, too
    normal    [H, W, 3] world-space shading normal
    coverage  [H, W] share of the rays that meet a surface
    """

    albedo: np.ndarray
    normal: np.ndarray
    coverage: np.ndarray


class Frames:
    """Frames of one bundle, of one size. Views are pinhole cameras in scene units.

    Args:
        integrator, max_depth: as of `engine.Engine.integrator`.
        size: (width, height) in pixels of all views.

    Raises UserError under a scalar variant, which has no kernels to keep.
    """

    def __init__(self, engine: Engine, bundle: Path, integrator: str, max_depth: int, size: tuple[int, int]) -> None:
        if not engine.compiled:
            raise UserError("timing frames needs a jit variant of Mitsuba (LLVM or CUDA); see `dnrpipe doctor`")
        self.engine, self.mi, self.size = engine, engine.mi, size
        self.scene = engine.scenes[str(bundle)]
        prepare_emitters(self.mi, self.scene)
        self.integrator, self.name = engine.integrator(bundle, integrator, max_depth)
        self.lets_through = lets_through(self.mi, self.scene)
        self._kernels: dict[tuple[str, int], Any] = {}
        self._cover: dict[int, Any] = {}

    def path(self, view: View, spp: int, seed: int) -> np.ndarray:
        """Path-traced RGBA, linear Rec.709, premultiplied, box filter, float32 [H, W, 4]; NaN where Mitsuba gave it."""
        return self._mean(self._path_kernel, view, spp, seed)

    def auxiliary(self, view: View, rays: int, seed: int) -> Auxiliary:
        """Means over ``rays`` primary rays a pixel; a square number of them is stratified, one per cell."""
        image = self._mean(self._auxiliary_kernel, view, rays, seed)
        return Auxiliary(image[..., :3], image[..., 3:6], image[..., 6])

    def gbuffer(self, view: View, rays: int = 16) -> dict[str, np.ndarray]:
        """The view's G-buffer: channels of `dnrtrain.contract`, float32 [H, W].

        coverage: as of `coverage`. The rest is of the ray through the pixel's centre.
        """
        image = self._mean(self._centre_kernel, view, 1, 0)
        axis = view.matrix[:3, 2]
        position, mask = image[..., 6:9] / self.engine.unit_scale, image[..., 9] > 0
        names = (
            *("normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "object.Id"),
            *("position.X", "position.Y", "position.Z", "mask"),
        )
        result = {name: image[..., i] for i, name in enumerate(names)}
        for i, name in enumerate(names[6:9]):
            result[name] = np.where(mask, position[..., i], 0)
        depth = (view.position - position) @ axis
        result["depth.Z"] = np.where(mask, depth, 0).astype(np.float32)
        return result | {"coverage": self.coverage(view, mask, rays)}

    def coverage(self, view: View, mask: np.ndarray, rays: int = 16, alpha: np.ndarray | None = None) -> np.ndarray:
        """Share of the pixel that surfaces cover, float32 [H, W]: of ``rays`` (a square number) in a regular grid.

        mask: bool [H, W], whether the ray through the pixel's centre meets a surface. Only pixels that differ from a
        neighbour are looked at (a tenth, as a rule). alpha: of a base image, float32 [H, W]; where surfaces let light
        straight through, it takes the mask's place, and pixels that are partly covered by it are looked at, too; None:
        there all pixels are, at random.
        """
        if self.lets_through and alpha is None:
            return self._mean(self._cover_kernel, view, rays, 0)[..., 0]
        if rays not in self._cover:
            self._cover[rays] = self._edge_kernel(rays)
        kernel, looked_at = self._cover[rays], np.zeros(mask.shape, bool)
        if self.lets_through and alpha is not None:
            mask, looked_at = alpha > 0.5, (alpha > OPEN) & (alpha < 1 - OPEN)
        edges = np.flatnonzero(looked_at | _differs(mask))
        result = mask.astype(np.float32)
        if len(edges):
            import drjit as dr

            camera, most = self._inputs(view, 0, rays)[0], max(1, MAX_RAYS // rays)
            for part in np.split(edges, range(most, len(edges), most)):
                # Memory of Dr.Jit's own: where numpy's is aligned otherwise, the kernel would be recorded once more.
                lanes = self.mi.UInt32(part.astype(np.uint32).repeat(rays)) + dr.opaque(self.mi.UInt32, 0)
                places = self.mi.UInt32(np.tile(np.arange(rays, dtype=np.uint32), len(part))) + dr.opaque(
                    self.mi.UInt32, 0
                )
                dr.eval(lanes, places)
                (hits,) = kernel(camera, lanes, places)
                result.ravel()[part] = np.array(hits).reshape(-1, rays).mean(axis=1)
        return result

    def _edge_kernel(self, count: int) -> Any:
        import drjit as dr

        mi, scene, visible = self.mi, self.scene, first_visible_of(self.mi, self.scene)
        passes, transmittance = straight_on(mi, visible)
        holes, cells = self.lets_through, math.isqrt(count)
        if cells * cells != count:
            raise ValueError(f"rays: is {count}, expected a square number")

        @Recorded
        def kernel(camera: Any, pixel: Any, place: Any) -> list[Any]:
            offset = (mi.Point2f(place % cells, place // cells) + 0.5) / cells
            ray, hit = visible(scene, pinhole(mi, camera, pixel, offset), mi.Bool(True))
            covered = dr.select(hit.is_valid(), mi.Float(1), mi.Float(0))
            if holes:
                open_ = passes(hit, mi.Bool(True))
                covered = dr.select(open_, 1 - mean_of(transmittance(scene, ray, hit, open_)), covered)
            return [covered]

        return kernel

    def _centre_kernel(self, count: int, each: int) -> Any:
        import drjit as dr

        mi, scene, seen = self.mi, self.scene, seen_first(self.mi, self.scene)
        rays, prototype = self._rays, self.mi.load_dict({"type": "independent"})

        @Recorded
        def kernel(camera: Any, seed: Any, samples: Any, start: Any) -> list[Any]:
            sampler = prototype.fork()
            ray = rays(sampler, camera, seed, samples, each, 0, start)
            hit = seen(scene, ray, sampler)
            found = hit.is_valid()
            place = hit.shape.eval_attribute_3(ATTRIBUTE, hit, found & hit.shape.has_attribute(ATTRIBUTE, found))
            towards = dr.select(dr.dot(hit.sh_frame.n, ray.d) > 0, -hit.sh_frame.n, hit.sh_frame.n)
            normal = dr.select(found, towards, 0)
            values = [*normal, *place, *hit.p, dr.select(found, mi.Float(1), mi.Float(0))]
            values = [dr.select(found, value, 0) for value in values]
            dr.eval(values)
            return values

        return kernel

    def _cover_kernel(self, count: int, each: int) -> Any:
        import drjit as dr

        mi, scene, seen = self.mi, self.scene, seen_first(self.mi, self.scene)
        rays, means, prototype = self._rays, self._means, self.mi.load_dict({"type": "independent"})
        cells = math.isqrt(count) if math.isqrt(count) ** 2 == count else 1

        @Recorded
        def kernel(camera: Any, seed: Any, samples: Any, start: Any) -> list[Any]:
            sampler = prototype.fork()
            hit = seen(scene, rays(sampler, camera, seed, samples, each, cells, start), sampler)
            return means([dr.select(hit.is_valid(), mi.Float(1), mi.Float(0))], each)

        return kernel

    def _path_kernel(self, count: int, each: int) -> Any:
        import drjit as dr

        mi, scene, integrator = self.mi, self.scene, self.integrator
        rays, means, prototype = self._rays, self._means, mi.load_dict({"type": "independent"})

        def kernel(camera: Any, seed: Any, samples: Any, start: Any) -> list[Any]:
            sampler = prototype.fork()
            ray = rays(sampler, camera, seed, samples, each, 1, start)
            colour, valid, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray), None, mi.Bool(True))
            colour = mi.Color3f(colour)
            return means([colour.x, colour.y, colour.z, dr.select(valid, mi.Float(1), mi.Float(0))], each)

        return Recorded(kernel, scene)

    def _auxiliary_kernel(self, count: int, each: int) -> Any:
        import drjit as dr

        mi, scene = self.mi, self.scene
        rays, means, prototype = self._rays, self._means, mi.load_dict({"type": "independent"})
        shown, cells = shown_first(self.mi, self.scene), math.isqrt(count) if math.isqrt(count) ** 2 == count else 1

        @Recorded
        def kernel(camera: Any, seed: Any, samples: Any, start: Any) -> list[Any]:
            sampler = prototype.fork()
            ray = rays(sampler, camera, seed, samples, each, cells, start)
            albedo, normal, met = shown(scene, ray, sampler, mi.Bool(True))
            return means([*albedo, *normal, dr.select(met, mi.Float(1), mi.Float(0))], each)

        return kernel

    def _rays(self, sampler: Any, camera: Any, seed: Any, samples: Any, count: int, cells: int, start: Any) -> Any:
        """Rays through random points of the pixels, one in each of ``cells``² cells; 0 cells: through the centres.

        start: the cell of the first of ``count`` rays.
        """
        import drjit as dr

        mi, (width, height) = self.mi, self.size
        total = width * height * count
        sampler.seed(seed, total)
        index = dr.arange(mi.UInt32, total)
        pixel = index // samples
        offset = sampler.next_2d()
        if cells == 0:
            offset = mi.Point2f(0.5, 0.5)
        elif cells > 1:
            cell = index - pixel * samples + start
            offset = (mi.Point2f(cell % cells, cell // cells) + offset) / cells
        return pinhole(self.mi, camera, pixel, offset)

    @staticmethod
    def _means(values: list[Any], count: int) -> list[Any]:
        """Means over the rays of each pixel. Evaluated together first: each sum alone would trace all again."""
        import drjit as dr

        dr.eval(values)
        return [dr.block_sum(value, count) / count for value in values]

    def _inputs(self, view: View, seed: int, samples: int) -> tuple[Any, Any, Any]:
        """Camera, seed and samples as opaque numbers."""
        import drjit as dr

        if (view.width, view.height) != self.size:
            raise ValueError(f"view {view.name}: is {view.width}x{view.height}, the kernels are for {self.size}")
        mi = self.mi
        camera = opaque_camera(mi, scaled_view(view, self.engine.unit_scale))
        return camera, dr.opaque(mi.UInt32, seed), dr.opaque(mi.UInt32, samples)

    def _mean(self, make: Callable[[int, int], Any], view: View, rays: int, seed: int) -> np.ndarray:
        """What the kernel of ``make(rays, rays of a launch)`` gives, float32 [H, W, C]: the mean of its launches.

        The kernel is made once. Of several launches each has a seed of its own.
        """
        import drjit as dr

        launches = next(n for n in range(1, rays + 1) if rays % n == 0 and (n == rays or self._fits(rays // n)))
        each, key = rays // launches, (make.__name__, rays)
        if key not in self._kernels:
            self._kernels[key] = make(rays, each)
        total: Any = 0
        for launch in range(launches):
            start = dr.opaque(self.mi.UInt32, launch * each)
            inputs = self._inputs(view, seed * launches + launch, each)
            total = total + self._image(self._kernels[key](*inputs, start)) / np.float32(launches)
        return total

    def _fits(self, rays: int) -> bool:
        """Whether so many rays a pixel are no more than MAX_RAYS."""
        return rays * self.size[0] * self.size[1] <= MAX_RAYS

    def _image(self, values: list[Any]) -> np.ndarray:
        width, height = self.size
        return np.stack([np.array(value) for value in values], axis=-1).reshape(height, width, -1)


def _differs(mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: pixels that have an unlike pixel among their eight neighbours."""
    padded = np.pad(mask, 1, mode="edge")
    height, width = mask.shape
    shifted = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]
    return np.any(shifted, axis=0) & ~np.all(shifted, axis=0)


def pinhole(mi: Any, camera: Camera, pixel: Any, offset: Any) -> Any:
    """Rays through places (0..1, 0..1) of pixels, numbered row by row. camera: see `sensors.opaque_camera`."""
    import drjit as dr

    (right, up, back, origin), (fl_x, fl_y, cx, cy), width = camera
    x = (mi.Float(pixel % width) + offset.x - cx) / fl_x
    y = (mi.Float(pixel // width) + offset.y - cy) / fl_y
    return mi.Ray3f(mi.Point3f(origin), dr.normalize(right * x - up * y - back))


def seen_first(mi: Any, scene: Any) -> Any:
    """Function (scene, ray, sampler) -> what the pixel shows there first.

    Lamps are passed, and what surfaces let straight through is passed with its probability.
    """
    import drjit as dr

    visible, transparent = first_visible_of(mi, scene), lets_through(mi, scene)

    def seen(scene: Any, ray: Any, sampler: Any) -> Any:
        ray, hit = visible(scene, ray, mi.Bool(True))
        if not transparent:
            return hit

        def passes(hit: Any, sampler: Any, active: Any) -> Any:
            bsdf = hit.bsdf()
            null = active & hit.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            share = mean_of(bsdf.eval_null_transmission(hit, null))
            return null & (sampler.next_1d(active) < share)

        def onwards(hit: Any, direction: Any, sampler: Any, active: Any) -> tuple[Any, ...]:
            _, next_hit = visible(scene, hit.spawn_ray(direction), active)
            hit = dr.select(active, next_hit, hit)
            return hit, direction, sampler, passes(hit, sampler, active)

        state = (hit, mi.Vector3f(ray.d), sampler, passes(hit, sampler, mi.Bool(True)))
        return dr.while_loop(state, lambda hit, direction, sampler, active: active, onwards)[0]

    return seen
