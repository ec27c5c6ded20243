"""An analytic scene in the contract's format: a textured sphere on a checkered plane, one sun, a shadow.

Everything is exact and renderer-free: UV, depth, normal, mask by ray-sphere and ray-disk intersection at
pixel centres; colour, alpha and coverage by supersampling. ``raster`` colour has neither highlight nor
shadow, so that step 2 has something to learn.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dnrtrain.contract import SceneFrame, View
from dnrtrain.exr import write_exr

CENTRE = np.array([0.0, 0.0, 0.6])
RADIUS = 0.6
DISK = 1.4
LIGHT = np.array([0.5, -0.3, 0.81]) / np.linalg.norm([0.5, -0.3, 0.81])
FRAME = SceneFrame(near=2.0, far=6.0, center=(0.0, 0.0, 0.4), radius=1.5)


@dataclass(frozen=True)
class Hit:
    mask: np.ndarray
    distance: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    uv: np.ndarray
    sphere: np.ndarray


def look_at(position: np.ndarray, size: int, name: str, *, width: int | None = None) -> View:
    """A camera at ``position`` that looks at the scene's centre; about 40 degrees of view."""
    target = np.array(FRAME.center)
    z = (position - target) / np.linalg.norm(position - target)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    matrix[:3, 3] = position
    width = width or size
    focal = 1.35 * size
    return View(
        name=name, width=width, height=size, fl_x=focal, fl_y=focal, cx=width / 2, cy=size / 2,
        c2w=tuple(tuple(float(v) for v in row) for row in matrix),
    )  # fmt: skip


def dome(count: int, size: int, *, seed: int = 0, prefix: str = "", distance: float = 4.0) -> list[View]:
    """``count`` cameras on the upper hemisphere (Fibonacci spiral, turned by ``seed``)."""
    k = np.arange(count) + 0.5
    height = 0.15 + 0.75 * k / count
    angle = np.pi * (1 + 5**0.5) * k + seed * 1.234
    flat = np.sqrt(1 - height**2)
    points = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1) * distance
    return [look_at(p + np.array(FRAME.center), size, f"{prefix}{i:04d}") for i, p in enumerate(points)]


