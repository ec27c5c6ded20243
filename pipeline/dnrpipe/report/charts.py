"""Small charts, and the cameras around the scene, as inline SVG: real text, the page's own colours, no script.

Series differ by colour *and* dash, bars by colour *and* hatching, so a grey print still tells them apart.
Colours are CSS classes ``c0`` .. ``c6`` (Okabe & Ito 2008, tuned per theme in the template: light and dark both fit).

Cameras: axes are the world's (Z up). Shape and colour both tell roles apart: ring = candidate, numbered disc = chosen
(number: order of selection), triangle = held-out test view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from markupsafe import Markup, escape

from .data import Sphere, SphereView

WIDTH = 480
SPHERE_SIZE = 360
_UNIT = SPHERE_SIZE / 2 - 34  # px: the sphere's radius; a margin for the names of the axes
Projection = Literal["top", "front", "oblique"]
PROJECTIONS: dict[Projection, str] = {
    "top": "Cameras seen from above",
    "front": "Cameras seen from the front",
    "oblique": "Cameras seen obliquely",
}
AZIMUTH, ELEVATION = math.radians(-60.0), math.radians(25.0)  # of the oblique view; the script starts there
_LINE = 14.0  # px between two labels
_CHARACTER = 8.0  # px: a wide character at the larger size that phones get


@dataclass(frozen=True)
class Series:
    """One line: points (x, y), labelled at its end. style: 0..6 (colour and dash), None = its place in the list."""

    label: str
    points: Sequence[tuple[float, float]]
    style: int | None = None


@dataclass(frozen=True)
class Segment:
    """A piece of a bar. kind: CSS class that colours or hatches it. title: shown on hover."""

    kind: str
    value: float
    title: str


@dataclass(frozen=True)
class Bar:
    """One horizontal bar made of segments; ``text`` stands at its end."""

    label: str
    segments: Sequence[Segment]
    text: str


@dataclass(frozen=True)
class Dot:
    """One view of a dot chart. mark: value of the hollow second mark (e.g. a ceiling), or None."""

    label: str
    value: float
    title: str
    mark: float | None = None


@dataclass
class _Canvas:
    """Collects SVG elements; y grows downwards."""

    width: float
    height: float
    title: str
    parts: list[str] = field(default_factory=list)

    def text(self, x: float, y: float, text: str, css: str = "", anchor: str = "start") -> None:
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" class="{css}" text-anchor="{anchor}">{escape(text)}</text>')

    def line(self, x1: float, y1: float, x2: float, y2: float, css: str) -> None:
        self.parts.append(f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" class="{css}"/>')

    def value_axis(self, ticks: Sequence[float], py: Callable[[float], float], left: float, right: float) -> None:
        for tick in ticks:
            self.line(left, py(tick), self.width - right, py(tick), "grid")
            self.text(left - 6, py(tick) + 4, short_number(tick), "tick", "end")

    def svg(self) -> Markup:
        body = "".join(self.parts)
        return Markup(
            f'<svg class="chart" viewBox="0 0 {self.width:.0f} {self.height:.0f}" role="img" '
            f'aria-label="{escape(self.title)}">{body}</svg>'
        )


def line_chart(series: Sequence[Series], title: str, x_label: str, y_label: str, *, log: bool = False) -> Markup:
    """Lines over a common axis. Log axes leave out values ≤ 0; series without points are left out."""
    kept = []
    for index, one in enumerate(series):
        points = [(x, y) for x, y in one.points if math.isfinite(y) and (y > 0 or not log)]
        if points:
            kept.append((index % 7 if one.style is None else one.style, one.label, points))
    if not kept:
        return Markup("")
    height, left, top, bottom = 300.0, 52.0, 26.0, 40.0
    right = 16.0 + _CHARACTER * max(len(label) for _, label, _ in kept)
    canvas = _Canvas(WIDTH, height, title)
    xs = [x for _, _, points in kept for x, _ in points]
    ys = [y for _, _, points in kept for _, y in points]
    x0, x1 = min(xs), max(xs)
    x1 = x1 if x1 > x0 else x0 + 1
    ticks = log_ticks(min(ys), max(ys)) if log else linear_ticks(min(ys), max(ys))
    low, high = min(ticks[0], min(ys)), max(ticks[-1], max(ys))

    def px(x: float) -> float:
        return left + (x - x0) / (x1 - x0) * (WIDTH - left - right)

    def py(y: float) -> float:
        a, b, v = (math.log(low), math.log(high), math.log(y)) if log else (low, high, y)
        return top + (1 - (v - a) / (b - a)) * (height - top - bottom)

    canvas.text(4, 14, y_label, "axis")
    canvas.value_axis(ticks, py, left, right)
    for tick in linear_ticks(x0, x1, whole=True):
        if x0 <= tick <= x1:
            canvas.text(px(tick), height - bottom + 18, short_number(tick), "tick", "middle")
    canvas.text((left + WIDTH - right) / 2, height - 4, x_label, "axis", "middle")
    canvas.line(left, height - bottom, WIDTH - right, height - bottom, "frame")
    ends = spread([py(points[-1][1]) for _, _, points in kept], top, height - bottom)
    for (i, label, points), end in zip(kept, ends, strict=True):
        path = " ".join(f"{px(x):.1f},{py(y):.1f}" for x, y in points)
        canvas.parts.append(f'<polyline points="{path}" class="line s{i} d{i}"/>')
        last_x, last_y = points[-1]
        canvas.parts.append(
            f'<circle cx="{px(last_x):.1f}" cy="{py(last_y):.1f}" r="3" class="f{i}">'
            f"<title>{escape(label)}: {last_y:.4g}</title></circle>"
        )
        canvas.text(WIDTH - right + 9, end + 4, label, f"label f{i}")
    return canvas.svg()


def bar_chart(bars: Sequence[Bar], title: str) -> Markup:
    """Horizontal bars on a common linear scale from zero."""
    largest = max((math.fsum(s.value for s in bar.segments) for bar in bars), default=0.0)
    if largest <= 0:
        return Markup("")
    left = 12.0 + _CHARACTER * max(len(bar.label) for bar in bars)
    right = 14.0 + _CHARACTER * max(len(bar.text) for bar in bars)
    row = 34.0
    canvas = _Canvas(WIDTH, row * len(bars) + 6, title)
    for index, bar in enumerate(bars):
        y = index * row + 6
        canvas.text(left - 8, y + 17, bar.label, "label", "end")
        x = left
        for segment in bar.segments:
            span = segment.value / largest * (WIDTH - left - right)
            canvas.parts.append(
                f'<rect x="{x:.2f}" y="{y:.1f}" width="{span:.2f}" height="24" class="{segment.kind}">'
                f"<title>{escape(segment.title)}</title></rect>"
            )
            x += span
        canvas.text(x + 8, y + 17, bar.text, "value")
    canvas.line(left, 2, left, row * len(bars) + 2, "frame")
    return canvas.svg()


def dot_chart(dots: Sequence[Dot], title: str, x_label: str, y_label: str, *, from_zero: bool = False) -> Markup:
    """One column per view, in the given order; filled dot: value, hollow diamond: ``mark``.

    ``from_zero``: for amounts (seconds); the axis then starts at zero and dots stand on stems.
    """
    if not dots:
        return Markup("")
    height, left, right, top, bottom = 280.0, 48.0, 12.0, 26.0, 34.0
    canvas = _Canvas(WIDTH, height, title)
    values = [d.value for d in dots] + [d.mark for d in dots if d.mark is not None]
    ticks = linear_ticks(0.0 if from_zero else min(values), max(values))
    low, high = min(ticks[0], min(values)), max(ticks[-1], max(values))
    column = (WIDTH - left - right) / len(dots)

    def py(y: float) -> float:
        return top + (1 - (y - low) / (high - low)) * (height - top - bottom)

    canvas.text(4, 14, y_label, "axis")
    canvas.value_axis(ticks, py, left, right)
    canvas.line(left, height - bottom, WIDTH - right, height - bottom, "frame")
    radius = min(5.0, max(1.5, column * 0.35))
    for index, dot in enumerate(dots):
        x = left + (index + 0.5) * column
        if from_zero:
            canvas.line(x, py(dot.value), x, height - bottom, "stem")
        if dot.mark is not None:
            y, r = py(dot.mark), radius + 0.5
            canvas.line(x, py(dot.value), x, y, "stem")
            canvas.parts.append(
                f'<path d="M{x:.1f} {y - r:.1f}l{r:.1f} {r:.1f}l{-r:.1f} {r:.1f}l{-r:.1f} {-r:.1f}z" class="mark"/>'
            )
        canvas.parts.append(
            f'<circle cx="{x:.1f}" cy="{py(dot.value):.1f}" r="{radius:.1f}" class="f0">'
            f"<title>{escape(dot.title)}</title></circle>"
        )
        if len(dot.label) * 7.5 + 4 < column:
            canvas.text(x, height - bottom + 14, dot.label, "tick", "middle")
    canvas.text((left + WIDTH - right) / 2, height - 4, x_label, "axis", "middle")
    return canvas.svg()


def linear_ticks(low: float, high: float, *, whole: bool = False) -> list[float]:
    """Round values (1, 2 or 5 × a power of ten) that enclose [low, high]; about five steps."""
    if not high > low:
        pad = max(abs(low) * 0.1, 1.0 if whole else 1e-3)
        low, high = low - pad, high + pad
    raw = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(f * power for f in (1, 2, 5, 10) if f * power >= raw * 0.999)
    step = max(step, 1.0) if whole else step
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [i * step for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten that enclose [low, high] (both > 0), with 2 and 5 between them on a short range."""
    first, last = math.floor(math.log10(low) + 1e-9), math.ceil(math.log10(high) - 1e-9)
    decades = last - first
    factors: tuple[int, ...] = (1, 2, 5) if decades <= 2 else (1,)
    stride = max(1, math.ceil(decades / 7))
    ticks = [f * 10.0**e for e in range(first, last + 1, stride) for f in factors]
    below = [t for t in ticks if t <= low * 1.0001][-1:] or ticks[:1]
    above = [t for t in ticks if t >= high * 0.9999][:1] or [10.0**last]
    inside = [t for t in ticks if below[0] <= t <= above[0]]
    return inside if len(inside) > 1 else [below[0], below[0] * 10]


