"""A slow renderer with the derivatives of Dr.Jit."""

from __future__ import annotations

import drjit as dr

from eigengs_dr.backend.arrays import types_of
from eigengs_dr.backend.types import Float, UInt
from eigengs_dr.raster.evaluate import weights
from eigengs_dr.raster.lists import TileLists
from eigengs_dr.raster.parameters import EXP2_SCALE, NUM_SHAPE_PARAMS, kernel_radius


def render_plain(values: list, background: list, lists: TileLists, cutoff: float = 3.0) -> Float:
    """Render with one lane per pixel and Dr.Jit's own derivatives.

    Cost per pixel: the list of its tile, with one gather per parameter, and in reverse mode
    one atomic addition per parameter.

    Parameters
    ----------
    values : list of Float, shape (N,)
        Mean x, mean y, a, b, c in pixels and 1 / pixels, then the channels.
    background : list of Float
    lists : TileLists
    cutoff : float, optional
        Standard deviations.

    Returns
    -------
    Float, shape (height * width * channels,)
        Pixels row after row.
    """
    types = types_of(values[0])
    grid = lists.grid
    pixel = dr.arange(types.UInt, grid.width * grid.height)
    column, row = pixel % grid.width, pixel // grid.width
    x, y = types.Float(column) + 0.5, types.Float(row) + 0.5
    slot = _slots(lists, types.UInt, column // grid.tile[0] + row // grid.tile[1] * grid.nx)
    begin, end = dr.gather(types.UInt, lists.begin, slot), dr.gather(types.UInt, lists.end, slot)
    scaled = [
        *values[:2],
        *[v * EXP2_SCALE for v in values[2:NUM_SHAPE_PARAMS]],
        *values[NUM_SHAPE_PARAMS:],
    ]

    def add(i: UInt, sums: list) -> tuple:
        active = i < end
        n = dr.gather(types.UInt, lists.splat, i, active)
        p = [dr.gather(types.Float, v, n, active) for v in scaled]
        (w,) = weights(p[:NUM_SHAPE_PARAMS], x, y, (1, 1), kernel_radius(cutoff))
        return i + 1, [dr.fma(w, c, s) for c, s in zip(p[NUM_SHAPE_PARAMS:], sums, strict=True)]

    _, sums = dr.while_loop(
        (types.UInt(begin), [types.Float(0) for _ in background]),
        lambda i, sums: i < end,
        add,
        label="plain",
        max_iterations=-1,
    )
    return dr.ravel(types.FloatX([s + b for s, b in zip(sums, background, strict=True)]), order="F")


def _slots(lists: TileLists, kind: type[UInt], tile: UInt) -> UInt:
    """Return the positions of tiles in `TileLists.order`."""
    slot = dr.empty(kind, lists.grid.tiles)
    dr.scatter(slot, dr.arange(kind, lists.grid.tiles), lists.order)
    return dr.gather(kind, slot, tile)
