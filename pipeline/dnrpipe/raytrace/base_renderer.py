"""Base images: what a view looks like by baked light and mirror-like paths alone, without noise and in milliseconds.

Notation
    E        light map (see :mod:`.lightmap`), rho the diffuse reflectance of the point at hand
    S        what a rough lobe sees of other surfaces (ibid.): its directions end at emitters
    chain    the path that follows the non-diffuse lobes: mirror reflection, refraction, glossy lobes, cut-outs
    sample   one of S rays through a pixel; the same S places in every pixel, so that nothing flickers

    base     = mean over samples of the sum over the chain's vertices of throughput (emission + rho E), and of S where
               the chain ends at a rough lobe
    diffuse  = the first vertex's share of it

A glossy lobe is sampled by numbers of a fixed low-discrepancy sequence, which repeats over tiles of TILE² pixels. Where
light sources can be hit, emitter sampling serves the first glossy vertex, and multiple importance sampling joins both.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .finite import masked_channels
from .frames_rays import lets_through
from .lobes import (
    bsdfs_of,
    diffuse_context,
    ignores_context,
    is_among,
    is_rough,
    mirrors_and_refracts,
    other_context,
    reflectance,
)
from .paths import power_heuristic
from .recorded import Recorded, prepare_emitters
from .sequence import GOLDEN, ORDER, TILE, fraction, steps
from .texels import ATTRIBUTE
from .visibility import LAMP_PREFIX, UNSEEN_PREFIX, is_one_of

MAX_VERTICES = 8
NUMBERS = 5
"""Random numbers per vertex: two for the direction, one for the lobe, two for the emitter."""
MAX_RAYS = 1 << 24
"""Of a launch: bounds its memory (about 4 GiB). Larger pictures are rendered in bands of rows."""
MIRRORED = 0.25
"""Share of the samples that the first glass reflects. By Fresnel's share, a lamp in the water would be a few specks."""
LEAST_THROUGHPUT = 1e-3
MEANS = (
    *("base.R", "base.G", "base.B", "base.A", "diffuse.R", "diffuse.G", "diffuse.B"),
    *("albedo.R", "albedo.G", "albedo.B"),
)
CENTRES = (
    *("chain.U", "chain.V", "chain.mask", "chain.weight"),
    *("normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "depth.Z", "mask"),
)
LOST = "lost"
"""Whether a part of the sample was not finite and is left out; of a pixel, the share of such samples."""
GBUFFER = ("normal.X", "normal.Y", "normal.Z", "uv.U", "uv.V", "depth.Z")


class BaseRenderer:
    """Renders base images of one scene.

    Args:
        light: E and S of the front and of the back, float32 [2, 2, size, size, 3], row 0 at V = 0.
        samples: S, rays per pixel.

    Of the last frame: ``repaired`` pixels had samples that were not finite, of which that part was left out; ``masked``
    pixels were not finite all the same, and are 0.
    """

    def __init__(self, mi: Any, scene: Any, light: np.ndarray, samples: int) -> None:
        import drjit as dr

        self.mi, self.scene, self.samples = mi, scene, samples
        self.repaired = self.masked = 0
        sides = [np.concatenate([light[0, i], light[1, i]], axis=-1) for i in range(2)]
        self.light = [mi.Texture2f(mi.TensorXf(side), wrap_mode=dr.WrapMode.Clamp) for side in sides]
        shapes = scene.shapes()
        self.apart = [shape for shape in shapes if shape.id().startswith((LAMP_PREFIX, UNSEEN_PREFIX))]
        self.lit = bool(scene.emitters())
        self.media = any(shape.is_medium_transition() for shape in shapes)
        bsdfs = bsdfs_of(scene)
        self.whole = [b for b in bsdfs if ignores_context(b)]
        self.cut = any(mi.has_flag(b.flags(), mi.BSDFFlags.Null) for b in self.whole)
        self.holes = lets_through(mi, scene)
        self.translucent = bool(self.whole) or any(
            mi.has_flag(b.flags(), mi.BSDFFlags.DiffuseTransmission) for b in bsdfs
        )
        self.rough = any(mi.has_flag(b.flags(), mi.BSDFFlags.GlossyReflection) for b in bsdfs)
        self.glassy = any(mirrors_and_refracts(mi, b.flags()) for b in bsdfs)
        numbers = steps(NUMBERS * (MAX_VERTICES + 1))
        self.tables = mi.UInt32(ORDER.ravel()), mi.Float(numbers)
        prepare_emitters(mi, scene)
        # Recorded at the first call: tracing the plugins anew would take longer than the frame itself.
        self.kernel = Recorded(self._kernel)

    def frame(self, view: Any) -> dict[str, np.ndarray]:
        """Channels of BASE_CHANNELS and of the G-buffer, float32 [H, W], for a view in the bundle's units.

        ``coverage`` is base.A, at most 1, and ``depth.Z`` in the bundle's units, too. Where cut-outs stand one behind
        the other base.A can be above 1 as the colours are: of each surface met its opaque share is counted.
        """
        import drjit as dr

        mi, m = self.mi, view.matrix
        axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in m[:3, i])) for i in range(4)]
        film = [dr.opaque(mi.Float, float(v)) for v in (view.fl_x, view.fl_y, view.cx, view.cy)]
        names = (LOST, *MEANS, *CENTRES)
        rows = max(1, min(view.height, MAX_RAYS // (view.width * self.samples)))
        bands: list[list[np.ndarray]] = []
        for first in range(0, view.height, rows):
            start, count = dr.opaque(mi.UInt32, first), min(rows, view.height - first)
            values = self.kernel(self.scene, self.light, self.tables, axes, film, start, view.width, count)
            dr.eval(values)
            bands.append([np.array(value) for value in values])
        shape = (view.height, view.width)
        channels = {
            name: (parts[0] if len(parts) == 1 else np.concatenate(parts)).reshape(shape)
            for name, parts in zip(names, zip(*bands, strict=True), strict=True)
        }
        self.repaired = int(np.count_nonzero(channels.pop(LOST)))
        channels, self.masked = masked_channels(channels)
        for name in GBUFFER:
            channels[name] = channels[name] * channels["mask"]
        return channels | {"coverage": np.minimum(channels["base.A"], 1)}

    def _kernel(
        self, scene: Any, light: Any, tables: Any, axes: Any, film: Any, start: Any, width: int, height: int
    ) -> list[Any]:
        """``height`` rows from row ``start`` on. All that varies comes in as data: recorded once, replayed for every
        view of that size.

        A pixel's samples lie side by side; the first goes through the pixel's centre.
        """
        import drjit as dr

        mi, samples = self.mi, self.samples
        index = dr.arange(mi.UInt32, width * height * samples)
        pixel, sample = index // samples, index % samples
        x, y = pixel % width, start + pixel // width
        tile = dr.gather(mi.UInt32, tables[0], (y % TILE) * TILE + x % TILE)
        number, place = mi.Float(sample * (TILE * TILE) + tile), mi.Float(sample)
        right = mi.Float(x) + fraction(0.5 + place * GOLDEN[0]) - film[2]
        down = mi.Float(y) + fraction(0.5 + place * GOLDEN[1]) - film[3]
        direction = axes[0] * (right / film[0]) - axes[1] * (down / film[1]) - axes[2]
        ray = mi.Ray3f(mi.Point3f(axes[3]), dr.normalize(direction))
        values = self._follow(scene, light, tables[1], ray, -axes[2], number)
        if samples == 1:
            return values
        dr.eval(values)  # together: each sum alone would run it all again
        means = [dr.block_sum(value, samples) / samples for value in values[: 1 + len(MEANS)]]
        first = dr.arange(mi.UInt32, width * height) * samples
        return [*means, *(dr.gather(mi.Float, value, first) for value in values[1 + len(MEANS) :])]

    def _baked(self, light: Any, si: Any, active: Any) -> tuple[Any, Any, Any]:
        """(E, S, atlas coordinates) at the surface point, on the side that is seen."""
        import drjit as dr

        mi = self.mi
        place = si.shape.eval_attribute_3(ATTRIBUTE, si, active & si.shape.has_attribute(ATTRIBUTE, active))
        front = dr.dot(si.n, si.to_world(si.wi)) >= 0
        uv = mi.Point2f(place.x, place.y)
        found = [dr.select(front, *pair) for pair in zip(*(texture.eval(uv, active) for texture in light), strict=True)]
        return mi.Spectrum(*found[:3]), mi.Spectrum(*found[3:]), uv

    def _opacity(self, bsdf: Any, si: Any, active: Any) -> Any:
        """Share of a surface's light that does not pass straight on; what the surface adds has the same weight."""
        import drjit as dr

        if not self.holes:
            return dr.select(active, self.mi.Float(1), 0)
        return dr.select(active, 1 - dr.mean(bsdf.eval_null_transmission(si, active)), 0)

    def _passed(self, medium: Any, ray: Any, si: Any, active: Any) -> Any:
        """What ``medium`` lets through of the light along the ray's segment; what it scatters counts as passed."""
        import drjit as dr

        mi = self.mi
        inside = active & si.is_valid() & (medium != dr.zeros(mi.MediumPtr))
        middle = dr.zeros(mi.MediumInteraction3f)
        middle.p = ray(0.5 * si.t)
        scattered, _, lost = medium.get_scattering_coefficients(middle, inside)
        return dr.select(inside, dr.exp((scattered - lost) * si.t), 1)

    def _follow(self, scene: Any, light: Any, table: Any, ray: Any, forward: Any, number: Any) -> list[Any]:
        """One sample along each ray: the values named by LOST, MEANS and CENTRES.

        forward: where the camera looks. number: the sample's place in the sequence.
        """
        import drjit as dr

        mi = self.mi
        origin = mi.Point3f(ray.o)
        smooth = diffuse_context(mi)
        rest = mi.BSDFContext()
        rest.type_mask = int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Diffuse)
        straight_on = mi.BSDFContext()
        straight_on.type_mask = mi.BSDFFlags.Null
        glossy_or_sharp = other_context(mi)
        glossy = mi.BSDFContext()
        glossy.type_mask = mi.BSDFFlags.Glossy

        sides = [mi.BSDFContext(), mi.BSDFContext()]
        sides[0].type_mask = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.GlossyReflection)
        sides[1].type_mask = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)

        def uniform(vertex: Any, dimension: int) -> Any:
            step = dr.gather(mi.Float, table, vertex * NUMBERS + dimension)
            return fraction(0.5 + number * step)

        def step(s: dict[str, Any]) -> dict[str, Any]:
            active, straight = s["active"], s["straight"]
            si = scene.ray_intersect(s["ray"], mi.RayFlags.All, True, active)
            passed = active & straight & is_one_of(mi, si, self.apart) if self.apart else mi.Mask(False)
            going = active & ~passed
            last = s["last"]
            if self.media:
                s["throughput"] *= self._passed(s["medium"], s["ray"], si, going)
            # Light that is hit
            source = mi.DirectionSample3f(scene, si, s["before"])
            seen = going & (si.is_valid() | ~straight)
            chance = scene.pdf_emitter_direction(s["before"], source, seen & s["sampled"])
            weight = dr.select(s["sampled"], power_heuristic(s["density"], chance), 1)
            emitted = dr.select(seen, s["throughput"] * weight * source.emitter.eval(si, seen), 0)
            # Baked light
            met = going & ~last & si.is_valid()
            bsdf = si.bsdf()
            rho = dr.select(met, reflectance(mi, bsdf, smooth, si, met, self.translucent), 0)
            baked, around, uv = self._baked(light, si, met)
            here = emitted + dr.select(met, s["throughput"] * rho * baked, 0)
            primary = straight
            total, lost = s["total"] + here, s["lost"]
            diffuse = s["diffuse"] + dr.select(primary, here, 0)
            albedo = s["albedo"] + dr.select(primary & met, s["throughput"] * rho, 0)
            turned = dr.select(si.wi.z < 0, -si.sh_frame.n, si.sh_frame.n)
            front = primary & met
            normal = dr.select(front, mi.Vector3f(turned), s["normal"])
            place = dr.select(front, uv, s["uv"])
            depth = dr.select(front, dr.dot(si.p - origin, forward), s["depth"])
            ends = met & ~straight & ~s["ended"] & (dr.mean(rho) > 0.05)
            chain_uv = dr.select(ends, uv, s["chain_uv"])
            chain_weight = dr.select(ends, dr.mean(s["throughput"]), s["chain_weight"])
            # Emitters, once, through glossy lobes: measured, further vertices cost more than they bring
            onwards = met & ~is_among(mi, bsdf, self.whole)
            wide = is_rough(mi, bsdf, glossy_or_sharp, si, onwards) if self.rough else mi.Mask(False)
            rough = onwards & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) & (~s["lit"] | wide)
            if self.lit:
                pair = mi.Point2f(uniform(s["vertex"], 3), uniform(s["vertex"], 4))
                toward, arriving = scene.sample_emitter_direction(si, pair, True, rough)
                value, other = bsdf.eval_pdf(glossy, si, si.to_local(toward.d), rough & (toward.pdf > 0))
                share = dr.select(toward.delta, 1, power_heuristic(toward.pdf, other))
                direct = dr.select(rough & (toward.pdf > 0), s["throughput"] * value * arriving * share, 0)
                fine = dr.all(dr.isfinite(direct))
                total, lost = total + dr.select(fine, direct, 0), lost | ~fine
            # The mirror-like rest
            pair = mi.Point2f(uniform(s["vertex"], 0), uniform(s["vertex"], 1))
            bounce, factor = bsdf.sample(rest, si, uniform(s["vertex"], 2), pair, onwards)
            forked = mi.Mask(False)
            if self.glassy:
                forked = onwards & s["whole"] & mirrors_and_refracts(mi, bsdf.flags())
                chosen = [bsdf.sample(part, si, uniform(s["vertex"], 2), pair, forked) for part in sides]
                mirrored = (number + 0.5) / (self.samples * TILE * TILE) >= 1 - MIRRORED
                side = dr.select(mirrored, chosen[0][0], chosen[1][0])
                share = dr.select(mirrored, chosen[0][1] / MIRRORED, chosen[1][1] / (1 - MIRRORED))
                bounce, factor = dr.select(forked, side, bounce), dr.select(forked, share, factor)
            if self.cut:
                passing = met & ~onwards & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
                through, share = bsdf.sample(straight_on, si, uniform(s["vertex"], 2), pair, passing)
                passing &= uniform(s["vertex"], 3) < dr.max(share)
                bounce, factor = dr.select(passing, through, bounce), dr.select(passing, 1, factor)
                onwards |= passing
            null = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Null)
            delta = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta)
            throughput = dr.select(onwards, s["throughput"] * factor, s["throughput"])
            fine = dr.all(dr.isfinite(throughput))
            throughput, lost = dr.select(fine, throughput, 0), lost | (~fine & (bounce.pdf > 0))
            total += dr.select(wide, throughput * around, 0)
            next_ray = si.spawn_ray(dr.select(passed, s["ray"].d, si.to_world(bounce.wo)))
            alive = onwards & (bounce.pdf > 0) & (dr.max(throughput) > LEAST_THROUGHPUT)
            more = {}
            if self.media:
                crossed = onwards & si.is_medium_transition() & (si.wi.z * bounce.wo.z < 0)
                more["medium"] = dr.select(crossed, si.target_medium(next_ray.d), s["medium"])
            if self.glassy:
                more["whole"] = s["whole"] & ~forked
            return more | {
                "active": passed | (alive & (s["vertex"] < MAX_VERTICES)),
                "ray": dr.select(passed | onwards, next_ray, s["ray"]),
                "straight": straight & (passed | (null & onwards)),
                "throughput": throughput,
                "total": total,
                "lost": lost,
                "diffuse": diffuse,
                "albedo": albedo,
                "normal": normal,
                "uv": place,
                "depth": depth,
                "covered": s["covered"] | (met & ~(null & alive)),
                "opacity": s["opacity"] + self._opacity(bsdf, si, met & straight),
                "before": dr.select(onwards & ~null, si, s["before"]),
                "density": dr.select(null, s["density"], bounce.pdf),
                "sampled": dr.select(null, s["sampled"], rough & ~delta),
                "lit": s["lit"] | (rough & ~null),
                "last": wide,
                "vertex": s["vertex"] + 1,
                "chain_uv": chain_uv,
                "chain_weight": chain_weight,
                "ended": s["ended"] | ends,
            }

        state = {
            "active": mi.Mask(True) & (number >= 0),
            "ray": ray,
            "straight": mi.Mask(True) & (number >= 0),
            "throughput": mi.Spectrum(1.0),
            "total": mi.Spectrum(0.0),
            "lost": mi.Mask(False),
            "diffuse": mi.Spectrum(0.0),
            "albedo": mi.Spectrum(0.0),
            "normal": mi.Vector3f(0.0),
            "uv": mi.Point2f(0.0),
            "depth": mi.Float(0.0),
            "covered": mi.Mask(False),
            "opacity": mi.Float(0.0),
            "before": dr.zeros(mi.SurfaceInteraction3f),
            "density": mi.Float(1.0),
            "sampled": mi.Mask(False),
            "lit": mi.Mask(False),
            "last": mi.Mask(False),
            "vertex": mi.UInt32(0),
            "chain_uv": mi.Point2f(0.0),
            "chain_weight": mi.Float(0.0),
            "ended": mi.Mask(False),
        }
        if self.media:
            state["medium"] = dr.zeros(mi.MediumPtr, dr.width(number))
        if self.glassy:
            state["whole"] = mi.Mask(True) & (number >= 0)
        names = list(state)

        def unpacked(*values: Any) -> tuple[Any, ...]:
            result = step(dict(zip(names, values, strict=True)))
            return tuple(result[name] for name in names)

        done = dr.while_loop(tuple(state.values()), lambda *values: values[0], unpacked)
        s = dict(zip(names, done, strict=True))
        covered, ended, lost = (dr.select(s[name], mi.Float(1), 0) for name in ("covered", "ended", "lost"))
        chain = [*s["chain_uv"], ended, s["chain_weight"]]
        means = [*s["total"], s["opacity"], *s["diffuse"], *s["albedo"]]
        return [lost, *means, *chain, *s["normal"], *s["uv"], s["depth"], covered]
