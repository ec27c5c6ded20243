"""Build `bricks`: a castle of 2,300 plastic toy bricks on a baseplate.

    python blender_scenes/build_bricks.py [out.blend]

Exercises: many instances of few meshes (vertex instancing), coated-plastic highlights everywhere, a roughness
image (fingerprints), printed tiles, deep inter-reflection in courtyards, hard edges by the thousand.
"""

from __future__ import annotations

from collections import defaultdict

import bpy
import numpy as np
from building import camera, image_world, main, make_image, material, picture
from castle import Castle, Piece, build_castle
from patterns import smoothstep, spectral_noise, studio_sky, texel_grid
from solids import Shape, ball, box, convex, grid, join, lathe, place, rotation, tube

PITCH = 0.05  # one stud
HEIGHT = 0.06  # one brick
GAP = 0.0006  # between neighbours
CELLS = 48  # baseplate, studs per side
SIZES = [(4, 2), (2, 4), (3, 2), (2, 3), (2, 2), (4, 1), (1, 4), (3, 1), (1, 3), (2, 1), (1, 2), (1, 1)]

COLOURS = {
    "Light grey": (0.36, 0.37, 0.37),
    "Dark grey": (0.11, 0.115, 0.12),
    "Tan": (0.68, 0.52, 0.28),
    "Red": (0.52, 0.012, 0.015),
    "Blue": (0.012, 0.07, 0.42),
    "Brown": (0.10, 0.035, 0.012),
    "Green": (0.02, 0.20, 0.035),
    "Lime": (0.30, 0.48, 0.02),
    "Yellow": (0.85, 0.48, 0.01),
    "White": (0.80, 0.80, 0.77),
    "Black": (0.012, 0.012, 0.014),
}


# ---------------------------------------------------------------- cells -> bricks


def tile(castle: Castle) -> dict[tuple[str, str, int, int, bool], list[tuple[float, float, float]]]:
    """Cover each layer with bricks: (kind, colour, width, depth, studs) -> lower centres, scene units."""
    layers: dict[int, dict[tuple[int, int], Piece]] = defaultdict(dict)
    for (x, y, z), piece in castle.cells.items():
        layers[z][x, y] = piece
    out: dict[tuple[str, str, int, int, bool], list[tuple[float, float, float]]] = defaultdict(list)
    for z in sorted(layers):
        left = dict(layers[z])
        above = layers.get(z + 1, {})
        order = sorted(left, key=(lambda c: (c[1], c[0])) if z % 2 else (lambda c: (c[0], c[1])))
        sizes = SIZES if z % 2 else [(d, w) for w, d in SIZES]
        for start in order:
            if start not in left:
                continue
            kind, colour = left[start]
            for width, depth in sizes if kind == "brick" else [(1, 1)]:
                cells = [(start[0] + i, start[1] + j) for i in range(width) for j in range(depth)]
                # A first brick of odd length shifts the joints of every other layer.
                if all(left.get(cell) == (kind, colour) for cell in cells) and not (
                    width * depth == 8 and castle.random.random() < 0.25
                ):
                    break
            for cell in cells:
                del left[cell]
            hidden = all(cell in above for cell in cells)
            centre = (start[0] + width / 2, start[1] + depth / 2)
            out[kind, colour, width, depth, not hidden].append((centre[0] * PITCH, centre[1] * PITCH, z * HEIGHT))
    return out


def stud(x: float, y: float, z: float, sides: int = 12) -> Shape:
    """Stud standing at (x, y, z), without its hidden bottom."""
    radius, height, bevel = 0.3 * PITCH, 0.2 * PITCH, 0.03 * PITCH
    profile = [(radius, 0.0), (radius, height - bevel), (radius - bevel, height), (0.0, height)]
    return lathe(profile, sides, (0.5, 0.2)).moved((x, y, z))


def brick(width: int, depth: int, studs: bool) -> Shape:
    """Brick standing at the origin's plane, centred in X and Y."""
    size = (width * PITCH - GAP, depth * PITCH - GAP, HEIGHT - GAP / 2)
    body = box(size, bevel=0.03 * PITCH, scale=3.0, at=(0, 0, HEIGHT / 2))
    tops = []
    if studs:
        for i in range(width):
            for j in range(depth):
                tops.append(stud((i + 0.5 - width / 2) * PITCH, (j + 0.5 - depth / 2) * PITCH, HEIGHT))
    return join([body, *tops])