def spread(positions: Sequence[float], low: float, high: float) -> list[float]:
    """Label positions moved apart to at least one line each, kept within [low, high] where they fit."""
    order = sorted(range(len(positions)), key=lambda i: positions[i])
    result = list(positions)
    previous = low - _LINE
    for i in order:
        result[i] = previous = max(positions[i], previous + _LINE)
    limit = high
    for i in reversed(order):
        result[i] = min(result[i], limit)
        limit = result[i] - _LINE
    return result


def short_number(value: float) -> str:
    """Tick label: at most three significant digits, no trailing zeros, thousands as they are."""
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        text = f"{value:.6f}".rstrip("0").rstrip(".")
        return text if text not in ("-0", "") else "0"
    exponent = math.floor(math.log10(abs(value)) + 1e-9)
    return f"{value / 10.0**exponent:.3g}e{exponent}"


def sphere_svg(sphere: Sphere, projection: Projection) -> Markup:
    """One projection of all cameras. Marks far from the eye are paler and drawn first."""
    half = SPHERE_SIZE / 2
    parts = [
        f'<circle cx="{half}" cy="{half}" r="{_UNIT:.1f}" class="globe"/>',
        f'<circle cx="{half}" cy="{half}" r="{max(2.0, sphere.radius * _UNIT):.1f}" class="scene">'
        "<title>bounding sphere of the scene</title></circle>",
    ]
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
    placed = [(project(view.position, projection), view) for view in sphere.views]
    rank = {"candidate": 0, "test": 1, "chosen": 2}
    for (x, y, depth), view in sorted(placed, key=lambda p: (p[0][2] >= 0, rank[p[1].role], p[0][2])):
        parts.append(_mark(view, half + x * _UNIT, half - y * _UNIT, depth))
    turn = ' data-turn=""' if projection == "oblique" else ""
    return Markup(
        f'<svg class="sphere" viewBox="0 0 {SPHERE_SIZE} {SPHERE_SIZE}" role="img"{turn} '
        f'aria-label="{PROJECTIONS[projection]}">{"".join(parts)}</svg>'
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
