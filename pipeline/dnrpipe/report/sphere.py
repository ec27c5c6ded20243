"""The cameras around the scene: orthographic views from above, from the front, and one that turns by mouse.

Axes are the world's (Z up). Shape and colour both tell roles apart: ring = candidate, numbered disc =
chosen (number: order of selection), triangle = held-out test view.
"""

from __future__ import annotations

import math
from typing import Literal

from markupsafe import Markup, escape

from .data import Sphere, SphereView

SIZE = 360
_MARGIN = 34
_UNIT = SIZE / 2 - _MARGIN
Projection = Literal["top", "front", "oblique"]
_NAMES = {
    "top": "Cameras seen from above",
    "front": "Cameras seen from the front",
    "oblique": "Cameras seen obliquely",
}
AZIMUTH, ELEVATION = math.radians(-60.0), math.radians(25.0)  # of the oblique view; the script starts there


def sphere_svg(sphere: Sphere, projection: Projection) -> Markup:
    """One projection of all cameras. Marks far from the eye are paler and drawn first."""
    half = SIZE / 2
    parts = [
        f'<circle cx="{half}" cy="{half}" r="{_UNIT:.1f}" class="globe"/>',
        f'<circle cx="{half}" cy="{half}" r="{max(2.0, sphere.radius * _UNIT):.1f}" class="scene">'
        "<title>bounding sphere of the scene</title></circle>",
    ]
    parts += _axes(projection)
    placed = [(project(view.position, projection), view) for view in sphere.views]
    rank = {"candidate": 0, "test": 1, "chosen": 2}
    for (x, y, depth), view in sorted(placed, key=lambda p: (p[0][2] >= 0, rank[p[1].role], p[0][2])):
        parts.append(_mark(view, half + x * _UNIT, half - y * _UNIT, depth))
    turn = ' data-turn=""' if projection == "oblique" else ""
    return Markup(
        f'<svg class="sphere" viewBox="0 0 {SIZE} {SIZE}" role="img"{turn} '
        f'aria-label="{_NAMES[projection]}">{"".join(parts)}</svg>'
    )


def project(position: tuple[float, float, float], projection: Projection) -> tuple[float, float, float]:
    """World -> (right, up, towards the eye), all in units of the sphere's scale."""
    x, y, z = position
    if projection == "top":
        return x, y, z
    if projection == "front":  # the eye stands at -Y, as Blender's front view
        return x, z, -y
    # The eye's direction is (cos el cos az, cos el sin az, sin el).
    ca, sa = math.cos(AZIMUTH), math.sin(AZIMUTH)
    ce, se = math.cos(ELEVATION), math.sin(ELEVATION)
    return -sa * x + ca * y, -se * (ca * x + sa * y) + ce * z, ce * (ca * x + sa * y) + se * z


def _axes(projection: Projection) -> list[str]:
    half = SIZE / 2
    parts = []
    for name, vector in (("X", (1.0, 0.0, 0.0)), ("Y", (0.0, 1.0, 0.0)), ("Z", (0.0, 0.0, 1.0))):
        x, y, _ = project(vector, projection)
        if math.hypot(x, y) < 0.1:  # this axis points at the eye
            continue
        data = f'data-p="{vector[0]:.0f} {vector[1]:.0f} {vector[2]:.0f}"'
        parts.append(
            f'<g class="axis3" {data}><line x1="{half}" y1="{half}" x2="{half + x * _UNIT:.1f}" '
            f'y2="{half - y * _UNIT:.1f}" class="frame"/><text x="{half + x * (_UNIT + 16):.1f}" '
            f'y="{half - y * (_UNIT + 16) + 4:.1f}" text-anchor="middle" class="axis">{name}</text></g>'
        )
    return parts


def _mark(view: SphereView, x: float, y: float, depth: float) -> str:
    px, py, pz = view.position
    psnr = f", {view.psnr:.1f} dB" if view.psnr is not None else ""
    role = {"candidate": "candidate", "test": "test view", "chosen": f"chosen as number {view.order}"}[view.role]
    title = escape(f"{view.name}: {role}{psnr}")
    if view.role == "chosen":
        shape = f'<circle r="9.5" class="chosen"/><text y="3.7" text-anchor="middle" class="order">{view.order}</text>'
    elif view.role == "test":
        shape = '<path d="M0 -5.2L4.8 3.6L-4.8 3.6Z" class="test"/>'
    else:
        shape = '<circle r="3.4" class="candidate"/>'
    far = " far" if depth < 0 else ""
    return (
        f'<g class="view{far}" transform="translate({x:.1f} {y:.1f})" '
        f'data-p="{px:.4f} {py:.4f} {pz:.4f}"><title>{title}</title>{shape}</g>'
    )
