"""The sum over all Gaussians, and its error: one lane per block of rows of a tile.

``I(x) = background + sum_n c_n w_n(x)`` with the weights of `eigengs_dr.raster.evaluate`.

Tile layout: images are stored tile after tile, within a tile row after row, pixel after pixel,
channel after channel. A lane then reads or writes one contiguous run with packet operations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import drjit as dr

from ..backend.arrays import ArrayTypes, in_pairs, types_of
from ..backend.types import Float, UInt
from .evaluate import weights
from .lists import TileLists
from .parameters import NUM_SHAPE_PARAMS, gather_index, gather_run, unpack_parameters
from .tiles import Grid, granularity_of


class _Blocks(NamedTuple):
    """The rows of tiles that each lane owns.

    Attributes
    ----------
    run : UInt32
        Index of the block in tile layout: the block holds the pixels
        ``[run * pixels, (run + 1) * pixels)``.
    tile : UInt32
    x, y : Float
        Centre of the first pixel.
    begin, end : UInt32
        Range of the list of the tile.
    size : (int, int)
        Width and height of a block.
    """

    run: UInt
    tile: UInt
    x: Float
    y: Float
    begin: UInt
    end: UInt
    size: tuple[int, int]

    @property
    def pixels(self) -> int:
        return self.size[0] * self.size[1]


def _blocks(types: ArrayTypes, lists: TileLists) -> _Blocks:
    """Divide every tile into blocks of `Granularity.rows` rows, one for each lane."""
    width, _ = lists.grid.tile
    rows, parts = shares_of(types, lists.grid)
    tile, begin, end, part = lists.order, lists.begin, lists.end, types.UInt(0)
    if parts > 1:  # neighbouring lanes share a tile, and together write a contiguous run
        lane = dr.arange(types.UInt, lists.grid.tiles * parts)
        part = lane % parts
        tile, begin, end = (dr.gather(types.UInt, v, lane // parts) for v in (tile, begin, end))
    column, row = lists.layout.first_pixel(tile)
    x, y = types.Float(column) + 0.5, types.Float(row + part * rows) + 0.5
    return _Blocks(tile * parts + part, tile, x, y, begin, end, (width, rows))


def shares_of(types: ArrayTypes, grid: Grid) -> tuple[int, int]:
    """Return the number of rows of a block, and the number of blocks of a tile."""
    rows = math.gcd(granularity_of(types).rows, grid.tile[1])
    return rows, grid.tile[1] // rows


def _sum_blocks(
    packed: Float,
    start: list,
    lists: TileLists,
    blocks: _Blocks,
    radius: float,
    tangent: Float | None = None,
) -> list:
    """Sum the Gaussians of every block; return a list of Float, pixels times channels.

    Cost per entry of the lists: one gather of parameters; for a block of 4x4 pixels also 7
    exponentials, 60 operations for the weights and the cutoff, and one fma per pixel and channel.
    """
    types = types_of(packed)
    number = NUM_SHAPE_PARAMS + len(start)
    image = lists.layout.image_of(blocks.tile)
    if image is not None:
        start = [dr.gather(types.Float, b, image) for b in start]

    def contributions(p: list, exact_exp: bool) -> list:
        shape, color = p[:NUM_SHAPE_PARAMS], p[NUM_SHAPE_PARAMS:]
        pixel_weights = weights(shape, blocks.x, blocks.y, blocks.size, radius, exact_exp)
        return [(w, c) for w in pixel_weights for c in color]

    def run(exact_exp: bool, begin: UInt, end: UInt, sums: list) -> list:
        def gather(i: UInt, source: Float) -> list:
            active = i < end
            n = gather_index(types, lists.splat, i, active)
            return unpack_parameters(source, n, number, active)

        def add(i: UInt, sums: list) -> tuple:
            terms = contributions(gather(i, packed), exact_exp)
            return i + 1, [dr.fma(w, c, s) for (w, c), s in zip(terms, sums, strict=True)]

        def add_tangent(i: UInt, sums: list) -> tuple:
            assert tangent is not None
            p = gather(i, packed)
            with dr.resume_grad():
                dr.enable_grad(p)
                dr.set_grad(p, gather(i, tangent))
                out = [w * c for w, c in contributions(p, True)]
                dr.forward_to(out)
                change = dr.grad(out)
            return i + 1, [s + d for s, d in zip(sums, change, strict=True)]

        return dr.while_loop(
            (types.UInt(begin), sums),
            lambda i, sums: i < end,
            add if tangent is None else add_tangent,
            label="sum splats",
            max_iterations=-1,
        )[-1]

    sums = [types.Float(b) for _ in range(blocks.pixels) for b in start]
    runs = lists.runs(blocks.begin, blocks.end)
    for exact_exp, begin, end in runs if tangent is None else [(True, blocks.begin, blocks.end)]:
        sums = run(exact_exp, begin, end, sums)
    return sums


def forward(
    packed: Float, start: list, lists: TileLists, radius: float, tangent: Float | None = None
) -> Float:
    """Sum the Gaussians of every tile: the image, or its derivative along `tangent`.

    ``I_pc = start_c + sum_n w_n(p) c_nc``.

    Parameters
    ----------
    packed : Float
        `NUM_SHAPE_PARAMS` + channels parameters per Gaussian, from `pack_parameters`.
    start : list of Float, shape (1,) or (images,)
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
    blocks = _blocks(types, lists)
    sums = _sum_blocks(packed, start, lists, blocks, radius, tangent)
    image = dr.empty(types.Float, lists.grid.tiles * lists.grid.pixels * len(start))
    dr.scatter(image, types.FloatX(sums), blocks.run)
    return image


