"""Pictures in tiles with halos: where a network that sees far has to look, so that no seam is left.

A tile's inputs reach beyond it as far as the network sees, in whole strides: then every layer's pixels lie where they
lie in the whole picture, and what the network makes of the halo's own border never gets into the tile. At the picture's
borders a tile has no halo: padding there is the whole picture's.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tile:
    """Rows and columns of the picture; and what is computed for them, halo included."""

    rows: slice
    seen_rows: slice
    columns: slice
    seen_columns: slice

    @property
    def inner(self) -> tuple[slice, slice]:
        """Rows and columns of the tile within what is computed."""
        pairs = (self.rows, self.seen_rows), (self.columns, self.seen_columns)
        rows, columns = (slice(own.start - seen.start, own.stop - seen.start) for own, seen in pairs)
        return rows, columns


def tiles(height: int, width: int, *, alignment: int, reach: int, pixels: int) -> list[Tile]:
    """Tiles that cover the picture, with the fewest pixels to compute in all.

    Args:
        alignment: of tiles and halos: the network's stride.
        reach: how far the network sees beyond a tile.
        pixels: most of a tile, halo included. Where halos alone have more, tiles are as small as they get.
    """
    halo = _up(reach, alignment)
    best, least = (-(-height // alignment), -(-width // alignment)), float("inf")
    for down in range(1, best[0] + 1):
        if (height + 2 * halo * (down - 1)) * width >= least:
            break
        for across in range(1, best[1] + 1):
            if _largest(height, down, alignment, halo) * _largest(width, across, alignment, halo) <= pixels:
                cost = (height + 2 * halo * (down - 1)) * (width + 2 * halo * (across - 1))
                best, least = ((down, across), cost) if cost < least else (best, least)
                break
    rows, columns = (_parts(size, count, alignment, halo) for size, count in zip((height, width), best, strict=True))
    return [Tile(*row, *column) for row in rows for column in columns]


def _parts(size: int, count: int, alignment: int, halo: int) -> list[tuple[slice, slice]]:
    """(tile, what is computed for it) along one side; as few as ``count`` or fewer."""
    side = _up(-(-size // count), alignment)
    starts = range(0, size, side)
    return [(slice(at, min(at + side, size)), slice(max(0, at - halo), min(at + side + halo, size))) for at in starts]


def _largest(size: int, count: int, alignment: int, halo: int) -> int:
    """The most that is computed for a tile along that side."""
    return min(size, _up(-(-size // count), alignment) + halo * min(2, count - 1))


def _up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple
