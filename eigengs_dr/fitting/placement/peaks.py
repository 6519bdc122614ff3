"""The peaks of an error: where an added Gaussian would reduce it most, in kernels that own pixels.

A round Gaussian with the weights w, of the standard deviation s, and with the best colour
``<w, r> / <w, w>`` reduces the squared error of the residual r by the gain ``<w, r>^2 / <w, w>``.
Along one axis the weights are ``exp(-k^2 / (2 s^2))`` for the offsets k, so ``<w, r>`` is a blur
along columns and then along rows, and ``<w, w>`` is the square of ``T = sum_k exp(-k^2 / s^2)``.

Images are in tile layout. A lane owns a tile, or a run: the 4 pixels of a row of a tile. A batch of
images takes one launch of each kernel, and each image has peaks of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from ...backend.arrays import ArrayTypes, Bool, Float, UInt, make_divisor, types_of
from ...backend.recording import record
from ...raster.binning.tiles import TILE, Grid, GridArrays
from ...raster.parameters import gather_run
from .filters import TRUNCATION, Canvas, Weights, radius_of, weighted_sums

CANDIDATE_SIZES = (0.2, 0.4, 0.8)
"""Candidate sizes of an added Gaussian, as multiples of the mean spacing. Five from 0.2 to 1.6 take
two and a half times as long, and gain -0.03 to 0.03 dB (16 crops of 128x128 and 9 training photos
of 256x256 pixels, 200 to 1,000 steps)."""

SUPPRESSION_RADIUS = 1.5
"""Distance from an added Gaussian to a worse one, in standard deviations of the added one."""

WORKING_SPACING = 3.0
"""Pixels between Gaussians for the search. An image with twice this spacing or more is shrunk
first: wide weights take long, and the descent moves Gaussians by a pixel at once."""

RUN, ROWS = TILE


class Peaks(NamedTuple):
    """Round Gaussians that would reduce the error most: image after image, the best first.

    Attributes
    ----------
    mean : Array2f, shape (n, 2)
        In pixels.
    size : Float, shape (n,)
        Standard deviations in pixels.
    color : list of Float, shape (n,)
        Best colours, by channels.
    image, rank : UInt32, shape (n,)
        The image, and the place of the peak among those of its image.
    """

    mean: Float
    size: Float
    color: list
    image: UInt
    rank: UInt


@dataclass(frozen=True)
class _Runs:
    """The runs of an image, one for each lane.

    Attributes
    ----------
    sizes : GridArrays
    column, row : Int32
        The column of the tile, and the row of the pixels in their image.
    first : Int32
        The index of the first run of the image.
    """

    sizes: GridArrays
    column: UInt
    row: UInt
    first: UInt

    def at(self, column: UInt, row: UInt, first: UInt) -> tuple[UInt, Bool]:
        """Return the index in tile layout of the run in a place, and whether there is one."""
        inside = (column >= 0) & (column < self.sizes.nx)
        inside &= (row >= 0) & (row < self.sizes.ny * ROWS)
        tile = row // ROWS * self.sizes.nx + column
        return dr.uint32_array_t(row)(first + tile * ROWS + row % ROWS), inside

    def of(self, place: UInt) -> tuple[UInt, UInt, UInt]:
        """Return column and row of pixels by their indices, and `first` of their images."""
        lane = place // RUN
        column, row, first = (
            dr.gather(type(v), v, lane) for v in (self.column, self.row, self.first)
        )
        return column * RUN + type(column)(place % RUN), row, first


def _runs(types: ArrayTypes, grid: Grid) -> _Runs:
    sizes, lane = grid.in_arrays(types), dr.arange(types.UInt, grid.tiles * ROWS)
    tile = lane // ROWS
    column, row = (types.Int(v) for v in sizes.first_pixel(tile))
    first = _first_run(types, grid, sizes.image_of(tile)) + dr.zeros(types.Int, dr.width(lane))
    return _Runs(sizes, column // RUN, row + types.Int(lane % ROWS), first)


def _first_run(types: ArrayTypes, grid: Grid, image: UInt) -> UInt:
    """Return the index of the first run of an image; the image is None if there is only one."""
    if image is None:
        return types.Int(0)
    return types.Int(image) * dr.opaque(types.Int, grid.nx * grid.ny * ROWS)


def residual_peaks(
    missed: Float,
    grid: Grid,
    channels: int,
    count: int,
    spacing: float,
    squares: Float = None,
) -> Peaks:
    """Find where added round Gaussians would reduce the squared error most.

    The function finds the maxima of the gain over positions and `CANDIDATE_SIZES`, leaves out
    those inside the `SUPPRESSION_RADIUS` of a better one, and returns the best of the others.

    Cost: for a size, two passes over the image with as many products a value as the weights have
    offsets; then a window of the largest radius for each maximum.

    Parameters
    ----------
    missed : Float, shape (pixels * channels,)
        Residual r in tile layout, 0 outside the image.
    grid : Grid
    channels : int
    count : int
        Largest number of peaks of an image.
    spacing : float
        Mean distance between Gaussians in pixels.
    squares : Float, optional
        Factors of the squares of the errors in tile layout, by default 1.

    Returns
    -------
    Peaks
    """
    types, times = types_of(missed), int(spacing / WORKING_SPACING)
    if times > 1:
        side = -(-grid.width // times), -(-grid.height // times)
        small = Grid(*side, images=grid.images)
        missed, squares = (
            None if v is None else shrunk(v, grid, small, channels, times)
            for v in (missed, squares)
        )
        peaks = residual_peaks(missed, small, channels, count, spacing / times, squares)
        if not dr.width(peaks.size):
            return peaks
        # The last pixels of the small image may lie over the edge.
        last = types.Float2(*(dr.opaque(types.Float, v - 0.5) for v in (grid.width, grid.height)))
        mean = dr.minimum(peaks.mean * times, last)
        return peaks._replace(mean=mean, size=peaks.size * times)
    runs = _runs(types, grid)
    candidates = [_candidate(types, share * spacing) for share in CANDIDATE_SIZES]
    gain, size, top = _gain_map(missed, squares, candidates, runs, grid, channels)
    place = dr.compress(top > 0)
    if dr.width(place):
        reach = math.ceil(SUPPRESSION_RADIUS * CANDIDATE_SIZES[-1] * spacing)
        place = _apart(place, top, size, runs, reach)
    place, image, rank = _ranked(place, gain, grid, count)
    if not dr.width(place):  # Dr.Jit does not compute with no elements
        none = types.Float()
        return Peaks(types.Float2(none, none), none, [none] * channels, place, place)
    column, row, _ = runs.of(place)
    mean = types.Float2(types.Float(column) + 0.5, types.Float(row) + 0.5)
    size = dr.gather(types.Float, size, place)
    peaks = Peaks(mean, size, _colors(missed, place, size, runs, channels), image, rank)
    dr.eval(peaks)
    return peaks


def _ranked(place: UInt, gain: Float, grid: Grid, count: int) -> tuple[UInt, UInt, UInt]:
    """Return the best `count` places of each image by falling gain, their images and ranks."""
    types, number = types_of(gain), dr.width(place)
    if not number:
        return place, place, place
    order = dr.argsort(-dr.gather(types.Float, gain, place))
    place = dr.gather(types.UInt, place, order)
    rank, image = dr.arange(types.UInt, number), dr.zeros(types.UInt, number)
    if grid.images > 1:
        image, _ = make_divisor(types, grid.tiles * grid.pixels // grid.images).divmod(place)
        order = dr.argsort(image)
        place, image = (dr.gather(types.UInt, v, order) for v in (place, image))
        sums = dr.zeros(types.UInt, grid.images)
        dr.scatter_add(sums, types.UInt(1), image)
        rank -= dr.gather(types.UInt, dr.prefix_sum(sums), image)
    first = dr.compress(rank < dr.opaque(types.UInt, count))
    if not dr.width(first):
        return first, first, first
    place, image, rank = (dr.gather(types.UInt, v, first) for v in (place, image, rank))
    return place, image, rank


def shrunk(values: Float, grid: Grid, small: Grid, channels: int, times: int) -> Float:
    """Return the means over squares of pixels of images in tile layout; evaluated."""
    types, side = types_of(values), dr.opaque(types_of(values).Int, times)
    runs, large = _runs(types, small), _runs(types, grid)
    place = dr.arange(types.UInt, small.tiles * small.pixels)
    x, y, _ = runs.of(place)
    first = _first_run(types, grid, runs.sizes.image_of(place // small.pixels))
    width, height = (types.Int(v) for v in (large.sizes.width, large.sizes.height))

    def add(i: UInt, j: UInt, number: Float, sums: list) -> tuple:
        column, row = x * side + i, y * side + j
        at, _ = large.at(column // RUN, row, first)
        inside = (column < width) & (row < height)
        start = (at * RUN + type(at)(column % RUN)) * channels
        sums = [s + dr.gather(types.Float, values, start + c, inside) for c, s in enumerate(sums)]
        ends = i + 1 == side
        number = number + dr.select(inside, types.Float(1), 0)
        return dr.select(ends, 0, i + 1), dr.select(ends, j + 1, j), number, sums

    number, sums = dr.while_loop(
        (types.Int(0), types.Int(0), types.Float(0), [types.Float(0)] * channels),
        lambda i, j, number, sums: j < side,
        add,
        label="shrink",
        max_iterations=-1,
    )[2:]
    result = dr.empty(types.Float, small.tiles * small.pixels * channels)
    means = [s / dr.maximum(number, 1) for s in sums]
    dr.scatter(result, types.FloatX(means), dr.arange(types.UInt, dr.width(x)))
    dr.eval(result)
    return result


@dataclass(frozen=True)
class _Candidate:
    """An added Gaussian of one size; all arrays have the shape (1,).

    Attributes
    ----------
    weights : Weights
    size : Float
        Standard deviation in pixels.
    inverse : Float
        One over the sum of the squares of all its weights.
    """

    weights: Weights
    size: Float
    inverse: Float


def _candidate(types: ArrayTypes, deviation: float) -> _Candidate:
    reach = radius_of(deviation)
    offsets = np.arange(-reach, reach + 1)
    own = float(np.exp(-np.square(offsets / deviation)).sum()) ** 2
    size, inverse = (dr.opaque(types.Float, v) for v in (deviation, 1 / own))
    return _Candidate(Weights.of(types, deviation), size, inverse)


@record
def _gain_map(
    missed: Float,
    squares: Float,
    candidates: list[_Candidate],
    runs: _Runs,
    grid: Grid,
    channels: int,
) -> tuple[Float, Float, Float]:
    """Return for each pixel the largest gain, its size, and the gain again if it is a maximum."""
    types = types_of(missed)
    best = tuple(dr.zeros(types.Float, grid.tiles * grid.pixels) for _ in range(2))
    dr.make_opaque(best)
    for candidate in candidates:
        best = _better(missed, squares, candidate, best, runs.sizes, grid, channels)
    return *best, _local_maxima(best[0], runs)


def _better(
    missed: Float,
    squares: Float,
    candidate: _Candidate,
    best: tuple[Float, ...],
    sizes: GridArrays,
    grid: Grid,
    channels: int,
) -> tuple[Float, ...]:
    """Return gain and size of the better of the best so far and a size, for each pixel."""
    types, length = types_of(missed), grid.pixels * channels
    tile = dr.arange(types.UInt, grid.tiles)
    sums = weighted_sums(Canvas(types, grid, sizes), missed, candidate.weights)
    sums = gather_run(types, sums, tile, length, True)
    factors = [1.0] * length
    if squares is not None:
        factors = gather_run(types, squares, tile, length, True)
    terms = [dr.square(p) * f * candidate.inverse for p, f in zip(sums, factors, strict=True)]
    x, y = (types.Float(v) for v in sizes.first_pixel(tile))
    gains, found = (gather_run(types, v, tile, grid.pixels, True) for v in best)
    for n in range(grid.pixels):
        gain = sum(terms[n * channels : (n + 1) * channels])
        better = (gain > gains[n]) & (x + n % RUN < sizes.width) & (y + n // RUN < sizes.height)
        gains[n] = dr.select(better, gain, gains[n])
        found[n] = dr.select(better, candidate.size, found[n])
    result = tuple(dr.empty(types.Float, dr.width(v)) for v in best)
    for array, values in zip(result, (gains, found), strict=True):
        dr.scatter(array, types.FloatX(values), tile)
    dr.eval(result)
    return result


def _local_maxima(gain: Float, runs: _Runs) -> Float:
    """Return the gain where it is the largest of 3x3 pixels, and 0 elsewhere; evaluated."""
    types = types_of(gain)
    rows = []
    for step in (-1, 0, 1):
        values: list = []
        for tile in (-1, 0, 1):
            at, inside = runs.at(runs.column + tile, runs.row + step, runs.first)
            values += gather_run(types, gain, at, RUN, inside)
        rows.append(values[RUN - 1 : 2 * RUN + 1])
    across = [dr.maximum(dr.maximum(a, b), c) for a, b, c in zip(*rows, strict=True)]
    tops = []
    for i in range(RUN):
        largest = dr.maximum(dr.maximum(across[i], across[i + 1]), across[i + 2])
        own = rows[1][i + 1]
        tops.append(dr.select(own == largest, own, 0))
    result = dr.empty(types.Float, dr.width(gain))
    dr.scatter(result, types.FloatX(tops), dr.arange(types.UInt, dr.width(runs.row)))
    dr.eval(result)
    return result


def _apart(place: UInt, top: Float, size: Float, runs: _Runs, reach: int) -> UInt:
    """Return the maxima that no better maximum within its own radius suppresses."""
    types = types_of(top)
    own = dr.gather(types.Float, top, place)

    def look(at: UInt, inside: Bool, x: list, y: UInt, is_best: Bool) -> Bool:
        gains, sizes = (gather_run(types, v, at, RUN, inside) for v in (top, size))
        for k in range(RUN):
            away = types.Float(dr.maximum(dr.abs(x[k]), dr.abs(y)))
            near = away <= dr.ceil(SUPPRESSION_RADIUS * sizes[k])
            before = (gains[k] > own) | ((gains[k] == own) & (at * RUN + k < place))
            is_best &= ~(inside & near & before)
        return is_best

    limit = dr.opaque(types.Int, reach)
    is_best = _for_each_run(place, limit, runs, look, types.Bool(True), "keep peaks apart")
    return dr.gather(types.UInt, place, dr.compress(is_best))


def _colors(missed: Float, place: UInt, size: Float, runs: _Runs, channels: int) -> list:
    """Return the best colours ``<w, r> / <w, w>`` of round Gaussians at some pixels."""
    types = types_of(missed)
    reach = dr.maximum(types.Int(dr.ceil(TRUNCATION * size)), 1)
    slope = -0.5 / math.log(2) * dr.square(dr.rcp(size))

    def add(at: UInt, inside: Bool, x: list, y: UInt, sums: list) -> list:
        values = gather_run(types, missed, at, RUN * channels, inside)
        *along, own = sums
        for k in range(RUN):
            weight = dr.exp2(slope * types.Float(dr.square(x[k]) + dr.square(y)))
            weight = dr.select(dr.abs(x[k]) <= reach, weight, 0)
            own = dr.fma(weight, weight, own)
            along = [dr.fma(weight, values[k * channels + c], s) for c, s in enumerate(along)]
        return [*along, own]

    zeros = [types.Float(0)] * (channels + 1)
    *along, own = _for_each_run(place, reach, runs, add, zeros, "find colours")
    return [s / own for s in along]


def _for_each_run(
    place: UInt, reach: UInt, runs: _Runs, visit: Callable[..., Any], state: Any, label: str
) -> Any:
    """Call `visit` for the runs within a radius of pixels, row by row; return the last state.

    It is ``visit(at, inside, x, y, state) -> state`` with the index of the run, whether there is
    one, and the distances of its pixels by columns, a list, and by rows.
    """
    Int = type(reach)
    column, row, start = runs.of(place)
    # A quotient of Dr.Jit rounds towards 0, and the window may begin left of the image.
    first, last = (column + (RUN - 1) * reach) // RUN - reach, (column + reach) // RUN

    def body(i: UInt, j: UInt, state: Any) -> tuple:
        at, inside = runs.at(i, j, start)
        x = [i * RUN + (k - column) for k in range(RUN)]
        state = visit(at, inside & (j <= row + reach), x, j - row, state)
        ends = i >= last
        return dr.select(ends, first, i + 1), dr.select(ends, j + 1, j), state

    return dr.while_loop(
        (Int(first), Int(row - reach), state),
        lambda i, j, state: j <= row + reach,
        body,
        label=label,
        max_iterations=-1,
    )[-1]
