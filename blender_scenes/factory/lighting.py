"""Skies and lamps by seed. Only their proportions matter: `meter` sets the level afterwards."""

from __future__ import annotations

import colorsys

import bpy
import numpy as np
from building import area_light, flat_world, image_world, point_light, sun_light
from mathutils import Vector
from patterns import SoftBox, smoothstep, spectral_noise, studio_sky, texel_grid

from factory.dice import Dice, Rgb, scaled

WIDTH = 256  # of sky pictures


def tint(dice: Dice, strength: float = 0.5) -> Rgb:
    """Light between warm and cool, seldom coloured."""
    kind = dice.weighted({"warm": 3.0, "white": 2.0, "cool": 2.0, "coloured": 0.6})
    if kind == "white":
        return 1.0, 1.0, 1.0
    if kind == "coloured":
        return colorsys.hsv_to_rgb(dice.uniform(0, 1), dice.uniform(0.4, 0.9), 1.0)
    far = dice.uniform(0.1, 1.0) * strength
    return (1.0, 1 - 0.55 * far, 1 - 1.2 * far) if kind == "warm" else (1 - 0.8 * far, 1 - 0.35 * far, 1.0)


def _gradient(dice: Dice, boxes: list[SoftBox], strength: float) -> np.ndarray:
    horizon = scaled(tint(dice, 0.8), 0.7)
    zenith = dice.pick([(0.16, 0.30, 0.70), (0.34, 0.50, 0.80), (0.5, 0.5, 0.52), (0.08, 0.10, 0.22), (0.6, 0.4, 0.4)])
    ground = scaled((1.0, 0.9, 0.8), dice.uniform(0.1, 0.5))
    return studio_sky(boxes, zenith, horizon, ground, strength, WIDTH)