def slope(side: int, *, corner: bool) -> Shape:
    """One-cell roof brick that falls off towards ``side`` (and the next side, for a corner) to a low lip."""
    a, lip, top = (PITCH - GAP) / 2, 0.12 * HEIGHT, HEIGHT - GAP / 2
    height = {(sx, sy): top for sx in (-1, 1) for sy in (-1, 1)}
    for sx, sy in height:
        falls = sx > 0 or (corner and sy > 0)
        height[sx, sy] = lip if falls else top
    ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    points = np.array(
        [(sx * a, sy * a, 0.0) for sx, sy in ring] + [(sx * a, sy * a, height[sx, sy]) for sx, sy in ring]
    )
    centre = np.array([0, 0, 0.3 * HEIGHT])
    faces: list[tuple[int, ...]] = [(0, 1, 2, 3), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    faces += [(4, 5, 6), (4, 6, 7)] if corner else [(4, 5, 6, 7)]
    return convex(points - centre, faces, 3.0).moved(centre).moved(turn=rotation(2, 90.0 * side).round())


def piece_shape(kind: str, width: int, depth: int, studs: bool) -> Shape:
    """The mesh of a kind of brick."""
    if kind.startswith("slope"):
        return slope(int(kind[-1]), corner=False)
    if kind.startswith("corner"):
        return slope(int(kind[-1]), corner=True)
    return brick(width, depth, studs)


# ---------------------------------------------------------------- materials and pictures


def fingerprints(size: int = 256) -> np.ndarray:
    """Roughness of handled plastic, [N, N]: smears and fine scratches on a smooth ground."""
    smear = smoothstep(0.4, 1.8, spectral_noise(size, size, 3, slope=1.8, lowest=2))
    scratch = smoothstep(1.6, 2.6, spectral_noise(size, size, 4, slope=0.4, stretch=12.0))
    return np.clip(0.14 + 0.16 * smear + 0.18 * scratch, 0, 1)


def banner(design: int, size: int = 128) -> np.ndarray:
    """Printed heraldry, [N, N, 3], display-encoded: a lion-yellow sun on red, or a cross on blue."""
    u, v = texel_grid(size, size)
    x, y = u * 2 - 1, v * 2 - 1
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    if design == 0:
        ground, ink = np.array([0.72, 0.08, 0.07]), np.array([0.98, 0.80, 0.18])
        mark = smoothstep(0.02, -0.02, radius - 0.28) + smoothstep(
            0.02, -0.02, np.abs(radius - 0.52) - 0.16 * np.abs(np.cos(6 * angle)) ** 0.6
        )
    else:
        ground, ink = np.array([0.07, 0.20, 0.58]), np.array([0.95, 0.94, 0.90])
        mark = smoothstep(0.02, -0.02, np.minimum(np.abs(x), np.abs(y)) - 0.16) * smoothstep(0.75, 0.70, radius)
    border = smoothstep(0.90, 0.93, np.maximum(np.abs(x), np.abs(y)))
    mark = np.clip(mark + border, 0, 1)
    return ground + (ink - ground) * mark[..., None]


def build_materials() -> dict[str, bpy.types.Material]:
    """Plastic in each colour, all with the fingerprints on their roughness."""
    touched = make_image("fingerprints", fingerprints(), data=True)
    made = {}
    for name, colour in COLOURS.items():
        made[name] = material(f"Plastic, {name.lower()}", colour, IOR=1.5)
        picture(made[name], touched, "Roughness")
    return made


# ---------------------------------------------------------------- the scene


def build_bricks(castle: Castle, plastic: dict[str, bpy.types.Material]) -> None:
    """One mesh per kind of brick; a cloud of points per kind says where it stands (vertex instancing)."""
    for (kind, colour, width, depth, studs), places in tile(castle).items():
        size = "" if kind != "brick" else f" {width}x{depth}{'' if studs else ' smooth'}"
        name = f"{colour} {kind}{size}"
        points = bpy.data.meshes.new(f"{name}, places")
        points.from_pydata(places, [], [])
        spread = place(f"{name}, places", points)
        body = place(name, piece_shape(kind, width, depth, studs), plastic[colour], smooth=30.0)
        body.parent = spread
        spread.instance_type = "VERTS"


def build_ground(castle: Castle, plastic: dict[str, bpy.types.Material]) -> None:
    """Baseplate with a moat: studs where nothing stands, smooth blue tiles for water."""
    half = CELLS // 2
    thick = 0.4 * HEIGHT
    water = material("Plastic, clear blue", (0.02, 0.16, 0.42), Roughness=0.03, IOR=1.5)
    body = box((CELLS * PITCH, CELLS * PITCH, thick), bevel=0.1 * PITCH, scale=2.0, at=(0, 0, -thick / 2))
    place("Baseplate", body, plastic["Green"], smooth=None)
    studs, tiles, path = [], [], []
    for x in range(-half, half):
        for y in range(-half, half):
            if (x, y, 0) in castle.cells:
                continue
            centre = ((x + 0.5) * PITCH, (y + 0.5) * PITCH)
            ring = max(abs(x + 0.5), abs(y + 0.5))
            flat = box((PITCH - GAP, PITCH - GAP, 0.008), bevel=0.0015, scale=6.0, at=(*centre, 0.004))
            if 19 <= ring < 22:
                tiles.append(flat)
            elif ring < 13 and abs(x + 0.5) < 3 and y < -3:
                path.append(flat)
            else:
                studs.append(stud(*centre, 0.0, 8))
    place("Baseplate studs", join(studs), plastic["Green"], smooth=30.0)
    place("Moat", join(tiles), water, smooth=None)
    place("Courtyard path", join(path), plastic["Tan"], smooth=None)


def build_flags(flags: list[tuple[float, float, float, int]], plastic: dict[str, bpy.types.Material]) -> None:
    """Poles with waving printed flags on the roofs, and shields over the gate."""
    printed = []
    for design, name in enumerate(("sun", "cross")):
        made = material(f"Printed, {name}", (0.5, 0.5, 0.5), Roughness=0.25)
        picture(made, make_image(f"banner {name}", banner(design)), "Base Color")
        printed.append(made)
    for i, (x, y, layer, design) in enumerate(flags):
        at = (x * PITCH, y * PITCH, layer * HEIGHT)
        pole = tube(np.array([[0, 0, -0.02], [0, 0, 0.13], [0, 0, 0.25]]), 0.008, 10)
        place(f"Pole {i}", join([pole, ball(0.015, 8, 12).moved((0, 0, 0.25))]), plastic["Yellow"], at=at)
        s, t = np.meshgrid(np.linspace(0, 1, 13), np.linspace(0, 1, 5))
        wave = 0.02 * np.sin(s * 7 + i) * s
        cloth = np.stack([0.008 + 0.19 * s, wave, 0.115 + 0.12 * t - 0.01 * s], axis=-1)
        front = grid(cloth, np.stack([s, t], axis=-1))
        back = grid(cloth[:, ::-1] + (0, 0.002, 0), np.stack([s, t], axis=-1)[:, ::-1])
        place(f"Flag {i}", join([front, back]), printed[design], at=at, turn=(0, 0, 25.0 * i - 40), smooth=60.0)
    for i, x in enumerate((-4.5, 4.5)):
        panel = box((0.12, 0.012, 0.14), bevel=0.002)
        front = panel.faces.index(min(panel.faces, key=lambda face: panel.points[list(face), 1].mean()))
        start = sum(len(face) for face in panel.faces[:front])
        corners = panel.points[list(panel.faces[front])]
        panel.uv[start : start + len(corners)] = (corners[:, [0, 2]] - corners[:, [0, 2]].min(0)) / np.ptp(
            corners[:, [0, 2]], axis=0
        )
        place(f"Shield {i}", panel, printed[i], at=(x * PITCH, -17 * PITCH - 0.006, 8 * HEIGHT), smooth=None)


def build() -> None:
    """Castle, ground, flags; a studio sky; a three-quarter view from the front."""
    plastic = build_materials()
    castle, flags = build_castle()
    build_bricks(castle, plastic)
    build_ground(castle, plastic)
    build_flags(flags, plastic)
    boxes = [
        (-60.0, 48.0, 22.0, 18.0, (11.0, 10.0, 8.6)),
        (160.0, 35.0, 14.0, 20.0, (2.2, 2.7, 3.6)),
        (60.0, 30.0, 12.0, 18.0, (2.4, 2.4, 2.4)),
    ]
    image_world("Studio sky", studio_sky(boxes, zenith=(0.45, 0.58, 0.82), strength=0.5), 0.72)
    camera((2.1, -4.6, 3.0), (0.0, 0.0, 0.38), lens=52)


if __name__ == "__main__":
    main("bricks", build)
