"""The sum over all Gaussians with one lane per tile, and its adjoint with one lane per Gaussian.

``I(x) = background + sum_n c_n w_n(x)`` with the weights of `eigengs_dr.raster.evaluate`.

Tile layout: images are stored tile after tile, within a tile row after row, pixel after pixel,
channel after channel. A lane then reads or writes one contiguous run with packet operations.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend.arrays import ArrayTypes, types_of
from .evaluate import weights, weights_vjp
from .layout import gather_index, gather_run, unpack_parameters
from .parameters import NUM_SHAPE_PARAMS
from .tiles import Grid, TileLists, for_each_tile

# ---------------------------------------------------------------------------------------------
#  Sum over Gaussians, one lane per tile
# ---------------------------------------------------------------------------------------------


def forward(packed: Any, start: list, lists: TileLists, radius: float, tangent: Any = None) -> Any:
    """Sum the Gaussians of every tile: the image, or its derivative along `tangent`.

    ``I_pc = start_c + sum_n w_n(p) c_nc``. Cost per entry of the lists: one gather of parameters
    and ``pixels * (weight + channels)`` operations.

    Parameters
    ----------
    packed : Float
        `NUM_SHAPE_PARAMS` + channels parameters per Gaussian, from `pack_parameters`.
    start : list of Float
        Initial value of each channel: the background.
    lists : TileLists
    radius : float
        Cutoff, see `eigengs_dr.raster.parameters.kernel_radius`.
    tangent : Float, optional
        Packed derivatives of the parameters. The result is then the derivative of the image along
        them, and `start` holds the derivative of the background.

    Returns
    -------
    Float, shape (tiles * pixels * channels,)
        In tile layout.
    """
    types = types_of(packed)
    grid, channels = lists.grid, len(start)
    number = NUM_SHAPE_PARAMS + channels
    x = types.Float(lists.order % grid.nx * grid.tile[0]) + 0.5
    y = types.Float(lists.order // grid.nx * grid.tile[1]) + 0.5

    def contributions(p: list) -> list:
        spread = weights(p[:NUM_SHAPE_PARAMS], x, y, grid.tile, radius)
        return [(w, c) for w in spread for c in p[NUM_SHAPE_PARAMS:]]

    def add(i: Any, sums: list) -> tuple:
        active = i < lists.end
        n = gather_index(types, lists.splat, i, active)
        p = unpack_parameters(packed, n, number, active)
        sums = [dr.fma(w, c, s) for (w, c), s in zip(contributions(p), sums, strict=True)]
        return i + 1, sums

    def add_tangent(i: Any, sums: list) -> tuple:
        active = i < lists.end
        n = gather_index(types, lists.splat, i, active)
        p = unpack_parameters(packed, n, number, active)
        with dr.resume_grad():
            dr.enable_grad(p)
            dr.set_grad(p, unpack_parameters(tangent, n, number, active))
            out = [w * c for w, c in contributions(p)]
            dr.forward_to(out)
            change = dr.grad(out)
        return i + 1, [s + d for s, d in zip(sums, change, strict=True)]

    _, sums = dr.while_loop(
        (types.UInt(lists.begin), [types.Float(b) for _ in range(grid.pixels) for b in start]),
        lambda i, sums: i < lists.end,
        add if tangent is None else add_tangent,
        label="sum splats",
        max_iterations=-1,
    )
    image = dr.empty(types.Float, grid.tiles * grid.pixels * channels)
    dr.scatter(image, types.FloatX(sums), lists.order)
    return image


# ---------------------------------------------------------------------------------------------
#  Adjoint, one lane per Gaussian
# ---------------------------------------------------------------------------------------------


def adjoint(
    packed: Any,
    delta: Any,
    channels: int,
    lists: TileLists,
    radius: float,
    color_only: bool = False,
) -> list:
    """Return the gradient of ``<delta, forward(packed)>`` with respect to all parameters.

    A lane owns a Gaussian, visits the tiles inside its ellipse, gathers delta there and sums in
    registers. Without atomic operations, every run gives the same result.

    Parameters
    ----------
    packed : Float
        As for `forward`.
    delta : Float
        Derivative of a loss with respect to the image, in tile layout.
    channels : int
    lists : TileLists
        Only `grid` and `splat_order` are used.
    radius : float
        As for `forward`.
    color_only : bool, optional
        Omit the derivatives with respect to the shapes.

    Returns
    -------
    list of Float, shape (N,)
        Derivatives with respect to mean x, mean y, a, b, c (unless `color_only`) and the channels.
    """
    types = types_of(packed)
    grid = lists.grid
    splat = unpack_parameters(packed, lists.splat_order, NUM_SHAPE_PARAMS + channels)
    length = grid.pixels * channels

    def add_tile(tile: Any, column: Any, row: Any, active: Any, sums: list) -> list:
        d = gather_run(types, delta, types.UInt(tile), length, active)
        x = types.Float(column * grid.tile[0]) + 0.5
        y = types.Float(row * grid.tile[1]) + 0.5
        color = sums[-channels:]

        def cotangent(k: int, w: Any) -> Any:
            g = type(w)(0)
            for c in range(channels):
                color[c] = dr.fma(w, d[k * channels + c], color[c])
                g = dr.fma(splat[NUM_SHAPE_PARAMS + c], d[k * channels + c], g)
            return g

        if color_only:
            for k, w in enumerate(weights(splat[:NUM_SHAPE_PARAMS], x, y, grid.tile, radius)):
                cotangent(k, w)
            return color
        gradient = weights_vjp(splat[:NUM_SHAPE_PARAMS], x, y, grid.tile, radius, cotangent)
        return [s + g for s, g in zip(sums, gradient, strict=False)] + color

    number = channels if color_only else NUM_SHAPE_PARAMS + channels
    sums = for_each_tile(
        splat[:NUM_SHAPE_PARAMS],
        radius,
        grid,
        add_tile,
        [types.Float(0) for _ in range(number)],
        label="pull back",
    )
    return _restore_order(types, sums, lists.splat_order)


def _restore_order(types: ArrayTypes, sums: list, order: Any) -> list:
    """Undo the permutation of lanes, with packet operations."""
    number, count = len(sums), dr.width(order)
    stride = -(-number // 4) * 4
    packed = dr.empty(types.Float, stride * count)
    dr.scatter(packed, types.FloatX([*sums, *[types.Float(0)] * (stride - number)]), order)
    return unpack_parameters(packed, dr.arange(types.UInt, count), number)


def channel_sums(image: Any, channels: int, grid: Grid) -> list:
    """Sum each channel of an image in tile layout; return a list of Float, shape (1,)."""
    types = types_of(image)
    tile = dr.arange(types.UInt, grid.tiles)
    values = gather_run(types, image, tile, grid.pixels * channels, True)
    return [dr.sum(sum(values[c::channels], types.Float(0))) for c in range(channels)]
