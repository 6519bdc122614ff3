"""The adjoint of the sum over all Gaussians: one lane per piece of a Gaussian."""

from __future__ import annotations

import drjit as dr

from ..backend.arrays import types_of
from ..backend.types import Float, FloatLike, Mask, UInt
from .evaluate import weights, weights_vjp
from .kernels import shares_of
from .lists import Pieces, TileLists
from .parameters import NUM_SHAPE_PARAMS, gather_index, gather_run, unpack_parameters
from .tiles import granularity_of


def adjoint(
    packed: Float,
    delta: Float,
    channels: int,
    lists: TileLists,
    radius: float,
    color_only: bool = False,
    factors: Float | None = None,
) -> list:
    """Return the gradient of ``<delta, forward(packed)>`` with respect to all parameters.

    Each lane owns a piece of a Gaussian, visits its tiles, gathers delta there and accumulates in
    registers; `sum_pieces` adds the pieces. There are no atomic operations, so that every run
    gives the same result.

    Parameters
    ----------
    packed : Float
        As for `forward`.
    delta : Float
        Derivative of a loss with respect to the image, in tile layout; or from `in_pairs`.
    channels : int
    lists : TileLists
        With pieces.
    radius : float
        As for `forward`.
    color_only : bool, optional
        Omit the derivatives with respect to the shapes.
    factors : Float, optional
        One or more images f in tile layout. With `color_only`, the derivatives are followed by the
        products ``<f, w^2>`` of each image with the squared weights.

    Returns
    -------
    list of Float, shape (N,)
        Derivatives with respect to mean x, mean y, a, b, c (unless `color_only`) and the channels.
    """
    assert lists.pieces is not None, "the lists were built without adjoint=True"
    number = channels + (_images_in(factors, lists) if color_only else NUM_SHAPE_PARAMS)
    parts = adjoint_pieces(packed, delta, channels, lists, radius, color_only, factors)
    return sum_pieces(parts, lists.pieces, number)


def _images_in(factors: Float | None, lists: TileLists) -> int:
    """Return the number of images in the factors of `adjoint`."""
    return 0 if factors is None else dr.width(factors) // (lists.grid.tiles * lists.grid.pixels)


