"""The sum of Gaussians at scattered points, for the lookups of textures.

The image is divided into cells, and each cell lists the Gaussians whose cutoff ellipse touches it.
The cost of a point depends on the Gaussians near it, not on the size of the set. Virtual function
calls of Dr.Jit do not support custom derivatives, so Dr.Jit's own autodiff gives the gradients with
respect to the packed parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...backend.arrays import Bool, Float, UInt, types_of
from ..binning.lists import build_lists
from ..binning.tiles import Grid
from ..evaluate import LN2, weights
from ..parameters import NUM_SHAPE_PARAMS, gather_index, pack_parameters, unpack_parameters


@dataclass(frozen=True)
class Cells:
    """Indices of the Gaussians that may touch each cell.

    Attributes
    ----------
    grid : Grid
        Cells of the image, enlarged by `margin` on every side.
    margin : int
        In pixels.
    splat : UInt32, shape (capacity,)
        Indices of Gaussians, cell after cell.
    ends : UInt32, shape (2 * cells,)
        Begin and end in `splat` of the list of each cell.
    """

    grid: Grid
    margin: int
    splat: Any
    ends: Any


def cell_side(width: int, height: int, count: int) -> int:
    """Return the side of cells, in pixels: 0.8 times the spacing of Gaussians, as a power of two.

    Cells of half this side save 3 % of the time of a rendering, because their lists hold fewer
    Gaussians that miss the point, but the lists take three times as long to build.
    """
    spacing = math.sqrt(width * height / count)
    return 1 << max(0, round(math.log2(0.8 * spacing)))


def list_cells(
    shape: list, width: int, height: int, radius: float, side: int, margin: int = 0
) -> Cells:
    """List the Gaussians of every cell of an image and its margin.

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
    margin : int, optional
        Width of the border around the image that has cells too, in pixels.

    Returns
    -------
    Cells
    """
    grid = Grid(width + 2 * margin, height + 2 * margin, (side, side))
    moved = [shape[0] + margin, shape[1] + margin, *shape[2:]]
    # Lists are built for pixel centres; half a pixel of padding makes them valid for all points.
    lists = build_lists(moved, radius, grid, pad=0.5, adjoint=False)
    types = types_of(shape[0])
    ends = dr.empty(types.UInt, 2 * grid.tiles)
    dr.scatter(ends, types.UInt2(lists.begin, lists.end), lists.order)
    dr.eval(lists.splat, ends)
    return Cells(grid, margin, lists.splat, ends)


MAX_ARRANGED = 1 << 20
"""Largest number of entries of lists whose parameters are copied; the copies take 32 MiB."""


def in_list_order(splat: UInt, rows: list) -> Any:
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


def fold(x: Float, side: int, wrap: str) -> tuple[Any, Any]:
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


def cell_range(cells: Cells, x: Float, y: Float, active: Bool) -> tuple[Any, Any]:
    """Return begin and end of the list of the cell at a point; both are 0 outside the cells."""
    types = types_of(x)
    grid = cells.grid
    column = types.Int(dr.floor((x + cells.margin) * (1 / grid.tile[0])))
    row = types.Int(dr.floor((y + cells.margin) * (1 / grid.tile[1])))
    # The last cells include the right and the lower border.
    column = dr.select(x == grid.width - cells.margin, grid.nx - 1, column)
    row = dr.select(y == grid.height - cells.margin, grid.ny - 1, row)
    inside = active & (column >= 0) & (column < grid.nx) & (row >= 0) & (row < grid.ny)
    ends = dr.gather(types.UInt2, cells.ends, types.UInt(row * grid.nx + column), inside)
    return ends[0], ends[1]


def sum_at_points(
    cells: Cells,
    packed: Float,
    number: int,
    x: Float,
    y: Float,
    active: Bool,
    terms: Callable[[list, Any, Any], list],
    count: int,
    arranged: Float = None,
) -> list:
    """Sum the contributions of the Gaussians near a point.

    Cost: one gather of parameters and one call of `terms` for each Gaussian in the list of the
    cell.

    Parameters
    ----------
    cells : Cells
    packed : Float
        Parameters from `eigengs_dr.raster.parameters.pack_parameters`; may carry gradients.
    number : int
        Number of parameters of one Gaussian.
    x, y : Float
        In pixels, x to the right and y down.
    active : Bool
    terms : callable
        ``terms(parameters, x, y)`` returns the contributions of a Gaussian as a list of Float.
    count : int
        Length of this list.
    arranged : Float, optional
        Parameters from `in_list_order`, which take the place of `packed`.

    Returns
    -------
    list of `count` Float
    """
    ends = cell_range(cells, x, y, active)
    return sum_range(cells.splat, ends, packed, number, x, y, terms, count, arranged)


def sum_range(
    splat: UInt,
    ends: tuple[Any, Any],
    packed: Float,
    number: int,
    x: Float,
    y: Float,
    terms: Callable[[list, Any, Any], list],
    count: int,
    arranged: Float = None,
) -> list:
    """Sum the contributions of the Gaussians ``splat[begin:end]``, as `sum_at_points` does.

    Parameters
    ----------
    splat : UInt32
    ends : tuple of 2 UInt32
        Begin and end of the range of each point.
    packed, number, x, y, terms, count, arranged
        As for `sum_at_points`.
    """
    types = types_of(packed)

    def add(i: UInt, end: Any, x: Float, y: Float, sums: list) -> tuple:
        here = i < end
        if arranged is None:
            source, index = packed, gather_index(types, splat, i, here)
        else:
            source, index = arranged, i
        gaussian = unpack_parameters(source, index, number, here)
        return i + 1, end, x, y, [s + t for s, t in zip(sums, terms(gaussian, x, y), strict=True)]

    # max_iterations=-1 tells Dr.Jit that the loop is a pure sum: its gradient needs no storage.
    return dr.while_loop(
        (*ends, x, y, [types.Float(0) for _ in range(count)]),
        lambda i, end, *rest: i < end,
        add,
        label="sum at points",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def value_terms(radius: float) -> Callable[[list, Any, Any], list]:
    """Return the `terms` of `sum_at_points` for the values ``c_n w_n(x)``."""

    def terms(splat: list, x: Float, y: Float) -> list:
        (w,) = weights(splat[:NUM_SHAPE_PARAMS], x, y, (1, 1), radius)
        return [w * c for c in splat[NUM_SHAPE_PARAMS:]]

    return terms


def gradient_terms(radius: float) -> Callable[[list, Any, Any], list]:
    """Return the `terms` of `sum_at_points` for values and derivatives along x and y.

    Each channel has three terms. ``grad w = -2 ln(2) w F^T F (x - mu)`` with F in the units of the
    kernels, see `eigengs_dr.raster.parameters.EXP2_SCALE`.
    """

    def terms(splat: list, x: Float, y: Float) -> list:
        mean_x, mean_y, a, b, c = splat[:NUM_SHAPE_PARAMS]
        (w,) = weights(splat[:NUM_SHAPE_PARAMS], x, y, (1, 1), radius)
        dx, dy = x - mean_x, y - mean_y
        u, v = dr.fma(a, dx, b * dy), c * dy
        steep = -2 * LN2 * w
        along = (w, steep * a * u, steep * dr.fma(b, u, c * v))
        return [k * color for color in splat[NUM_SHAPE_PARAMS:] for k in along]

    return terms
