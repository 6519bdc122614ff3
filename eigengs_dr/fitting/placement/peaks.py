"""The peaks of an error: where an added Gaussian would reduce it most, in kernels that own tiles.

A round Gaussian with the weights w and the colour ``c = -<w, g> / <w, h w>`` reduces a loss with
the derivative g by the picture and the curvature h by ``c^2 <w, h w> / 2``. Added Gaussians have
one size, and h hardly changes below them: with h of the pixel, ``<w, h w> = h <w, w>``, c is a blur
of g over h, and the largest reduction is where ``h c^2`` is largest.

Images are in tile layout. A batch of images takes one launch of each kernel, and each image has
its own peaks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr

from ...backend.arrays import make_divisor
from ...backend.recording import record
from ...backend.types import Float, Rows, UInt
from ...raster.parameters import gather_run
from .filters import PIXELS, SIDE, Canvas, neighbourhood, radius_of

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