def sky_picture(dice: Dice, kind: str) -> np.ndarray:
    """Linear radiance [H, 2H, 3]: "studio" soft boxes, "sun" in a clear sky, "clouds", or a "sunset"."""
    if kind == "studio":
        boxes: list[SoftBox] = [
            (
                dice.uniform(-180, 180),
                dice.uniform(10, 75),
                dice.log(5, 30),
                dice.log(5, 25),
                scaled(tint(dice), dice.log(2, 20)),
            )
            for _ in range(dice.whole(1, 4))
        ]
        return _gradient(dice, boxes, dice.log(0.05, 0.6))
    sky = _gradient(dice, [], dice.uniform(0.4, 1.0))
    u, v = texel_grid(WIDTH // 2, WIDTH)
    azimuth, elevation = (0.5 - u) * 2 * np.pi, (v - 0.5) * np.pi
    if kind in ("clouds", "sunset"):
        lumps = spectral_noise(WIDTH // 2, WIDTH, dice.seed(), slope=1.7, lowest=2)
        share = smoothstep(0.0, 1.2, lumps) * smoothstep(-0.05, 0.25, elevation)
        sky = sky + share[..., None] * np.array(tint(dice, 0.3)) * dice.uniform(0.3, 1.2)
    if kind == "clouds":
        return sky
    lift = dice.uniform(0.05, 0.25) if kind == "sunset" else dice.uniform(0.35, 1.2)
    turn = dice.uniform(-np.pi, np.pi)
    cosine = np.sin(elevation) * np.sin(lift) + np.cos(elevation) * np.cos(lift) * np.cos(azimuth - turn)
    away = np.arccos(np.clip(cosine, -1, 1))
    warm = tint(dice, 0.3) if kind == "sun" else (1.0, 0.6, 0.3)
    disc = dice.log(100, 900) * smoothstep(0.05, 0.03, away) + dice.uniform(0.3, 1.5) * np.exp(-away / 0.2)
    return sky + disc[..., None] * np.array(warm)


def image_sky(dice: Dice, kind: str) -> None:
    image_world("Sky", sky_picture(dice, kind), 1.0)


def _spot(
    name: str, at: Rgb, target: Rgb, power: float, radius: float, angle: float, blend: float, colour: Rgb
) -> None:
    body = point_light(name, at, power, radius, colour)
    lamp = bpy.data.lights.new(name, "SPOT")
    lamp.energy, lamp.color, lamp.shadow_soft_size = power, colour, radius
    lamp.spot_size, lamp.spot_blend = np.radians(angle), blend
    old = body.data
    body.data = lamp
    bpy.data.lights.remove(old)
    body.rotation_euler = (Vector(target) - Vector(at)).to_track_quat("-Z", "Y").to_euler()


def _point(values: np.ndarray) -> Rgb:
    x, y, z = values.tolist()
    return x, y, z


def lamp(dice: Dice, kind: str, reach: float, target: Rgb = (0, 0, 0.1), share: float = 1.0) -> None:
    """A lamp of ``kind`` above a scene of radius ``reach``, aimed near ``target``."""
    turn, lift = dice.uniform(0, 2 * np.pi), dice.uniform(0.35, 1.35)
    far = reach * dice.uniform(1.2, 2.2)
    away = np.array([np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)])
    at = _point(np.array(target) + far * away)
    aim = _point(np.array(target) + 0.2 * reach * dice.rng.uniform(-1, 1, 3))
    power, colour = 30 * far**2 * share * dice.log(0.4, 2.5), tint(dice)
    if kind == "area":
        wide = reach * dice.log(0.08, 1.2)
        area_light("Area lamp", at, aim, power, (wide, wide * dice.log(0.3, 1.0)), colour)
    elif kind == "point":
        point_light("Point lamp", at, power, reach * dice.log(0.005, 0.15), colour)
    elif kind == "spot":
        angle = dice.uniform(25, 70)
        _spot("Spot lamp", at, aim, power * 2, reach * dice.log(0.005, 0.1), angle, dice.uniform(0, 0.8), colour)
    else:
        sun_light("Sun", _point(-away), 3 * share * dice.log(0.5, 2.5), dice.log(0.3, 12), colour)


def plain_world(dice: Dice, low: float, high: float) -> None:
    """One colour, dark to bright."""
    strength = dice.log(low, high)
    flat_world(_point(0.3 + 0.7 * np.array(tint(dice))), strength)


RIGS: dict[str, float] = {
    "studio": 3.0,
    "sun": 1.6,
    "sunset": 0.6,
    "clouds": 1.0,
    "sun lamp": 1.5,
    "lamps": 3.0,
    "one hard lamp": 1.2,
    "soft boxes": 1.5,
    "bright world": 0.8,
}


def rig(dice: Dice, reach: float, target: Rgb = (0, 0, 0.1), rigs: dict[str, float] | None = None) -> str:
    """Light a scene of radius ``reach`` that is open above; returns the rig's name."""
    kind = dice.weighted(rigs or RIGS)
    if kind in ("studio", "sun", "sunset", "clouds"):
        image_sky(dice, kind)
        if dice.chance(0.25):
            lamp(dice, dice.pick(["area", "point", "spot"]), reach, target, 0.5)
    elif kind == "sun lamp":
        plain_world(dice, 0.1, 1.0)
        lamp(dice, "sun", reach, target)
    elif kind == "lamps":
        plain_world(dice, 0.003, 0.3)
        for _ in range(dice.whole(1, 4)):
            lamp(dice, dice.weighted({"area": 2.0, "point": 1.5, "spot": 1.5, "sun": 0.5}), reach, target)
    elif kind == "one hard lamp":
        plain_world(dice, 0.01, 0.15)
        lamp(dice, dice.pick(["point", "spot"]), reach, target)
    elif kind == "soft boxes":
        plain_world(dice, 0.02, 1.0)
        for _ in range(dice.whole(1, 3)):
            lamp(dice, "area", reach, target)
    else:
        plain_world(dice, 0.5, 2.0)
        if dice.chance(0.4):
            lamp(dice, "area", reach, target, 0.7)
    return kind
