"""The tiles of an image, the tiles that a Gaussian touches, and the amount of work of a lane.

A tile is a block of pixels. A closed form gives the tiles of each row that the cutoff ellipse of a
Gaussian touches. An elongated Gaussian therefore visits only the tiles along its axis, not all
tiles of its bounding box. Only `granularity_of` decides, by backend, how much work one lane of a
kernel gets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import drjit as dr

from ..backend.arrays import ArrayTypes, Divisor, make_divisor, rcp, rsqrt, types_of
from ..backend.types import Bool, Float, FloatLike, UInt


class Granularity(NamedTuple):
    """The amount of work of a lane.

    Attributes
    ----------
    rows : int
        Rows of a tile that one lane owns, in the sum over Gaussians and in the adjoint: 1, 2 or 4.
    visits, long_visits : int
        Largest number of tiles that one lane of the adjoint visits, and the number for lists that
        are long enough to keep `MIN_PIECES` lanes busy. A Gaussian that touches more tiles gets
        several lanes, so that even a few large Gaussians use many cores; fewer lanes have fewer
        results to store and to add.
    ordered : bool
        Whether lanes are ordered by their work. A SIMD packet of a CPU takes as long as its longest
        lane, and ordering is cheap there; a GPU would need another sort.
    products : bool
        Whether weights along a row continue one exponential by products, if that is accurate. On a
        GPU an exponential is one instruction, and products would cost more.
    block : int
        Number of pieces whose results one lane adds before another lane adds these blocks, for
        GPUs, where a Gaussian that covers the image would keep one lane busy while all others
        wait. Lists are then built with a lane for each entry. With 0, one lane lists and adds all
        tiles of a Gaussian.
    """

    rows: int
    visits: int
    long_visits: int
    ordered: bool
    products: bool
    block: int

    def visits_for(self, entries: int, tiles: int) -> int:
        """Return the largest number of tiles of a lane, for an image with such lists."""
        large = tiles > SMALL_IMAGE_TILES and entries >= MIN_PIECES * self.long_visits
        return self.long_visits if large else self.visits


MIN_PIECES = 1 << 15
"""Number of pieces that keeps all cores of a large CPU busy."""

SMALL_IMAGE_TILES = 1 << 12
"""Largest number of tiles of an image, 256x256 pixels, that always uses `Granularity.visits`. In a
batch, the number of visits must not depend on the other images, because it fixes the order of
summation."""

ON_CPU = Granularity(rows=4, visits=16, long_visits=64, ordered=True, products=True, block=0)
"""On llvm, a lane reuses the parameters of a Gaussian for 16 pixels."""

ON_GPU = Granularity(rows=1, visits=16, long_visits=16, ordered=False, products=False, block=64)
"""On a GPU, more lanes with fewer registers hide the latency of memory."""


def granularity_of(types: ArrayTypes) -> Granularity:
    """Return the granularity for the backend of some array types."""
    return ON_CPU if types.backend == "llvm" else ON_GPU


TILE = (4, 4)
"""Width and height of a tile in pixels. Measured on 2 cores with AVX-512: 4x4 keeps the sums of 16
pixels in registers and visits 1.7 pixels for each pixel inside the ellipse (8x8: 3.3)."""


@dataclass(frozen=True)
class Grid:
    """Division of `width` x `height` images into `nx` x `ny` tiles each; the last may overhang.

    Several images form a batch. Their tiles are consecutive, and so are their Gaussians, of which
    each image has the same number. Coordinates are relative to the image.
    """

    width: int
    height: int
    tile: tuple[int, int] = TILE
    images: int = 1

    @property
    def nx(self) -> int:
        """Number of columns of tiles."""
        return -(-self.width // self.tile[0])

    @property
    def ny(self) -> int:
        """Number of rows of tiles."""
        return -(-self.height // self.tile[1])

    @property
    def tiles(self) -> int:
        """Number of tiles of all images."""
        return self.nx * self.ny * self.images

    @property
    def pixels(self) -> int:
        """Number of pixels of one tile."""
        return self.tile[0] * self.tile[1]

    @property
    def overhangs(self) -> bool:
        """Whether the last tiles overhang the image."""
        return self.nx * self.tile[0] != self.width or self.ny * self.tile[1] != self.height

    def in_arrays(self, types: ArrayTypes) -> TileLayout:
        """Return the layout of tiles, for programs that serve grids of every size."""
        width, height = (dr.opaque(types.Float, v) for v in (self.width, self.height))
        row, ny = make_divisor(types, self.nx), dr.opaque(types.Int, self.ny)
        image = make_divisor(types, self.nx * self.ny) if self.images > 1 else None
        return TileLayout(width, height, ny, row, image, self.tile)


@dataclass(frozen=True)
class TileLayout:
    """Where tiles and pixels of a `Grid` lie in their image.

    Sizes are in arrays: as literals, every size would compile a program of its own. There are few
    of them, because each costs a frozen program a microsecond per call.

    Attributes
    ----------
    width, height : Float, shape (1,)
    ny : Int32, shape (1,)
    row : Divisor
        Number of tiles of a row.
    image : Divisor or None
        Number of tiles of an image; None if there is only one image.
    tile : (int, int)
    """

    width: Float
    height: Float
    ny: UInt
    row: Divisor
    image: Divisor | None
    tile: tuple[int, int]

    @property
    def nx(self) -> UInt:
        """Number of columns of tiles, as Int32."""
        return dr.int32_array_t(self.row.divisor)(self.row.divisor)

    def image_of(self, tile: UInt) -> UInt | None:
        """Return the image of a tile, by its index among all tiles; None for a single image."""
        return None if self.image is None else self.image.divmod(tile)[0]

    def first_pixel(self, tile: UInt) -> tuple[UInt, UInt]:
        """Return the column and the row of the first pixel of a tile in its image, as integers."""
        if self.image is not None:
            tile = self.image.divmod(tile)[1]
        row, column = self.row.divmod(tile)
        return column * self.tile[0], row * self.tile[1]

    def pixel(self, index: UInt) -> tuple[UInt, UInt]:
        """Return the column and the row of a pixel in its image, by its index in tile layout."""
        width, height = self.tile
        column, row = self.first_pixel(index // (width * height))
        return column + index % width, row + index // width % height

    def inside(self, column: Any, row: Any) -> Bool:
        """Return whether a pixel lies in the image, not where a tile overhangs it."""
        return (column < self.width) & (row < self.height)


def tile_columns(
    shape: list, radius: FloatLike, grid: TileLayout, row: UInt, pad: FloatLike = 0.0
) -> tuple[UInt, UInt]:
    """Return the columns `[first, last)` that the ellipse of a Gaussian touches in a row of tiles.

    The ellipse is ``(a dx + b dy)^2 + (c dy)^2 <= radius^2``. At height dy its right edge is
    ``(-b dy + sqrt(radius^2 - c^2 dy^2)) / a``, which is concave in dy with its maximum at
    ``dy* = -b radius / (c sqrt(b^2 + c^2))``. The left edge is the mirror image with its minimum at
    ``-dy*``. Both heights, clamped to the row, give the exact extent in the row.

    Parameters
    ----------
    shape : list of 5 Float
        Mean x, mean y in pixels; a, b, c in 1 / pixels, in the units of `radius`; a > 0, c > 0.
    radius : float
        Cutoff in the units of the factor.
    grid : TileLayout
    row : Int32
        Row of tiles.
    pad : float or Float, optional
        Pixels by which the ellipse is enlarged on every side.

    Returns
    -------
    first, last : Int32
        Clamped to the grid; ``first >= last`` if the ellipse does not touch the row.
    """
    mx, my, a, b, c = shape
    width, height = grid.tile
    top = type(mx)(row * height) + 0.5 - my
    reach = radius * rcp(c) + pad
    low = dr.maximum(top - pad, -reach)
    high = dr.minimum(top + (height - 1) + pad, reach)
    larger = rcp(dr.maximum(dr.abs(b), c))  # b^2 + c^2 may leave the range of floats
    b1, c1 = b * larger, c * larger
    peak = -radius * b1 * rsqrt(dr.fma(b1, b1, c1 * c1)) * rcp(c)

    def half_width(dy: Float) -> Float:
        return dr.safe_sqrt(radius * radius - dr.square(c * dy))

    inverse = rcp(a)
    right = dr.clip(peak, low, high)
    left = dr.clip(-peak, low, high)
    x_right = mx + (half_width(right) - b * right) * inverse + pad
    x_left = mx - (half_width(left) + b * left) * inverse - pad
    columns = type(mx)(grid.nx)
    first = dr.clip(dr.ceil((x_left + 0.5) * (1 / width)) - 1, 0.0, columns)
    last = dr.clip(dr.floor((x_right - 0.5) * (1 / width)) + 1, 0.0, columns)
    hit = (low <= high) & (x_left <= x_right)  # false for NaN as well
    Int = type(row)
    return dr.select(hit, Int(first), 0), dr.select(hit, Int(last), 0)


def tile_rows(
    shape: list, radius: FloatLike, grid: TileLayout, pad: FloatLike = 0.0
) -> tuple[UInt, UInt]:
    """Return the rows of tiles `[first, last)` that the ellipse may touch; see `tile_columns`."""
    Int = types_of(shape[0]).Int
    my, c = shape[1], shape[4]
    height = grid.tile[1]
    reach = radius * rcp(c) + pad
    rows = type(my)(grid.ny)
    first = dr.clip(dr.ceil((my - reach + 0.5) * (1 / height)) - 1, 0.0, rows)
    last = dr.clip(dr.floor((my + reach - 0.5) * (1 / height)) + 1, 0.0, rows)
    finite = dr.isfinite(sum(shape))
    return dr.select(finite, Int(first), 0), dr.select(finite, Int(last), 0)


State = TypeVar("State")
"""The state of a loop: arrays, or lists of them."""


def for_each_row(
    shape: list,
    radius: FloatLike,
    grid: TileLayout,
    visit: Callable[[UInt, UInt, UInt, State], State],
    state: State,
    *,
    pad: FloatLike = 0.0,
    label: str,
) -> State:
    """Call `visit` for every Gaussian and every row of tiles that its ellipse may touch.

    Parameters
    ----------
    shape, radius, grid, pad
        As for `tile_columns`.
    visit : callable
        ``visit(row, first, last, state) -> state`` with the columns ``[first, last)``.
    state : PyTree
        Initial state.
    label : str
        Name of the loop for profilers.

    Returns
    -------
    PyTree
        The final `state`.
    """
    row, stop = tile_rows(shape, radius, grid, pad)

    def body(row: UInt, state: State) -> tuple[UInt, State]:
        first, last = tile_columns(shape, radius, grid, row, pad)
        return row + 1, visit(row, first, last, state)

    return dr.while_loop(
        (row, state), lambda row, state: row < stop, body, label=label, max_iterations=-1
    )[-1]