def adjoint_pieces(
    packed: Float,
    delta: Float,
    channels: int,
    lists: TileLists,
    radius: float,
    color_only: bool = False,
    factors: Float | None = None,
) -> Float:
    """Return the packed sums of every piece, for `sum_pieces`; parameters as for `adjoint`.

    A lane owns the same rows of all tiles of its piece, see `Granularity.rows`. Cost per visit to
    4x4 pixels: one gather of delta, 7 exponentials, and per pixel 2 operations for the weight, 2
    for the cutoff, 2 per channel and 5 for the shape.
    """
    types = types_of(packed)
    layout, pieces, tile_size = lists.layout, lists.pieces, lists.grid.tile
    assert pieces is not None
    rows, shares = shares_of(types, lists.grid)
    fields = [pieces.splat, pieces.begin, pieces.end, pieces.slot]
    part = types.UInt(0)
    if shares > 1:  # neighbouring lanes visit the same tiles, and together read a contiguous run
        lane = dr.arange(types.UInt, dr.width(pieces.slot) * shares)
        part, owner = lane % shares, lane // shares
        fields = [dr.gather(types.UInt, v, owner) for v in fields]
    index, begin, end, slot = fields
    splat = unpack_parameters(packed, index, NUM_SHAPE_PARAMS + channels)
    shape, block = splat[:NUM_SHAPE_PARAMS], (tile_size[0], rows)
    length, images = block[0] * rows, _images_in(factors, lists)

    def add_tile(exact_exp: bool, end: UInt, i: UInt, sums: list) -> tuple:
        active = i < end
        tile = gather_index(types, pieces.tile, i, active)
        d = gather_run(types, delta, tile * shares + part, length * channels, active)
        column, row = layout.first_pixel(tile)
        x, y = types.Float(column) + 0.5, types.Float(row + part * rows) + 0.5
        color = sums[-channels - images :][:channels]

        def cotangent(k: int, w: Float) -> FloatLike:
            g = type(w)(0)
            for c in range(channels):
                color[c] = dr.fma(w, d[k * channels + c], color[c])
                g = dr.fma(splat[NUM_SHAPE_PARAMS + c], d[k * channels + c], g)
            return g

        if color_only:
            products, f = sums[channels:], []
            if factors is not None:
                f = gather_run(types, factors, tile * shares + part, length * images, active)
            for k, w in enumerate(weights(shape, x, y, block, radius, exact_exp)):
                cotangent(k, w)
                square = dr.square(w)
                products = [dr.fma(square, f[k * images + n], s) for n, s in enumerate(products)]
            return i + 1, color + products
        gradient = weights_vjp(shape, x, y, block, radius, cotangent, exact_exp)
        return i + 1, [s + g for s, g in zip(sums, gradient, strict=False)] + color

    def run(exact_exp: bool, begin: UInt, end: UInt, sums: list) -> list:
        return dr.while_loop(
            (types.UInt(begin), sums),
            lambda i, sums: i < end,
            lambda i, sums: add_tile(exact_exp, end, i, sums),
            label="pull back",
            max_iterations=-1,
        )[-1]

    number = channels + (images if color_only else NUM_SHAPE_PARAMS)
    sums = [types.Float(0) for _ in range(number)]
    for exact_exp, first, last in lists.runs(begin, end):
        sums = run(exact_exp, first, last, sums)
    stride = -(-number // 4) * 4
    parts = dr.empty(types.Float, stride * shares * dr.width(pieces.slot))
    values = [*sums, *[types.Float(0)] * (stride - number)]
    dr.scatter(parts, types.FloatX(values), slot * shares + part)
    return parts


def sum_pieces(parts: Float, pieces: Pieces, number: int, splat: UInt | None = None) -> list:
    """Add the results of the pieces of every Gaussian, in the order of the pieces.

    On a GPU, blocks of pieces are added first, see `Granularity.block`.

    Parameters
    ----------
    parts : Float
        From `adjoint_pieces`.
    pieces : Pieces
    number : int
        Number of derivatives of a Gaussian.
    splat : UInt32, optional
        Indices of Gaussians, by default all. Gaussians that are not in the lists have the sum 0.

    Returns
    -------
    list of `number` Float
    """
    types = types_of(parts)
    count = dr.width(pieces.first)
    known: Mask = True
    if splat is None:
        splat = dr.arange(types.UInt, count)
    else:
        known = splat < count
    begin = dr.gather(types.UInt, pieces.first, splat, known)
    end = begin + dr.gather(types.UInt, pieces.number, splat, known)
    slots, stride = dr.width(pieces.slot), -(-number // 4) * 4
    length = dr.width(parts) // slots  # number of results of all lanes of a piece

    def add(source: Float, first: UInt, last: UInt, sums: list) -> list:
        """Add the results `[first, last)` of pieces or of blocks."""

        def add_one(i: UInt, sums: list) -> tuple:
            values = gather_run(types, source, i, length, i < last)
            return i + 1, [sum(values[k::stride], s) for k, s in enumerate(sums)]

        totals: list = dr.while_loop(
            (types.UInt(first), sums),
            lambda i, sums: i < last,
            add_one,
            label="sum pieces",
            max_iterations=-1,
        )[-1]
        return totals

    sums, block = [types.Float(0) for _ in range(number)], granularity_of(types).block
    if not block or slots < block:
        return add(parts, begin, end, sums)
    # The pieces before the blocks that a Gaussian fills alone, these blocks, and the pieces after.
    blocks = _sum_blocks(parts, slots // block, block, stride, length // stride)
    first, last = (begin + (block - 1)) // block, end // block
    fills = first < last
    sums = add(parts, begin, dr.select(fills, first * block, end), sums)
    sums = add(blocks, first, last, sums)
    return add(parts, dr.select(fills, last * block, end), end, sums)


def _sum_blocks(parts: Float, number: int, block: int, stride: int, shares: int) -> Float:
    """Add the results of blocks of neighbouring pieces, in the layout of `adjoint_pieces`.

    Parameters
    ----------
    parts : Float
        From `adjoint_pieces`.
    number : int
        Number of blocks.
    block : int
        Number of pieces in a block.
    stride : int
        Number of results of a lane.
    shares : int
        Number of lanes of a piece.
    """
    types = types_of(parts)
    lane = dr.arange(types.UInt, number * shares)
    start = (lane // shares) * (block * shares) + lane % shares

    def add(i: UInt, sums: list) -> tuple:
        values = gather_run(types, parts, start + i * shares, stride, i < block)
        return i + 1, [s + v for s, v in zip(sums, values, strict=True)]

    sums = dr.while_loop(
        (types.UInt(0), [types.Float(0) for _ in range(stride)]),
        lambda i, sums: i < block,
        add,
        label="sum blocks",
        max_iterations=-1,
    )[-1]
    blocks = dr.empty(types.Float, stride * shares * number)
    dr.scatter(blocks, types.FloatX(sums), lane)
    dr.eval(blocks)
    return blocks