def intersect(origin: np.ndarray, direction: np.ndarray) -> Hit:
    """First hit of rays [..., 3] with the sphere and the disk."""
    oc = origin - CENTRE
    b = (oc * direction).sum(-1)
    disc = b * b - ((oc * oc).sum(-1) - RADIUS**2)
    t_sphere = np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.inf)
    t_sphere = np.where(t_sphere > 1e-4, t_sphere, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        t_plane = -origin[..., 2] / direction[..., 2]
        p = origin + t_plane[..., None] * direction
        inside = (t_plane > 1e-4) & (p[..., 0] ** 2 + p[..., 1] ** 2 < DISK**2)
    t_plane = np.where(inside, t_plane, np.inf)
    t = np.minimum(t_sphere, t_plane)
    mask = np.isfinite(t)
    sphere = mask & (t_sphere <= t_plane)
    position = origin + np.where(mask, t, 0)[..., None] * direction
    normal = np.where(sphere[..., None], (position - CENTRE) / RADIUS, np.array([0.0, 0.0, 1.0]))
    # Atlas: the left half holds the sphere (octahedral), the right half the disk.
    n = normal / np.abs(normal).sum(-1, keepdims=True)
    folded = (1 - np.abs(n[..., [1, 0]])) * np.where(n[..., :2] >= 0, 1, -1)
    octa = np.where(n[..., 2:] < 0, folded, n[..., :2]) * 0.5 + 0.5
    disk = position[..., :2] / DISK * 0.5 + 0.5
    uv = np.where(sphere[..., None], octa * [0.48, 0.96] + [0.01, 0.02], disk * [0.48, 0.96] + [0.51, 0.02])
    return Hit(mask, t, position, normal, uv, sphere)


def shade(hit: Hit, direction: np.ndarray, *, raytraced: bool) -> np.ndarray:
    """Linear radiance [..., 3]; the ray-traced kind adds a highlight, a shadow and ambient occlusion."""
    p = hit.position
    stripes = 0.5 + 0.5 * np.sin(14 * p[..., 2] + 6 * np.arctan2(p[..., 1], p[..., 0]))
    checker = ((np.floor(p[..., 0] * 3) + np.floor(p[..., 1] * 3)) % 2).astype(float)
    ball = np.array([0.8, 0.25, 0.1]) * (0.35 + 0.65 * stripes[..., None])
    floor = np.where(checker[..., None] > 0, [0.2, 0.5, 0.7], [0.7, 0.65, 0.5])
    albedo = np.where(hit.sphere[..., None], ball, floor)
    cosine = np.clip((hit.normal * LIGHT).sum(-1), 0, None)
    if not raytraced:
        return albedo * (0.25 + 0.75 * cosine[..., None])
    start = p + 1e-3 * hit.normal
    lit = ~intersect(start, np.broadcast_to(LIGHT, start.shape)).mask
    gap = np.linalg.norm(p - CENTRE, axis=-1) / RADIUS
    ambient = 0.25 * np.where(hit.sphere, 0.6 + 0.4 * hit.normal[..., 2], 1 - 0.8 / np.maximum(gap, 1) ** 3)
    mirrored = direction - 2 * (direction * hit.normal).sum(-1, keepdims=True) * hit.normal
    highlight = 1.5 * np.clip((mirrored * LIGHT).sum(-1), 0, None) ** 30 * hit.sphere
    return albedo * (ambient + 0.75 * cosine * lit)[..., None] + (highlight * lit)[..., None]


def render(view: View, *, raytraced: bool, supersampling: int = 3) -> dict[str, np.ndarray]:
    """Premultiplied linear R G B A [H, W] each (box filter over a regular sub-pixel grid)."""
    fine = view.model_copy(
        update={
            "width": view.width * supersampling, "height": view.height * supersampling,
            "fl_x": view.fl_x * supersampling, "fl_y": view.fl_y * supersampling,
            "cx": view.cx * supersampling, "cy": view.cy * supersampling,
        }
    )  # fmt: skip
    direction = fine.ray_directions().astype(np.float64)
    hit = intersect(np.broadcast_to(view.position, direction.shape), direction)
    colour = np.where(hit.mask[..., None], shade(hit, direction, raytraced=raytraced), 0)
    rgba = np.concatenate([colour, hit.mask[..., None]], axis=-1)
    s = supersampling
    rgba = rgba.reshape(view.height, s, view.width, s, 4).mean(axis=(1, 3))
    return {name: rgba[..., i] for i, name in enumerate("RGBA")}


def gbuffer(view: View) -> dict[str, np.ndarray]:
    """The contract's G-buffer channels at pixel centres, coverage by supersampling."""
    direction = view.ray_directions().astype(np.float64)
    hit = intersect(np.broadcast_to(view.position, direction.shape), direction)
    depth = hit.distance * (direction @ -view.matrix[:3, 2])
    values = {"depth.Z": depth, "mask": np.ones_like(depth), "object.Id": np.where(hit.sphere, 1.0, 2.0)}
    for i, axis in enumerate("XYZ"):
        values[f"normal.{axis}"] = hit.normal[..., i]
        values[f"position.{axis}"] = hit.position[..., i]
    values["uv.U"], values["uv.V"] = hit.uv[..., 0], hit.uv[..., 1]
    channels = {name: np.where(hit.mask, value, 0) for name, value in values.items()}
    return {**channels, "coverage": render(view, raytraced=False)["A"]}


def base(view: View) -> dict[str, np.ndarray]:
    """The contract's base file: the raster colour as its diffuse part, twice that on the sphere as the whole, and
    the mirror path from the sphere to the disk."""
    colour = render(view, raytraced=False)
    direction = view.ray_directions().astype(np.float64)
    hit = intersect(np.broadcast_to(view.position, direction.shape), direction)
    mirrored = direction - 2 * (direction * hit.normal).sum(-1, keepdims=True) * hit.normal
    end = intersect(hit.position + 1e-3 * hit.normal, mirrored)
    found = hit.sphere & end.mask
    shiny = 1.0 + hit.sphere
    values = {f"base.{c}": colour[c] * shiny for c in "RGB"} | {"base.A": colour["A"]}
    values |= {f"diffuse.{c}": colour[c] for c in "RGB"} | {f"albedo.{c}": 0.5 * colour["A"] for c in "RGB"}
    values |= {"noise": 0.1 * colour["A"], "rays": np.full_like(colour["A"], 4)}
    ends = {"U": end.uv[..., 0], "V": end.uv[..., 1], "mask": np.ones_like(shiny), "weight": np.full_like(shiny, 0.7)}
    return values | {f"chain.{name}": np.where(found, value, 0) for name, value in ends.items()}


def write_bases(folder: Path, views: list[View]) -> list[Path]:
    """Write base files; returns their paths."""
    paths = [folder / "base" / f"{view.name}.exr" for view in views]
    for view, path in zip(views, paths, strict=True):
        write_exr(path, base(view), {"view": view.name})
    return paths


def write_scene(folder: Path, views: list[View]) -> tuple[list[Path], list[Path]]:
    """Write pass files (with raster colour) and ray-traced files; returns both lists."""
    passes, images = [], []
    for view in views:
        passes.append(folder / "passes" / f"{view.name}.exr")
        images.append(folder / "raytraced" / f"{view.name}.exr")
        write_exr(passes[-1], {**gbuffer(view), **render(view, raytraced=False)}, {"view": view.name})
        write_exr(images[-1], render(view, raytraced=True), {"view": view.name, "spp": 9})
    return passes, images
