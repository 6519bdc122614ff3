"""Where an added Gaussian would reduce the error most: the peaks of a residual, in tile layout.

A batch of images takes one launch of each kernel, and no pixel sees another image.

A round Gaussian with the weights w and the colour ``c = -<w, g> / <w, h w>`` reduces a loss with
the derivative g by the picture and the curvature h by ``c^2 <w, h w> / 2``. Added Gaussians have
one size, and h hardly changes below them: with h of the pixel, ``<w, h w> = h <w, w>``, c is a blur
of g over h, and the largest reduction is where ``h c^2`` is largest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr

from ...backend.arrays import ArrayTypes, make_divisor
from ...backend.recording import record
from ...backend.types import Float, Rows, UInt
from ...raster.parameters import gather_run
from ...raster.tiles import TILE, Grid, TileLayout
from ..solve import for_channels

SIDE = TILE[0]
"""Width and height of a tile in pixels."""

PIXELS = SIDE * SIDE


@dataclass(frozen=True)
class Canvas:
    """Images in tile layout.

    Attributes
    ----------
    types : ArrayTypes
    grid : Grid
    layout : TileLayout
        Sizes of `grid`: computing them takes microseconds, and many kernels need them.
    """

    types: ArrayTypes
    grid: Grid
    layout: TileLayout

    def sides(self) -> tuple[UInt, UInt]:
        """Return width and height of an image as Int32."""
        return self.types.Int(self.layout.width), self.types.Int(self.layout.height)

    def corner(self, tile: UInt) -> tuple[UInt, UInt]:
        """Return column and row of the first pixel of a tile as Int32."""
        column, row = self.layout.first_pixel(tile)
        return self.types.Int(column), self.types.Int(row)

    def channels(self, image: Float) -> int:
        """Return the number of values of a pixel."""
        return dr.width(image) // (self.grid.tiles * PIXELS)

    def pixels(self, index: UInt) -> tuple[UInt, UInt]:
        """Return column and row as Int32 of pixels, by their index in tile layout."""
        column, row = self.corner(index >> 4)
        return column + self.types.Int(index & 3), row + self.types.Int((index >> 2) & 3)

    def read(self, image: Float, right: int = 0, down: int = 0) -> list:
        """Return the channels of the pixels beside all pixels, 0 outside the image."""
        types, pixel = self.types, dr.arange(self.types.UInt, self.grid.tiles * PIXELS)
        x, y = self.pixels(pixel)
        column, row = x + right, y + down
        width, height = self.sides()
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        tiles = ((row >> 2) - (y >> 2)) * self.layout.nx + (column >> 2) - (x >> 2)
        place = (tiles + types.Int(pixel >> 4)) * PIXELS + (row & 3) * SIDE + (column & 3)
        return gather_run(types, image, types.UInt(place), self.channels(image), inside)

    def store(self, values: list) -> Float:
        """Write the channels of all pixels; return the image, evaluated."""
        number = self.grid.tiles * PIXELS
        result = dr.empty(self.types.Float, number * len(values))
        dr.scatter(result, self.types.FloatX(values), dr.arange(self.types.UInt, number))
        dr.eval(result)
        return result


SIZE = 0.6
"""Standard deviation of an added Gaussian in pixels. The descent adapts its size.
Peaks over three sizes in proportion to the mean spacing take four times as long, and have 0.01 to
0.09 dB less, but 0.05 more with 10,000 Gaussians. 0.4 and 0.9 pixels lose 0.1 to 0.3 dB where
Gaussians are dense (ten training photos of 256x256 pixels, 832 to 10,000 Gaussians, 300 to 3,000
steps)."""

RADIUS = math.ceil(2.5 * SIZE)
"""Pixels up to which the weights reach along an axis; with a third more, peaks gain 0.00 dB."""

REACH = range(-RADIUS, RADIUS + 1)
_WEIGHTS = [math.exp(-0.5 * (k / SIZE) ** 2) for k in REACH]

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

    Cost: three passes over the image, two with 5 products for each value and one with 8 comparisons
    for each pixel; then a sort of the maxima.

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
    x, y = canvas.pixels(place)
    mean = types.Float2(types.Float(x) + 0.5, types.Float(y) + 0.5)
    peaks = Peaks(mean, gather_run(types, colors, place, channels, True), image, rank)
    dr.eval(peaks)
    return peaks


@record
def _maxima(canvas: Canvas, slope: Float, curvature: Float) -> tuple[Float, Float]:
    """Return the best colour of a Gaussian at each pixel, and the reduction where it is a maximum.

    It is 0 at all other pixels, and without its factor ``<w, w> / 2``.
    """
    along = canvas.store(_blurred([canvas.read(slope, right=k) for k in REACH]))
    blurred = _blurred([canvas.read(along, down=k) for k in REACH])
    factors = for_channels(canvas.read(curvature), len(blurred))
    colors = [dr.select(h > 0, b / h, 0) for b, h in zip(blurred, factors, strict=True)]
    gains = canvas.store([sum(c * b for c, b in zip(colors, blurred, strict=True))])
    [center], largest = canvas.read(gains), True
    for k in range(9):
        [other] = canvas.read(gains, k % 3 - 1, k // 3 - 1)
        if k != 4:  # of equal ones, the first is the largest
            largest &= center > other if k < 4 else center >= other
    return canvas.store(colors), canvas.store([dr.select(largest, center, 0)])


def _blurred(near: list) -> list:
    """Return the sums of the channels of pixels in a line, times `TAPS`."""
    total = [v * TAPS[0] for v in near[0]]
    for values, tap in zip(near[1:], TAPS[1:], strict=True):
        total = [dr.fma(v, tap, t) for v, t in zip(values, total, strict=True)]
    return total


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
