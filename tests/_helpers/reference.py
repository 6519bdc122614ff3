"""Slow reference renderers."""

from __future__ import annotations

import drjit as dr
import numpy as np

from eigengs_dr.backend.arrays import types_of
from eigengs_dr.backend.types import Float, UInt
from eigengs_dr.raster.binning.lists import TileLists
from eigengs_dr.raster.evaluate import weights
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


def render_exact(
    mean: np.ndarray,
    factor: np.ndarray,
    color: np.ndarray,
    background: np.ndarray,
    width: int,
    height: int,
    cutoff: float = np.inf,
) -> np.ndarray:
    """Sum all Gaussians at all pixels in float64, without tiles, by default without a cutoff.

    Cost: ``N * width * height`` exponentials.

    Parameters
    ----------
    mean : ndarray, shape (N, 2)
        In pixels.
    factor : ndarray, shape (N, 3)
        a, b, c of ``F = [[a, b], [0, c]]``, in 1 / pixels.
    color : ndarray, shape (N, C)
    background : ndarray, shape (C,)
    width, height : int
    cutoff : float, optional
        Standard deviations.

    Returns
    -------
    ndarray of float64, shape (height, width, C)
    """
    x = np.arange(width) + 0.5
    y = (np.arange(height) + 0.5)[:, None]
    image = np.tile(np.asarray(background, np.float64), (height, width, 1))
    for (mx, my), (a, b, c), value in zip(
        mean.astype(np.float64), factor.astype(np.float64), color.astype(np.float64), strict=True
    ):
        q = (a * (x - mx) + b * (y - my)) ** 2 + (c * (y - my)) ** 2
        image += np.where(q <= cutoff**2, np.exp(-0.5 * q), 0.0)[..., None] * value
    return image
