"""The sum of Gaussians at scattered points, for the lookups of textures.

The image is divided into cells, and each cell lists the Gaussians whose cutoff ellipse touches it.
The cost of a point depends on the Gaussians near it, not on the size of the set. Virtual function
calls of Dr.Jit do not support custom derivatives, so Dr.Jit's own autodiff gives the gradients with
respect to the packed parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from ...backend.arrays import types_of
from ...backend.types import Bool, Float, Mask, UInt
from ..binning.lists import build_lists
from ..binning.tiles import Grid
from ..evaluate import LN2, weights
from ..parameters import (
    NUM_SHAPE_PARAMS,
    gather_index,
    kernel_radius,
    pack_parameters,
    unpack_parameters,
)

Terms = Callable[[list, list, Float, Float], list]
"""``terms(shape, color, x, y)`` returns what a Gaussian contributes to each sum at a point."""


@dataclass(frozen=True)
class Packed:
    """Parameters of Gaussians, as sums read them.

    Attributes
    ----------
    values : Float
        From `eigengs_dr.raster.parameters.pack_parameters`: 5 of the shape, then the channels; may
        carry gradients.
    channels : int
    cutoff : float
        Standard deviations.
    arranged : Float or None
        Copies in the order of lists, from `in_list_order`, which take the place of `values`.
    """

    values: Float
    channels: int
    cutoff: float
    arranged: Float | None = None

    @property
    def radius(self) -> float:
        """The cutoff in the units of the kernels."""
        return kernel_radius(self.cutoff)

    def gather(self, index: UInt, active: Mask = True) -> tuple[list, list]:
        """Return the shape and the channels of the Gaussians `index`."""
        number = NUM_SHAPE_PARAMS + self.channels
        rows = unpack_parameters(self.values, index, number, active)
        return rows[:NUM_SHAPE_PARAMS], rows[NUM_SHAPE_PARAMS:]

    def gather_all(self) -> tuple[list, list]:
        """Return the shape and the channels of all Gaussians."""
        stride = -(-(NUM_SHAPE_PARAMS + self.channels) // 4) * 4
        return self.gather(dr.arange(types_of(self.values).UInt, dr.width(self.values) // stride))


@dataclass(frozen=True)
class Cells:
    """Indices of the Gaussians that may touch each cell.

    Attributes
    ----------
    grid : Grid
    splat : UInt32, shape (capacity,)
        Indices of Gaussians, cell after cell.
    ends : UInt32, shape (2 * cells,)
        Begin and end in `splat` of the list of each cell.
    """

    grid: Grid
    splat: UInt
    ends: UInt


def cell_side(width: int, height: int, count: int) -> int:
    """Return the side of cells, in pixels: 0.8 times the spacing of Gaussians, as a power of two.

    Cells of half this side save 3 % of the time of a rendering, because their lists hold fewer
    Gaussians that miss the point, but the lists take three times as long to build.
    """
    spacing = math.sqrt(width * height / count)
    return 1 << max(0, round(math.log2(0.8 * spacing)))


def list_cells(shape: list, width: int, height: int, radius: float, side: int) -> Cells:
    """List the Gaussians of every cell of an image.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x, mean y, a, b, c, as for `eigengs_dr.raster.evaluate.weights`.
    width, height : int
        Size of the image, in pixels.
    radius : float
        Cutoff in the units of the factor.
    side : int
        Side of a cell, in pixels.
    """
    grid = Grid(width, height, (side, side))
    # Lists are built for pixel centres; half a pixel of padding makes them valid for all points.
    lists = build_lists(shape, radius, grid, pad=0.5, adjoint=False, ordered=False)
    types = types_of(shape[0])
    ends = dr.empty(types.UInt, 2 * grid.tiles)
    dr.scatter(ends, types.UInt2(lists.begin, lists.end), lists.order)
    dr.eval(lists.splat, ends)
    return Cells(grid, lists.splat, ends)


MAX_ARRANGED = 1 << 20
"""Largest number of entries of lists whose parameters are copied; the copies take 32 MiB, or with
16 channels 96."""


def in_list_order(splat: UInt, rows: list) -> Float | None:
    """Copy parameters to the order of the lists, for lookups without gradients.

    A lookup then reads neighbours in memory and needs no index. The adjoint would be slower, since
    it would add to the copies first.

    Parameters
    ----------
    splat : UInt32
        Entries of `Cells.splat`.
    rows : list of Float, shape (N,)
        One array for each parameter.

    Returns
    -------
    Float, or None
        As from `eigengs_dr.raster.parameters.pack_parameters`, an entry for each of the lists.
        None if there are more than `MAX_ARRANGED`.
    """
    if dr.width(splat) > MAX_ARRANGED:
        return None
    packed = pack_parameters([dr.detach(row) for row in rows])
    return pack_parameters(unpack_parameters(packed, splat, len(rows)))


def fold(x: Float, side: int, wrap: str) -> tuple[Float, Float]:
    """Move a coordinate into the image.

    Parameters
    ----------
    x : Float
        In pixels.
    side : int
        Width or height of the image, in pixels.
    wrap : {"repeat", "mirror", "clamp"}
        Continuation of the image outside its borders. "clamp" repeats the centres of the outermost
        pixels, as Mitsuba's ``bitmap``: further out, Gaussians fall off.

    Returns
    -------
    x : Float
        In [0, side], with "clamp" in [0.5, side - 0.5]; NaN and infinities become 0, or 0.5.
    slope : Float
        The derivative: 1, or -1 in a mirrored copy, or 0 in a clamped part.
    """
    x = dr.select(dr.isfinite(x), x, 0)
    one = type(x)(1)
    if wrap == "clamp":
        first, last = 0.5, side - 0.5
        return dr.clip(x, first, last), dr.select((x >= first) & (x <= last), one, 0)
    period = dr.floor(x * (1 / side))
    # Far from the image, rounding errors exceed its size.
    local = dr.clip(dr.fma(period, -side, x), 0, side)
    if wrap == "repeat":
        return local, one
    odd = dr.fma(-2, dr.floor(0.5 * period), period) == 1
    return dr.select(odd, side - local, local), dr.select(odd, -one, one)


def near_image(x: Float, side: int) -> Float:
    """Move a coordinate near a clamped image, where footprints see what they see further out.

    The longest reach 1.2 sides. What is not finite becomes 0.

    Parameters
    ----------
    x : Float
        In pixels.
    side : int
        Width or height of the image, in pixels.
    """
    return dr.clip(dr.select(dr.isfinite(x), x, 0), -1.5 * side, 2.5 * side)


def cell_range(cells: Cells, x: Float, y: Float, active: Bool) -> tuple[UInt, UInt]:
    """Return begin and end of the list of the cell at a point of the image; else both are 0."""
    types, grid = types_of(x), cells.grid
    # The last cells include the right and the lower border.
    column = dr.minimum(types.UInt(x * (1 / grid.tile[0])), grid.nx - 1)
    row = dr.minimum(types.UInt(y * (1 / grid.tile[1])), grid.ny - 1)
    ends = dr.gather(types.UInt2, cells.ends, row * grid.nx + column, active)
    return ends[0], ends[1]


def sum_at_points(
    cells: Cells,
    packed: Packed,
    x: Float,
    y: Float,
    active: Bool,
    terms: Terms,
    count: int | None = None,
) -> list:
    """Sum the contributions of the Gaussians near a point.

    Cost: one gather of parameters and one call of `terms` for each Gaussian in the list of the
    cell.

    Parameters
    ----------
    cells : Cells
    packed : Packed
    x, y : Float
        In pixels, x to the right and y down; inside the image.
    active : Bool
    terms : callable
        See `Terms`.
    count : int, optional
        Number of sums, by default the number of channels.

    Returns
    -------
    list of `count` Float
    """
    return sum_range(cells.splat, cell_range(cells, x, y, active), packed, x, y, terms, count)


def sum_range(
    index: UInt,
    ends: tuple[UInt, UInt],
    packed: Packed,
    x: Float,
    y: Float,
    terms: Terms,
    count: int | None = None,
) -> list:
    """Sum the Gaussians ``index[begin:end]`` with another range at each point."""
    types = types_of(packed.values)
    ordered = packed.arranged is not None
    source = packed if packed.arranged is None else replace(packed, values=packed.arranged)

    def add(i: UInt, end: UInt, x: Float, y: Float, sums: list) -> tuple:
        here = i < end
        n = i if ordered else gather_index(types, index, i, here)
        parts = terms(*source.gather(n, here), x, y)
        return i + 1, end, x, y, [s + t for s, t in zip(sums, parts, strict=True)]

    # max_iterations=-1 tells Dr.Jit that the loop is a pure sum: its gradient needs no storage.
    return dr.while_loop(
        (*ends, x, y, [types.Float(0) for _ in range(count or packed.channels)]),
        lambda i, end, *rest: i < end,
        add,
        label="sum at points",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def value_terms(radius: float) -> Terms:
    """Return the `Terms` of the values ``c_n w_n(x)``."""

    def terms(shape: list, color: list, x: Float, y: Float) -> list:
        (w,) = weights(shape, x, y, (1, 1), radius)
        return [w * c for c in color]

    return terms


def gradient_terms(radius: float) -> Terms:
    """Return the `Terms` of values and derivatives along x and y: three for each channel.

    ``grad w = -2 ln(2) w F^T F (x - mu)`` with F in the units of the kernels, see
    `eigengs_dr.raster.parameters.EXP2_SCALE`.
    """

    def terms(shape: list, color: list, x: Float, y: Float) -> list:
        mean_x, mean_y, a, b, c = shape
        (w,) = weights(shape, x, y, (1, 1), radius)
        dx, dy = x - mean_x, y - mean_y
        u, v = dr.fma(a, dx, b * dy), c * dy
        steep = -2 * LN2 * w
        along = (w, steep * a * u, steep * dr.fma(b, u, c * v))
        return [k * value for value in color for k in along]

    return terms