def image_of(packed: Float, start: list, lists: TileLists, radius: float) -> Float:
    """Return `forward`, evaluated by itself: one program for all that need the image."""
    dr.eval(packed, start)
    image = forward(packed, start, lists, radius)
    dr.eval(image)
    return image


def residual(
    packed: Float,
    start: list,
    lists: TileLists,
    radius: float,
    target: Float | None,
    curvature: Float | None = None,
    pairs: bool = False,
) -> tuple[Float, list]:
    """Sum the Gaussians of every tile, and compare them with an image, in one pass over memory.

    With the error ``e = I - T`` and the curvature h of a pixel, the results are ``h e``, the
    derivative of ``1/2 sum h e^2`` with respect to I, and the sums of ``h e^2``. The error is 0 in
    the parts of tiles outside the image.

    Parameters
    ----------
    packed, start, lists, radius
        As for `forward`.
    target : Float or None
        Image T in tile layout; None for 0.
    curvature : Float, optional
        Factors h in tile layout, one for each pixel or for each channel of it; by default 1.
    pairs : bool, optional
        Whether delta is stored by `in_pairs`, if it is in single precision. A descent does: the
        adjoint reads half the memory, and a fit takes about 5 % less time.

    Returns
    -------
    delta : Float, shape (tiles * pixels * channels,), or UInt32 of half that shape
        ``h e`` in tile layout.
    squares : list of Float, shape (lanes,)
        For each channel, the sums of ``h e^2`` over the pixels of each lane; `sum_lanes` adds them.
    """
    types = types_of(packed)
    grid, channels = lists.grid, len(start)
    blocks = _blocks(types, lists)
    sums = _sum_blocks(packed, start, lists, blocks, radius)

    inside = None
    if grid.overhangs:
        (width, height), layout = blocks.size, lists.layout
        places = ((blocks.x + i, blocks.y + j) for j in range(height) for i in range(width))
        inside = [layout.inside(*place) for place in places]

    def load(image: Float) -> list:
        values = dr.width(image) // (grid.tiles * grid.pixels)
        return gather_run(types, image, blocks.run, blocks.pixels * values, True)

    deltas, squares = _compared(sums, channels, load, target, curvature, inside)
    number = grid.tiles * grid.pixels * channels
    if pairs and types.bits == 32:
        delta = dr.empty(types.UInt, number // 2)
        dr.scatter(delta, dr.uint32_array_t(types.FloatX)(in_pairs(types, deltas)), blocks.run)
        return delta, squares
    delta = dr.empty(types.Float, number)
    dr.scatter(delta, types.FloatX(deltas), blocks.run)
    return delta, squares


def difference(
    image: Float, lists: TileLists, target: Float | None, curvature: Float | None = None
) -> tuple[Float, list]:
    """Compare an image from `image_of` with another one, as `residual` does.

    A lane owns a row of pixels of a tile, whose values it reads and writes in packets.

    Returns
    -------
    delta : Float, shape (tiles * pixels * channels,)
    squares : list of Float, shape (images,)
        For each channel, the sums of ``h e^2`` over the pixels of each image.
    """
    types, grid = types_of(image), lists.grid
    (length, height), number = grid.tile, grid.tiles * grid.pixels
    row, channels = dr.arange(types.UInt, grid.tiles * height), dr.width(image) // number

    def load(values: Float) -> list:
        return gather_run(types, values, row, length * (dr.width(values) // number), True)

    inside = None
    if grid.overhangs:
        column, line = lists.layout.pixel(row * length)
        inside = [lists.layout.inside(column + i, line) for i in range(length)]
    deltas, squares = _compared(load(image), channels, load, target, curvature, inside)
    delta = dr.empty(types.Float, number * channels)
    dr.scatter(delta, types.FloatX(deltas), row)
    dr.eval(delta, squares)  # together: later, the sums would read all again
    return delta, [sum_by_image(s, grid) for s in squares]


def _compared(
    errors: list,
    channels: int,
    load: Callable[[Float], list],
    target: Float | None,
    curvature: Float | None,
    inside: list | None,
) -> tuple[list, list]:
    """Return ``h e`` for the values of a lane, and the sums of ``h e^2`` for each channel.

    `load` reads what a lane owns of an image; `inside` says which of its pixels are in the image.
    """
    if target is not None:
        errors = [e - t for e, t in zip(errors, load(target), strict=True)]
    if inside is not None:
        errors = [dr.select(inside[k // channels], e, 0) for k, e in enumerate(errors)]
    deltas = errors
    if curvature is not None:
        factors = load(curvature)
        share = len(errors) // len(factors)
        deltas = [e * factors[k // share] for k, e in enumerate(errors)]
    return deltas, sum_channels([e * d for e, d in zip(errors, deltas, strict=True)], channels)


def pixels_inside(types: ArrayTypes, grid: Grid) -> Float:
    """Return 1 for pixels inside the images and 0 for overhanging pixels, in tile layout."""
    layout = grid.in_arrays(types)
    pixel = layout.pixel(dr.arange(types.UInt, grid.tiles * grid.pixels))
    return dr.select(layout.inside(*pixel), types.Float(1), 0)


def sum_lanes(values: list, lists: TileLists) -> list:
    """Add the values of the lanes of `residual` for each image; return Floats of shape (images,).

    Summation is in the order of tiles, not of lanes, so that a sum does not depend on other images.
    """
    run = _blocks(types_of(values[0]), lists).run
    rows = [dr.empty(type(v), dr.width(v)) for v in values]
    for row, v in zip(rows, values, strict=True):
        dr.scatter(row, v, run)
    return [sum_by_image(row, lists.grid) for row in rows]


def sum_by_image(values: Float, grid: Grid) -> Float:
    """Add the values of each image; return a Float of shape (images,)."""
    if grid.images == 1:
        return dr.sum(values)
    return dr.block_sum(values, dr.width(values) // grid.images)


def spread(values: Float, image: UInt | None) -> Float:
    """Return the value of the image of each entry; `image` is None if there is only one."""
    return values if image is None else dr.gather(type(values), values, image)


def channel_sums(image: Float, channels: int, grid: Grid) -> list:
    """Sum each channel of images in tile layout; return a list of Float, shape (images,).

    In double precision, so that sums over large images are accurate.
    """
    types, tiles = types_of(image), dr.arange(types_of(image).UInt, grid.tiles)
    values = gather_run(types, image, tiles, grid.pixels * channels, True)
    sums = [dr.float64_array_t(types.Float)(v) for v in sum_channels(values, channels)]
    dr.eval(sums)  # one kernel for all
    return [types.Float(sum_by_image(v, grid)) for v in sums]


def sum_channels(values: list, channels: int) -> list:
    """Add the values of the pixels of a block, pixel after pixel, for each channel."""
    return [sum(values[c::channels], type(values[0])(0)) for c in range(channels)]
