"""Filters of images in tile layout, and the peaks of an error, in kernels that own pixels or tiles.

A batch of images takes one launch of each kernel, and no pixel sees another image.

A round Gaussian with the weights w and the colour ``c = -<w, g> / <w, h w>`` reduces a loss with
the derivative g by the picture and the curvature h by ``c^2 <w, h w> / 2``. Added Gaussians have
one size, and h hardly changes below them: with h of the pixel, ``<w, h w> = h <w, w>``, c is a blur
of g over h, and the largest reduction is where ``h c^2`` is largest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

import drjit as dr

from ...backend.arrays import ArrayTypes, make_divisor
from ...backend.recording import record
from ...backend.types import Bool, Float, Rows, UInt
from ...raster.binning.tiles import TILE, Grid, GridArrays
from ...raster.parameters import gather_run

SIDE = TILE[0]
"""Width and height of a tile in pixels."""

PIXELS = SIDE * SIDE

TRUNCATION = 2.5
"""Radius of the weights along an axis, in standard deviations; with 3, peaks gain 0.00 dB."""

State = TypeVar("State")
Number = TypeVar("Number", Float, UInt, covariant=True)


class Line(Protocol[Number]):
    """The rows of an array, of floats or of integers."""

    def __len__(self) -> int: ...
    def __getitem__(self, row: int, /) -> Number: ...


@dataclass(frozen=True)
class Canvas:
    """Images in tile layout.

    Attributes
    ----------
    types : ArrayTypes
    grid : Grid
    sizes : GridArrays
        Sizes of `grid`: computing them takes microseconds, and many kernels need them.
    """

    types: ArrayTypes
    grid: Grid
    sizes: GridArrays

    @classmethod
    def of(cls, types: ArrayTypes, grid: Grid) -> Canvas:
        """Return the images of a grid."""
        return cls(types, grid, grid.in_arrays(types))

    @property
    def tile(self) -> UInt:
        """Lanes that own a tile each."""
        return dr.arange(self.types.UInt, self.grid.tiles)

    def sides(self) -> tuple[UInt, UInt]:
        """Return width and height of an image as Int32."""
        return self.types.Int(self.sizes.width), self.types.Int(self.sizes.height)

    def corner(self, tile: UInt) -> tuple[UInt, UInt]:
        """Return column and row of the first pixel of a tile as Int32."""
        column, row = self.sizes.first_pixel(tile)
        return self.types.Int(column), self.types.Int(row)

    def channels(self, image: Float | UInt) -> int:
        """Return the number of values of a pixel."""
        return dr.width(image) // (self.grid.tiles * PIXELS)

    def first_tile(self, image: UInt | None) -> UInt:
        """Return the first tile of an image, which is None if there is only one."""
        if image is None or self.sizes.image is None:
            return self.types.UInt(0)
        return image * self.sizes.image.divisor

    def place(self, first: UInt, x: UInt, y: UInt) -> UInt:
        """Return the index in tile layout of a pixel of the image with the tile `first`."""
        tile = self.types.UInt((y >> 2) * self.sizes.nx + (x >> 2)) + first
        return tile * PIXELS + self.types.UInt((y & 3) * SIDE + (x & 3))

    def pixels(self, index: UInt | None = None) -> tuple[UInt, UInt, UInt, Bool]:
        """Return column, row, first tile of the image, and whether it is inside, for pixels.

        The pixels have an index in tile layout, by default all: a lane owns a pixel.
        """
        if index is None:
            index = dr.arange(self.types.UInt, self.grid.tiles * PIXELS)
        tile = index >> 4
        column, row = self.corner(tile)
        column += self.types.Int(index & 3)
        row += self.types.Int((index >> 2) & 3)
        width, height = self.sides()
        inside = (column < width) & (row < height)
        return column, row, self.first_tile(self.sizes.image_of(tile)), inside

    def store(self, values: list[Number]) -> Number:
        """Write the values of all tiles, listed by pixels and channels; return the image."""
        result = dr.empty(type(values[0]), self.grid.tiles * len(values))
        rows = dr.replace_type_t(self.types.FloatX, dr.type_v(result))
        dr.scatter(result, rows(values), self.tile)
        return result


def neighbourhood(canvas: Canvas, image: Float, margin: int) -> list:
    """Return the pixels of each tile and those around it; a lane owns a tile.

    Parameters
    ----------
    image : Float, shape (pixels * channels,)
        In tile layout.
    margin : int
        Pixels around the tile, at most 4.

    Returns
    -------
    list of list of Float
        Rows of values by columns and channels, 0 where the image has no tile.
    """
    types, channels, tile = canvas.types, canvas.channels(image), canvas.types.Int(canvas.tile)
    (x, y), (width, height) = canvas.corner(canvas.tile), canvas.sides()
    rows = []
    for k in range(-margin, SIDE + margin):
        above, inner = divmod(k, SIDE)
        there = (y + above * SIDE >= 0) & (y + above * SIDE < height)
        row: list = []
        for beside in (-1, 0, 1):
            inside = there & (x + beside * SIDE >= 0) & (x + beside * SIDE < width)
            run = types.UInt((tile + above * canvas.sizes.nx + beside) * SIDE + inner)
            row += gather_run(types, image, run, SIDE * channels, inside)
        rows.append(row[(SIDE - margin) * channels : (2 * SIDE + margin) * channels])
    return rows


def downsampled(canvas: Canvas, image: Float, small: Canvas, times: int) -> Float:
    """Return the means over squares of `times` x `times` pixels as images of `small`; evaluated."""
    types, channels = canvas.types, canvas.channels(image)
    x, y, first, _ = small.pixels()
    if small.sizes.image is not None:
        first = canvas.first_tile(small.sizes.image_of(first))
    side, (width, height) = dr.opaque(types.Int, times), canvas.sides()

    def add(i: UInt, j: UInt, number: Float, sums: list) -> tuple:
        column, row = x * side + i, y * side + j
        inside = (column < width) & (row < height)
        values = gather_run(types, image, canvas.place(first, column, row), channels, inside)
        sums = [s + v for s, v in zip(sums, values, strict=True)]
        number = number + dr.select(inside, types.Float(1), 0)
        ends = i + 1 == side
        return dr.select(ends, 0, i + 1), dr.select(ends, j + 1, j), number, sums

    number, sums = dr.while_loop(
        (types.Int(0), types.Int(0), types.Float(0), [types.Float(0)] * channels),
        lambda i, j, number, sums: j < side,
        add,
        label="shrink",
        max_iterations=-1,
    )[2:]
    means = [s / dr.maximum(number, 1) for s in sums]
    result = dr.empty(types.Float, dr.width(x) * channels)
    dr.scatter(result, types.FloatX(means), dr.arange(types.UInt, dr.width(x)))
    dr.eval(result)
    return result


def scan(
    canvas: Canvas,
    source: Float | UInt,
    axis: int,
    tiles: UInt,
    visit: Callable[[list, UInt, UInt, Bool, State], State],
    state: State,
    label: str,
) -> State:
    """Visit the tiles around each tile along an axis; return the last state. A lane owns a tile.

    Images alternate between the layout of tiles by rows and by columns: with the first axis the
    tiles of `source` must be stored by columns, with the second by rows. The pixels of a line
    across the axis are then neighbours in memory.

    Parameters
    ----------
    source : Float or Int, shape (pixels * channels,)
    axis : int
        0 for tiles of a row, 1 for those of a column.
    tiles : Int32, shape (1,)
        Largest distance of a tile.
    visit : callable
        ``visit(lines, distance, first, state) -> state`` with the 4 lines of pixels of a tile, each
        an array of 4 pixels after another; the distance of the tile in pixels; the coordinate of
        its first line; and whether there is such a tile.
    """
    types, side = canvas.types, canvas.sides()[axis]
    tile = types.Int(canvas.tile)
    here = canvas.corner(canvas.tile)[axis]
    step = (1, canvas.sizes.nx)[axis]
    length = SIDE * canvas.channels(source)
    kind = dr.int32_array_t(types.FloatX) if dr.is_integral_v(source) else types.FloatX

    def look(distance: UInt, state: State) -> tuple[UInt, State]:
        first = here + distance * SIDE
        inside = (first >= 0) & (first < side)
        start = (tile + distance * step) * SIDE
        lines = [
            dr.gather(kind, source, types.UInt(start + k), inside, shape=(length, dr.width(tile)))
            for k in range(SIDE)
        ]
        return distance + 1, visit(lines, distance * SIDE, first, inside, state)

    return dr.while_loop(
        (types.Int(-tiles), state),
        lambda distance, state: distance <= tiles,
        look,
        label=label,
        max_iterations=-1,
    )[1]


def turned(canvas: Canvas, lines: list[Line[Number]]) -> Number:
    """Store lines from `scan`, tiles by columns if they were by rows, and vice versa; evaluated."""
    channels = len(lines[0]) // SIDE
    values = [
        line[n * channels + c] for n in range(SIDE) for line in lines for c in range(channels)
    ]
    result = canvas.store(values)
    dr.eval(result)
    return result


def radius_of(deviation: float) -> int:
    """Return the radius of the weights of a Gaussian with a standard deviation, in pixels."""
    return max(1, math.ceil(TRUNCATION * deviation))


def smoothed(canvas: Canvas, image: Float, deviation: float) -> Float:
    """Return the means of the pixels around each pixel, by Gaussian weights; evaluated.

    The weights along an axis are ``2^(slope k^2)``, k up to a radius in pixels; both numbers are
    arrays, so that one program serves all deviations. Only pixels of the image count: near its
    edges, means are over those inside the window.

    Cost for each axis, and each tile within the radius: a gather of the tile, 7 exponentials, and 4
    products for each value.

    Parameters
    ----------
    image : Float, shape (pixels * channels,)
        In tile layout, 0 outside the image.
    deviation : float
        Standard deviation in pixels.

    Returns
    -------
    Float, shape (pixels * channels,)
        Outside the image, any finite numbers.
    """
    types = canvas.types
    slope = dr.opaque(types.Float, -0.5 / (math.log(2) * deviation**2))
    radius = dr.opaque(types.Int, radius_of(deviation))
    tiles = (radius + SIDE - 1) // SIDE
    length = SIDE * canvas.channels(image)
    for axis in (1, 0):
        end = canvas.sides()[axis]

        def add(
            lines: list, distance: UInt, first: UInt, inside: Bool, state: tuple, end: UInt = end
        ) -> tuple:
            sums, totals = list(state[0]), list(state[1])
            weight = []
            for offset in range(1 - SIDE, SIDE):
                away = distance + offset
                near = dr.exp2(slope * dr.square(types.Float(away)))
                weight.append(dr.select(dr.abs(away) <= radius, near, 0))
            for k in range(SIDE):
                counts = inside & (first + k < end)
                for row in range(SIDE):
                    w = weight[k - row + SIDE - 1]
                    sums[row] = dr.fma(w, lines[k], sums[row])
                    totals[row] = totals[row] + dr.select(counts, w, 0)
            return sums, totals

        zeros = [dr.zeros(types.FloatX, (length, 1)) for _ in range(SIDE)]
        start = zeros, [types.Float(0) for _ in range(SIDE)]
        sums, totals = scan(canvas, image, axis, tiles, add, start, "blur")
        inverse = (dr.select(t > 0, dr.rcp(t), 0) for t in totals)
        image = turned(canvas, [s * i for s, i in zip(sums, inverse, strict=True)])
    return image


def squared_hessian(canvas: Canvas, image: Float, noise: float) -> tuple[Float, Float]:
    """Return ``sum_c H_c H_c`` of images plus isotropic noise; evaluated.

    Second derivatives are differences of neighbours; an image continues with the pixels of its
    edges. A lane owns the 4 pixels of a row of a tile.

    Parameters
    ----------
    image : Float, shape (pixels * channels,)
        In tile layout.
    noise : float
        Added to xx and to yy.

    Returns
    -------
    energy : Float, shape (pixels * 3,)
        The entries xx, yy and xy in tile layout, 0 outside the image.
    trace : Float, shape (pixels,)
        ``xx + yy``.
    """
    types, sizes, channels = canvas.types, canvas.sizes, canvas.channels(image)
    length = SIDE * channels
    lane = dr.arange(types.UInt, canvas.grid.tiles * SIDE)
    width, height = canvas.sides()
    column, row = canvas.corner(lane >> 2)
    inner = types.Int(lane & 3)
    row += inner

    def load(step: int) -> list:
        """Return the values of 6 pixels: those of its row, or of the row above or below."""
        source = types.Int(lane) + step
        if step:
            leaves = inner == (0 if step < 0 else SIDE - 1)
            source += dr.select(leaves, (sizes.nx - 1) * (SIDE * step), 0)
        there = (row + step >= 0) & (row + step < height)
        values: list = []
        for side in (-SIDE, 0, SIDE):
            inside = there & (column + side >= 0) & (column + side < width)
            index = types.UInt(source + side)
            shape = (length, dr.width(lane))
            values += list(dr.gather(types.FloatX, image, index, inside, shape=shape))
        values = values[length - channels : 2 * length + channels]
        for k in range(2 * channels, len(values)):
            inside = column + (k // channels - 1) < width
            values[k] = dr.select(inside, values[k], values[k - channels])
        for k in range(channels):
            values[k] = dr.select(column > 0, values[k], values[k + channels])
        return values

    FloatX = types.FloatX
    middle_row = load(0)
    above = list(dr.select(row > 0, FloatX(load(-1)), FloatX(middle_row)))
    below = list(dr.select(row + 1 < height, FloatX(load(1)), FloatX(middle_row)))
    (up_left, up, up_right), (left, middle, right), (down_left, down, down_right) = (
        [FloatX(v[k * channels : k * channels + length]) for k in range(3)]
        for v in (above, middle_row, below)
    )
    # Differences of neighbours first: those of close floats are exact.
    xx, yy = (right - middle) - (middle - left), (down - middle) - (middle - up)
    xy = 0.25 * ((down_right - down_left) - (up_right - up_left))
    square = dr.square(xy)
    products = dr.square(xx) + square, dr.square(yy) + square, xy * (xx + yy)
    base = dr.opaque(types.Float, noise)
    energy, trace = [], []
    for k in range(SIDE):
        inside = (column + k < width) & (row < height)
        sums = [sum(list(p)[k * channels : (k + 1) * channels]) for p in products]
        own_energy = [sums[0] + base, sums[1] + base, sums[2]]
        energy += [dr.select(inside, e, 0) for e in own_energy]
        trace.append(dr.select(inside, own_energy[0] + own_energy[1], 0))
    arrays = [dr.empty(types.Float, dr.width(lane) * len(v)) for v in (energy, trace)]
    for array, values in zip(arrays, (energy, trace), strict=True):
        dr.scatter(array, FloatX(values), lane)
    dr.eval(arrays)
    return arrays[0], arrays[1]


SIZE = 0.6
"""Standard deviation of an added Gaussian in pixels. The descent adapts its size.
Peaks over three sizes in proportion to the mean spacing take four times as long, and have 0.01 to
0.09 dB less, but 0.05 more with 10,000 Gaussians. 0.4 and 0.9 pixels lose 0.1 to 0.3 dB where
Gaussians are dense (ten training photos of 256x256 pixels, 832 to 10,000 Gaussians, 300 to 3,000
steps)."""

RADIUS = radius_of(SIZE)

_WEIGHTS = [math.exp(-0.5 * (k / SIZE) ** 2) for k in range(-RADIUS, RADIUS + 1)]

TAPS = [w / sum(v * v for v in _WEIGHTS) for w in _WEIGHTS]
"""The weights along an axis, divided by the sum of their squares: they give the colour c."""


class Peaks(NamedTuple):
    """Places and colours of added Gaussians: image after image, the best first.

    Attributes
    ----------
    mean : Array2f, shape (n, 2)
        In pixels: centres of pixels.
    color : list of Float, shape (n,)
        Best colours, by channels.
    image, rank : UInt32, shape (n,)
        The image, and the place of the peak among those of its image.
    """

    mean: Rows
    color: list
    image: UInt
    rank: UInt


def residual_peaks(canvas: Canvas, slope: Float, curvature: Float, count: int) -> Peaks:
    """Find where added round Gaussians of the size `SIZE` would reduce a loss most.

    These are the pixels whose reduction is the largest of 3x3 pixels, and the best of them.

    Cost: a pass over the image with 240 products for each channel of a tile, and another with 8
    comparisons for each pixel; then a sort of the maxima.

    Parameters
    ----------
    canvas : Canvas
    slope : Float, shape (pixels * channels,)
        Minus the derivative of the loss by the picture in tile layout, 0 outside the image.
    curvature : Float, shape (pixels,) or (pixels * channels,)
        The curvature in tile layout, 0 outside the image, of pixels or of their channels. Where it
        is 0, nothing is added.
    count : int
        Largest number of peaks of an image.

    Returns
    -------
    Peaks
    """
    types, channels = canvas.types, canvas.channels(slope)
    colors, maxima = _maxima(canvas, slope, curvature)
    place = dr.compress(maxima > 0)
    place, image, rank = _ranked(place, maxima, canvas, count)
    if not dr.width(place):  # Dr.Jit does not compute with empty arrays
        none = types.Float()
        return Peaks(types.Float2(none, none), [none] * channels, place, place)
    x, y, *_ = canvas.pixels(place)
    mean = types.Float2(types.Float(x) + 0.5, types.Float(y) + 0.5)
    peaks = Peaks(mean, gather_run(types, colors, place, channels, True), image, rank)
    dr.eval(peaks)
    return peaks


@record
def _maxima(canvas: Canvas, slope: Float, curvature: Float) -> tuple[Float, Float]:
    """Return the best colour of a Gaussian at each pixel, and the reduction where it is a maximum.

    It is 0 at all other pixels, and without its factor ``<w, w> / 2``.
    """
    channels, values = canvas.channels(slope), canvas.channels(curvature)
    blurred = _blurred(neighbourhood(canvas, slope, RADIUS), channels)
    factors = gather_run(canvas.types, curvature, canvas.tile, PIXELS * values, True)
    factors = [factors[k * values // channels] for k in range(PIXELS * channels)]
    colors = [dr.select(h > 0, b / h, 0) for b, h in zip(blurred, factors, strict=True)]
    terms = [c * b for c, b in zip(colors, blurred, strict=True)]
    gains = [sum(terms[n * channels : (n + 1) * channels]) for n in range(PIXELS)]
    arrays = canvas.store(colors), canvas.store(gains)
    dr.eval(arrays)
    rows = neighbourhood(canvas, arrays[1], 1)
    maxima = canvas.store([_if_maximum(rows, n % SIDE + 1, n // SIDE + 1) for n in range(PIXELS)])
    dr.eval(maxima)
    return arrays[0], maxima


def _blurred(rows: list, channels: int) -> list:
    """Return the weighted sums around the pixels of a tile: along rows, then along columns."""

    def weighted(values: list) -> Float:
        total = values[0] * TAPS[0]
        for value, tap in zip(values[1:], TAPS[1:], strict=True):
            total = dr.fma(value, tap, total)
        return total

    number, width = len(TAPS), SIDE * channels
    along = [[weighted(row[i::channels][:number]) for i in range(width)] for row in rows]
    return [
        weighted([r[i] for r in along[y : y + number]]) for y in range(SIDE) for i in range(width)
    ]


def _if_maximum(rows: list, x: int, y: int) -> Float:
    """Return a value if it is the largest of 3x3, or the first of equal ones; 0 otherwise."""
    center, largest = rows[y][x], True
    for k in range(9):
        other = rows[y + k // 3 - 1][x + k % 3 - 1]
        if k != 4:
            largest &= center > other if k < 4 else center >= other
    return dr.select(largest, center, 0)


def _ranked(place: UInt, gain: Float, canvas: Canvas, count: int) -> tuple[UInt, UInt, UInt]:
    """Return the best `count` places of each image by falling gain, their images and ranks."""
    types, grid, number = canvas.types, canvas.grid, dr.width(place)
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
