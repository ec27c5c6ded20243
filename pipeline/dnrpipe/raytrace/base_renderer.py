"""Base images: what a view looks like by baked light and mirror-like paths alone, without noise and in milliseconds.

Notation
    E        light map (see `lightmap`), rho the diffuse reflectance of the point at hand
    S        what a rough lobe sees of other surfaces (see `lightmap`): its directions end at emitters
    path     follows the non-diffuse lobes: mirror reflection, refraction, glossy lobes, cut-outs (`specular_paths`)
    chain    a path from its second vertex on, to the first surface with a diffuse lobe
    sample   one of K rays through a pixel; the same K places in every pixel, so that nothing flickers

    base     = mean over samples of the sum over the path's vertices of throughput (emission + rho E), and of S where
               the path ends at a rough lobe
    diffuse  = the first vertex's share of it
    noise    = standard error of base's luminance by the spread of the pixel's samples; 0 with one sample

The numbers that choose directions come from Kronecker sequences (`sequence`). They are the same in every picture but in
frames that follow one another and remember (`history`): there frame f goes on where f - 1 ended.
Emitter sampling serves a path's first glossy vertex; multiple importance sampling joins it with hits of emitters.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .engine import masked_channels
from .lightmap import light_texture
from .recorded import Recorded, planes_of, prepare_emitters
from .sensors import Camera, opaque_camera, scaled_view
from .sequence import GOLDEN, ORDER, TILE, beginnings, fraction

FOURTH = 4
"""Of a pixel's samples, each fourth follows what the first surface shows faintly, in place of the others, where that is
wanted: with FAINT of `specular_paths`, 3 to 22 % of the time of a shot's frames."""
MAX_RAYS = 1 << 22
"""Of a launch: bounds its memory (about 1 GiB). Larger pictures are rendered in bands of rows."""
SHOWN = ("shown.R", "shown.G", "shown.B")
"""Reflectance of what a pixel shows that is neither mirror, smooth glass nor hole, as the module `auxiliary` has it;
premultiplied, for denoisers."""
FACING = ("facing.X", "facing.Y", "facing.Z")
"""Mean of the shading normals there."""
MEANS = (
    *("base.R", "base.G", "base.B", "base.A", "diffuse.R", "diffuse.G", "diffuse.B"),
    *("albedo.R", "albedo.G", "albedo.B", *SHOWN, *FACING),
)
CHAIN = ("chain.length", "chain.X", "chain.Y", "chain.Z")
"""How far the first ray's path goes behind the first surface by mirrors and clear glass, and where that ends."""
CENTRES = (
    *("chain.U", "chain.V", "chain.mask", "chain.weight", *CHAIN),
    *("normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "object.Id", "depth.Z", "mask"),
)
NOISE = "noise"
FRAMES = 64
"""Frames after which the sequences begin again: what is remembered is younger."""
BRIGHTEST = 1e15
"""Luminance above it counts as it where squares are summed."""
LOST = "lost"
"""Whether a part of the sample was not finite and is left out; of a pixel, the share of such samples."""
GBUFFER = ("normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "object.Id", "depth.Z")


def split(samples: int) -> tuple[list[int], list[int]]:
    """Numbers of a pixel's samples that follow faint paths (each FOURTH, from the first on), and of the others."""
    return list(range(0, samples, FOURTH)), [number for number in range(samples) if number % FOURTH]


class BaseRenderer:
    """Renders base images of one scene.

    Args:
        mi: the mitsuba module, a jit variant set.
        light: E and S of the front and of the back, float32 [2, 2, size, size, 3], row 0 at V = 0.
        gloss: see `SpecularPaths`.
        unit_scale: the scene's units per unit of the views (`sensors.unit_scale`).

    ``lets_through``: a surface lets light straight through, so that also the diffuse part of a pixel has grain.
    Of the last frame: ``repaired`` pixels had samples with parts that were not finite and are left out; ``masked``
    pixels were not finite all the same, and are 0.
    """

    def __init__(self, mi: Any, scene: Any, light: np.ndarray, *, gloss: bool = True, unit_scale: float = 1.0) -> None:
        from .specular_paths import SpecularPaths  # imports Mitsuba

        self.mi, self.scene, self.unit_scale = mi, scene, unit_scale
        self.repaired = self.masked = 0
        self.paths = SpecularPaths(scene, gloss=gloss)
        self.light = light_texture(mi, light, gloss=self.paths.ends_at_rough)
        self.tables = mi.UInt32(ORDER.ravel()), self.paths.steps
        self.lets_through = self.paths.lets_through
        prepare_emitters(mi, scene)
        # Recorded at the first call: tracing the plugins anew would take longer than the frame itself.
        self.kernel = Recorded(self._kernel, scene)

    def frame(
        self, view: Any, samples: int, number: int = 0, *, tiles: bool = True, thin: bool = False
    ) -> dict[str, np.ndarray]:
        """Channels of BASE_CHANNELS and of the G-buffer: float32 [H, W] each, linear Rec.709, premultiplied.

        view: in scene units, as are ``depth.Z`` and those of CHAIN. samples: K, rays per pixel. number: of the frame
        among those that remember; frames of other numbers cast other rays but for the first of each pixel.
        tiles: samples of neighbouring pixels complement one another, as those want who smooth them; not: as denoisers
        want (`sequence`). thin: few samples follow faint paths (FOURTH); not: all do.
        ``coverage`` is base.A, at most 1. Where cut-outs stand one behind the other, base.A can be above 1 as the
        colours are: each surface adds its opaque share.
        """
        import drjit as dr

        mi = self.mi
        camera = opaque_camera(mi, scaled_view(view, self.unit_scale))
        # As data: one kernel serves all parts and all numbers of rays.
        rays = dr.opaque(mi.UInt32, samples)
        few, others = split(samples) if thin else (list(range(samples)), [])
        weights = (few, samples / len(few)), (others, 0)
        parts = [
            (mi.UInt32(numbers), dr.opaque(mi.UInt32, len(numbers)), dr.opaque(mi.Float, weight))
            for numbers, weight in weights
            if numbers
        ]
        turn, tiled = dr.opaque(mi.UInt32, number % FRAMES), dr.opaque(mi.UInt32, int(tiles))
        names = (LOST, *MEANS, *CENTRES, NOISE)
        shape = (view.height, view.width)
        bands = -(-view.height // max(1, MAX_RAYS // (view.width * samples)))
        rows = -(-view.height // bands)
        channels = {name: np.empty(shape, np.float32) for name in names} if bands > 1 else {}
        for first in range(0, view.height, rows):
            # All bands have the same height, for which the kernel is recorded: the last one ends with the picture.
            first = min(first, view.height - rows)
            start = dr.opaque(mi.UInt32, first)
            size = view.width, rows, samples
            values = self.kernel(self.scene, self.light, self.tables, camera, rays, parts, turn, tiled, start, *size)
            dr.eval(values)
            band = dict(zip(names, planes_of(values, (rows, view.width)), strict=True))
            for name, plane in channels.items():
                plane[first : first + rows] = band[name]
            channels = channels or band
        self.repaired = int(np.count_nonzero(channels.pop(LOST)))
        channels, self.masked = masked_channels(channels)
        for name in (*GBUFFER, *CHAIN):
            channels[name] *= channels["mask"]
        for name in ("depth.Z", *CHAIN):
            channels[name] /= self.unit_scale
        rays = np.full(shape, samples, np.float32)
        return channels | {"coverage": np.minimum(channels["base.A"], 1), "rays": rays}

    def _kernel(
        self,
        scene: Any,
        light: Any,
        tables: Any,
        camera: Camera,
        rays: Any,
        parts: list[tuple[Any, Any, Any]],
        turn: Any,
        tiled: Any,
        start: Any,
        width: int,
        height: int,
        samples: int,
    ) -> list[Any]:
        """Values [height * width] of LOST, MEANS, CENTRES and NOISE.

        Recorded once, replayed for every view of that size and as many rays. Of either part, a pixel's samples lie side
        by side, so that packets of the second one have no faint paths to wait for. A pixel's first sample goes through
        its centre.

        Args:
            light: a `light_texture`.
            tables: places within a tile, steps of the random numbers.
            camera: see `opaque_camera`.
            rays: ``samples``, as data.
            parts: of `split`, or all: the samples' numbers, how many they are, what their faint paths weigh.
            turn: number of the frame.
            tiled: 1: in tiles, 0: scattered.
            start: the first row.
        """
        import drjit as dr

        mi, cut = self.mi, 3 + len(MEANS)
        _, _, across = camera
        firsts: list[Any] = []
        sums = [mi.Float(0)] * cut
        for numbers, many, faint in parts:
            count = dr.width(numbers)
            index = dr.arange(mi.UInt32, width * height * count)
            pixel, sample = index // many, dr.gather(mi.UInt32, numbers, index % many)
            place = pixel % across, start + pixel // across
            values = self._samples(scene, light, tables, camera, place, sample, rays, turn, tiled, faint)
            dr.eval(values)  # together: each sum alone would run it all again
            sums = [total + dr.block_sum(value, count) for total, value in zip(sums, values, strict=False)]
            if not firsts:
                first = dr.arange(mi.UInt32, width * height) * count
                firsts = [dr.gather(mi.Float, value, first) for value in values[cut:]]
        *means, bright, squares = [total / samples for total in sums]
        noise = dr.sqrt(dr.maximum(squares - bright * bright, 0) / max(samples - 1, 1))
        return [*means, *firsts, noise]

    def _samples(
        self,
        scene: Any,
        light: Any,
        tables: Any,
        camera: Camera,
        place: tuple[Any, Any],
        sample: Any,
        rays: Any,
        turn: Any,
        tiled: Any,
        faint: Any,
    ) -> list[Any]:
        """Values of samples: LOST, MEANS, luminance and its square, CENTRES.

        place: columns and rows. sample: their numbers within their pixels, of ``rays``. faint: see `SpecularPaths`.
        """
        import drjit as dr

        mi = self.mi
        axes, film, _ = camera
        x, y = place
        order = mi.Float(sample * (TILE * TILE)) + beginnings(mi, x, y, tables[0], tiled == 1)
        number = order + mi.Float(turn * rays * (TILE * TILE))
        order = fraction((order + 0.5) / mi.Float(rays * (TILE * TILE)) + mi.Float(turn) * GOLDEN[0])
        shift = dr.select(sample == 0, 0, mi.Float(sample + turn * (rays - 1)))
        right = mi.Float(x) + fraction(0.5 + shift * GOLDEN[0]) - film[2]
        down = mi.Float(y) + fraction(0.5 + shift * GOLDEN[1]) - film[3]
        direction = axes[0] * (right / film[0]) - axes[1] * (down / film[1]) - axes[2]
        ray = mi.Ray3f(mi.Point3f(axes[3]), dr.normalize(direction))
        values = self.paths.trace(scene, light, tables[1], ray, -axes[2], number, order, faint=faint)
        bright = dr.minimum(mi.luminance(mi.Color3f(*values[1:4])), BRIGHTEST)
        cut = 1 + len(MEANS)
        return [*values[:cut], bright, bright * bright, *values[cut:]]
