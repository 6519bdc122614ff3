"""The value of a sum of Gaussians at scattered points: what a texture is asked for.

The plane of the image is cut into cells, and each cell lists the splats whose cutoff ellipse
touches it, so that a point costs as many splats as overlap near it, however many there are.
Everything here may run inside a virtual function call, where Dr.Jit knows no custom derivatives:
its own autodiff gives gradients with respect to the packed parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...backend.arrays import types_of
from ..evaluate import LN2, weights
from ..layout import gather_index, unpack_parameters
from ..parameters import NUM_SHAPE_PARAMS
from ..tiles import Grid, build_lists


@dataclass(frozen=True)
class Cells:
    """For every cell the splats that may touch it.

    Attributes
    ----------
    grid : Grid
        Of the image and `margin` pixels more on every side.
    margin : int
    splat : UInt32, shape (entries,)
        Indices of splats, cell after cell.
    ends : UInt32, shape (2 cells,)
        Begin and end of the list of each cell in `splat`, one after the other.
    """

    grid: Grid
    margin: int
    splat: Any
    ends: Any


def cell_side(width: int, height: int, count: int) -> int:
    """Side of cells in pixels: 0.8 of the spacing of the splats, as a power of two.

    Half of it lists fewer splats that miss the point, saves 3 % of a rendering, and takes three
    times as long to list.
    """
    spacing = math.sqrt(width * height / count)
    return 1 << max(0, round(math.log2(0.8 * spacing)))


def list_cells(
    shape: list, width: int, height: int, radius: float, side: int, margin: int = 0
) -> Cells:
    """List the splats of every cell of an image and its margin.

    Parameters
    ----------
    shape : list of 5 Float, shape (N,)
        Mean x, mean y and the factor a, b, c, as `eigengs_dr.raster.evaluate.weights` takes them.
    width, height : int
        Of the image, in pixels.
    radius : float
        Cutoff in the units of the factor.
    side : int
        Of a cell, in pixels.
    margin : int, optional
        Pixels around the image that have cells too.
    """
    grid = Grid(width + 2 * margin, height + 2 * margin, (side, side))
    moved = [shape[0] + margin, shape[1] + margin, *shape[2:]]
    # Lists are built for pixel centres; half a pixel more makes them good for all points.
    lists = build_lists(moved, radius, grid, pad=0.5)
    types = types_of(shape[0])
    ends = dr.empty(types.UInt, 2 * grid.tiles)
    dr.scatter(ends, types.UInt2(lists.begin, lists.end), lists.order)
    dr.eval(lists.splat, ends)
    return Cells(grid, margin, lists.splat, ends)


def fold(x: Any, side: int, wrap: str) -> tuple[Any, Any]:
    """Bring a coordinate into the image, as `wrap` says what lies outside.

    Parameters
    ----------
    x : Float
        In pixels.
    side : int
        Of the image.
    wrap : {"repeat", "mirror", "clamp"}

    Returns
    -------
    x : Float
        In [0, side]; NaN and infinities become 0.
    slope : Float
        Its derivative: 1, or -1 where the image is mirrored, or 0 where it is clamped.
    """
    x = dr.select(dr.isfinite(x), x, 0)
    one = type(x)(1)
    if wrap == "clamp":
        return dr.clip(x, 0, side), dr.select((x >= 0) & (x <= side), one, 0)
    period = dr.floor(x * (1 / side))
    local = dr.clip(dr.fma(period, -side, x), 0, side)  # far out, rounding leaves the image
    if wrap == "repeat":
        return local, one
    odd = dr.fma(-2, dr.floor(0.5 * period), period) == 1
    return dr.select(odd, side - local, local), dr.select(odd, -one, one)


def cell_range(cells: Cells, x: Any, y: Any, active: Any) -> tuple[Any, Any]:
    """Begin and end of the list of the cell at a point; both 0 outside the cells."""
    types = types_of(x)
    grid = cells.grid
    column = types.Int(dr.floor((x + cells.margin) * (1 / grid.tile[0])))
    row = types.Int(dr.floor((y + cells.margin) * (1 / grid.tile[1])))
    # The borders of the image belong to it.
    column = dr.select(x == grid.width - cells.margin, grid.nx - 1, column)
    row = dr.select(y == grid.height - cells.margin, grid.ny - 1, row)
    inside = active & (column >= 0) & (column < grid.nx) & (row >= 0) & (row < grid.ny)
    ends = dr.gather(types.UInt2, cells.ends, types.UInt(row * grid.nx + column), inside)
    return ends[0], ends[1]


def sum_at_points(
    cells: Cells,
    packed: Any,
    number: int,
    x: Any,
    y: Any,
    active: Any,
    terms: Callable[[list, Any, Any], list],
    count: int,
) -> list:
    """Sum what the splats near a point contribute there.

    Cost: one gather of the parameters and one call of `terms` for each splat listed.

    Parameters
    ----------
    cells : Cells
    packed : Float
        Parameters of every splat, from `eigengs_dr.raster.layout.pack_parameters`; may carry
        gradients.
    number : int
        Parameters of one splat.
    x, y : Float
        In pixels, x to the right and y down.
    active : Bool
    terms : callable
        ``terms(parameters, x, y)`` returns what a splat contributes.
    count : int
        Number of these values.

    Returns
    -------
    list of `count` Float
    """
    types = types_of(packed)
    begin, end = cell_range(cells, x, y, active)

    def add(i: Any, end: Any, x: Any, y: Any, sums: list) -> tuple:
        here = i < end
        splat = unpack_parameters(packed, gather_index(types, cells.splat, i, here), number, here)
        return i + 1, end, x, y, [s + t for s, t in zip(sums, terms(splat, x, y), strict=True)]

    # A pure sum, which "-1" tells Dr.Jit: its gradient needs no storage.
    return dr.while_loop(
        (begin, end, x, y, [types.Float(0) for _ in range(count)]),
        lambda i, end, *rest: i < end,
        add,
        label="sum at points",
        mode="symbolic",
        max_iterations=-1,
    )[-1]


def value_terms(radius: float) -> Callable[[list, Any, Any], list]:
    """Terms of the sum itself: ``c_n w_n(x)``; see `sum_at_points`."""

    def terms(splat: list, x: Any, y: Any) -> list:
        (w,) = weights(splat[:NUM_SHAPE_PARAMS], x, y, (1, 1), radius)
        return [w * c for c in splat[NUM_SHAPE_PARAMS:]]

    return terms


def gradient_terms(radius: float) -> Callable[[list, Any, Any], list]:
    """Terms of the sum and of its derivatives along x and y, three for every channel.

    ``grad w = -2 ln(2) w F^T F (x - mu)``, with F in units of
    `eigengs_dr.raster.evaluate.EXP2_SCALE`.
    """

    def terms(splat: list, x: Any, y: Any) -> list:
        mean_x, mean_y, a, b, c = splat[:NUM_SHAPE_PARAMS]
        (w,) = weights(splat[:NUM_SHAPE_PARAMS], x, y, (1, 1), radius)
        dx, dy = x - mean_x, y - mean_y
        u, v = dr.fma(a, dx, b * dy), c * dy
        steep = -2 * LN2 * w
        along = (w, steep * a * u, steep * dr.fma(b, u, c * v))
        return [k * color for color in splat[NUM_SHAPE_PARAMS:] for k in along]

    return terms
