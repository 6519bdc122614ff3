"""SSIM as a Dr.Jit operation: the value and its derivatives, by blurs along one axis at a time.

With the blur B by the window of a pixel, SSIM is a function of four local means,

``s = (2 m_x m_y + C1) (2 v_xy + C2) / ((m_x^2 + m_y^2 + C1) (v + C2))``

with ``m_x = B x``, ``m_y = B y``, ``v_xy = B(x y) - m_x m_y`` and
``v = B(x^2 + y^2) - m_x^2 - m_y^2``. The derivative of a sum of s follows from the transpose of B:

``ds/dx = B^T(ds/dm_x) + 2 x B^T(ds/dB(x^2 + y^2)) + y B^T(ds/dB(x y))``

Blurs are along lines: the columns or the rows of a channel. A lane computes `BLOCK` neighbouring
values of a line, from these and those within the radius. It writes a run: `BLOCK` values of each
plane, contiguous in memory. If the next blur is along the other axis, neighbouring lanes read
adjacent values of runs, so that memory accesses are contiguous for both axes. No two lanes write to
the same location.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import numpy as np

from ..backend.arrays import (
    ArrayTypes,
    gather_run,
    make_divisor,
    rcp,
    types_in,
    types_of,
    upload,
)
from ..backend.entry_points import entry_point
from ..backend.selection import select
from ..backend.types import Bool, Doubles, Float, Tensor, UInt, Values
from .pixels import C1, C2, is_tensor

BLOCK = 8
"""Number of values of a line that a lane computes. With 16 it reads a quarter less, but the values
do not fit into the registers of a CPU: value and derivative took twice the time."""

PLANES = 4
"""Largest number of planes that are blurred at once."""


@entry_point
def similarity(
    a: Tensor | Values, b: Tensor | Values, weight: Tensor | Values | None, taps: Doubles
) -> Float:
    """Compute the mean SSIM of two pictures; differentiable with respect to both, in both modes.

    Value and derivative take 4 programs, whose costs are documented at their functions. They need
    memory for 7 planes of the size of a picture, or 10 with derivatives with respect to both. In
    single precision the error of the value is 1e-6 for photos and up to 1e-4 for flat pictures,
    where variances cancel.

    Parameters
    ----------
    a, b : Dr.Jit tensor or ndarray of floats, shape (H, W, C)
        At least one is a tensor. Values are not clamped.
    weight : Dr.Jit tensor or ndarray, shape (H, W), (H, W, 1) or (H, W, C), optional
        Factors w of the SSIM of windows, at their centres; they get no derivatives.
    taps : ndarray of float64, shape (radius + 1,)
        Half of the window along an axis, see `eigengs_dr.image.metrics.ssim`.

    Returns
    -------
    Float, shape (1,)
        ``sum w s / sum w`` over the windows inside the pictures and over the channels.

    Raises
    ------
    ValueError
        If the pictures are too large for 32-bit indices.
    """
    tensors = [types_of(v) for v in (a, b) if is_tensor(v)]
    types = max(tensors, key=lambda types: types.bits)
    height, width, channels = a.shape
    if PLANES * (height + BLOCK) * (width + BLOCK) * channels > 1 << 32:
        raise ValueError(
            f"pictures of {width}x{height} pixels and {channels} channels are too large for an "
            "SSIM with derivatives; compare parts of them"
        )
    x, y = (_flat(types, v) for v in (a, b))
    factors = None if weight is None else dr.detach(_flat(types, weight))
    size = Size(height, width, channels, tuple(taps.tolist()))
    wanted = "".join(name for name, v in (("x", x), ("y", y)) if dr.grad_enabled(v))
    return dr.custom(_Similarity, x, y, factors, size, wanted)


@entry_point
def plane_sums(a: Values, b: Values, weight: Values | None, taps: Doubles) -> tuple[float, float]:
    """Sum SSIM and its contrast-structure term over all windows of two planes.

    Parameters
    ----------
    a, b : ndarray of floats, shape (H, W)
    weight : ndarray, shape (H, W), optional
        Factors of both terms of windows, at their centres.
    taps : ndarray of float64, shape (radius + 1,)
        See `similarity`.

    Returns
    -------
    float, float
        Computed in double precision.
    """
    types = types_in(select(), 64)
    size = Size(a.shape[0], a.shape[1], 1, tuple(taps.tolist()))
    x, y = (_flat(types, v) for v in (a, b))
    factors = None if weight is None else _flat(types, weight)
    terms = compare_runs(blur_columns(x, y, size), factors, size, "")
    similar, structure = _totals([terms.similar, terms.structure])
    return float(similar[0]), float(structure[0])


def _flat(types: ArrayTypes, picture: Tensor | Values) -> Float:
    """Return the values of a picture, pixel after pixel; differentiable."""
    if isinstance(picture, np.ndarray):
        return upload(types.Float, picture.ravel())
    return types.Tensor(picture).array


class Size(NamedTuple):
    """The size of two pictures, and half of the window along an axis."""

    height: int
    width: int
    channels: int
    taps: tuple[float, ...]

    @property
    def reach(self) -> int:
        """Number of rows or columns of a window, minus one: twice its radius."""
        return 2 * (len(self.taps) - 1)

    @property
    def rows(self) -> int:
        """Number of rows of pixels whose window lies inside the pictures."""
        return self.height - self.reach

    @property
    def columns(self) -> int:
        """Number of columns of pixels whose window lies inside the pictures."""
        return self.width - self.reach


class _Similarity(dr.CustomOp):
    """The mean SSIM, one number: both modes use its derivatives with respect to all values."""

    def eval(self, x: Float, y: Float, weight: Float | None, size: Size, wanted: str) -> Float:
        self.pictures, self.size, self.wanted = {"x": x, "y": y}, size, wanted
        means = blur_columns(x, y, size)
        terms = compare_runs(means, weight, size, wanted)
        self.slopes = terms.slopes
        total, area = _totals([terms.similar, terms.area])
        self.share = rcp(area)
        return total * self.share

    def forward(self) -> None:
        gradients = self._gradients(self.share)
        products = [g * self.grad_in(name) for name, g in gradients.items()]
        self.set_grad_out(sum(_totals(products)))

    def backward(self) -> None:
        for name, gradient in self._gradients(self.share * self.grad_out()).items():
            self.set_grad_in(name, gradient)

    def _gradients(self, factor: Float) -> dict[str, Float]:
        assert self.slopes is not None
        slopes = return_to_rows(self.slopes, self.size)
        return return_to_pixels(slopes, self.pictures, self.size, self.wanted, factor)


def _totals(values: list[Float]) -> list[Float]:
    """Add values in double precision, so that sums over large pictures are accurate."""
    Float, Double = type(values[0]), dr.float64_array_t(type(values[0]))
    values = [Double(v) for v in values]
    dr.eval(values)  # one program for all
    return [Float(dr.sum(v)) for v in values]


#  Lines, lanes and runs


class Lanes(NamedTuple):
    """The lanes of a blur along lines, each with `BLOCK` values of a line of the result.

    Sizes are in arrays, so that one program serves all pictures.

    Attributes
    ----------
    place : UInt32
        Index of the line in a channel: its column or row.
    channel : UInt32
    block : UInt32
        Index of the block in a line.
    places, channels, blocks : UInt32, shape (1,)
        Number of each.
    length : UInt32, shape (1,)
        Number of values of a line of the result.
    """

    place: UInt
    channel: UInt
    block: UInt
    places: UInt
    channels: UInt
    blocks: UInt
    length: UInt

    @property
    def first(self) -> UInt:
        """Index of the first value in the line."""
        return self.block * BLOCK

    @property
    def line(self) -> UInt:
        """Index of the line among those of all channels; the lines of a place are adjacent."""
        return self.place * self.channels + self.channel

    @property
    def run(self) -> UInt:
        """Index of the run that the lane writes; the runs of a line are adjacent."""
        return self.line * self.blocks + self.block

    def inside(self, k: int) -> Bool:
        """Return whether the value k of the block lies in the line."""
        return self.first + k < self.length


def lanes_of(types: ArrayTypes, places: int, channels: int, length: int, order: str) -> Lanes:
    """Return the lanes of a blur, see `Lanes`.

    Parameters
    ----------
    places, channels, length : int
    order : str
        "place", "channel" and "block", separated by blanks, from the fastest varying index to the
        slowest.
    """
    counts = {"place": places, "channel": channels, "block": -(-length // BLOCK)}
    rest, indices = dr.arange(types.UInt, places * channels * counts["block"]), {}
    *names, last = order.split()
    for name in names:
        rest, indices[name] = make_divisor(types, counts[name]).divmod(rest)
    indices[last] = rest
    sizes = [dr.opaque(types.UInt, n) for n in (*counts.values(), length)]
    return Lanes(*(indices[name] for name in counts), *sizes)


class Runs(NamedTuple):
    """The output of the lanes of a blur.

    Attributes
    ----------
    values : Float
        Run after run; in a run, plane after plane.
    planes : int
    lanes : Lanes
        The lanes that wrote the values.
    """

    values: Float
    planes: int
    lanes: Lanes

    def across(self, reader: Lanes, shift: int, number: int) -> list[list[Float]]:
        """Return neighbouring values of each plane on lines across the lines of the runs.

        These are `number` values from place ``reader.first - shift`` on, 0 outside of the runs. The
        reader's place is the position on all lines that are crossed.
        """
        types, (writer, start) = types_of(self.values), (self.lanes, reader.first - shift)
        line = start * writer.channels + reader.channel  # may wrap around to an index outside
        run = line * writer.blocks + reader.place // BLOCK
        index = run * (self.planes * BLOCK) + reader.place % BLOCK
        step = writer.channels * writer.blocks * (self.planes * BLOCK)
        active = [start + k < writer.places for k in range(number)]
        return [
            [
                dr.gather(types.Float, self.values, index + plane * BLOCK + step * k, active[k])
                for k in range(number)
            ]
            for plane in range(self.planes)
        ]

    def along(self, reader: Lanes, shift: int) -> list[list[Float]]:
        """Return neighbouring values of each plane on the lines of the runs, 0 outside.

        These are ``shift + BLOCK`` values per plane, from ``reader.first - shift`` on. Lanes read
        complete runs, in packets.
        """
        types, length = types_of(self.values), self.planes * BLOCK
        before, runs = -(-shift // BLOCK), []
        for k in range(before, -1, -1):
            block = reader.block - k  # may wrap around to an index outside
            run = reader.line * self.lanes.blocks + block
            runs.append(gather_run(types, self.values, run, length, block < self.lanes.blocks))
        lines = ([v for r in runs for v in r[k : k + BLOCK]] for k in range(0, length, BLOCK))
        return [line[before * BLOCK - shift :] for line in lines]


def write_runs(planes: list[list[Float]], lanes: Lanes) -> Runs:
    """Write the values that lanes computed: for each plane, those of a block."""
    types, values = types_of(planes[0][0]), [v for plane in planes for v in plane]
    result = dr.empty(types.Float, dr.width(lanes.run) * len(values))
    dr.scatter(result, types.FloatX(values), lanes.run)
    return Runs(result, len(planes), lanes)


def blur_plane(values: list[Float], taps: tuple[float, ...]) -> list[Float]:
    """Return the weighted sums of neighbours, for values whose neighbours are all given."""
    radius = len(taps) - 1
    results = []
    for k in range(radius, len(values) - radius):
        total = values[k] * taps[0]
        for distance in range(1, radius + 1):
            pair = values[k - distance] + values[k + distance]
            total = dr.fma(pair, taps[distance], total)
        results.append(total)
    return results


#  The four programs: along columns, along rows, and their transposes


def blur_columns(x: Float, y: Float, size: Size) -> Runs:
    """Blur x, y, the sum of their squares and their product along columns.

    Cost per value: 4.5 reads, 44 operations for the window.
    """
    types = types_of(x)
    lanes = lanes_of(types, size.width, size.channels, size.rows, "channel place block")
    height, step = (dr.opaque(types.UInt, n) for n in (size.height, size.width * size.channels))
    rows = [lanes.first + k for k in range(BLOCK + size.reach)]

    def read(picture: Float) -> list[Float]:
        return [dr.gather(types.Float, picture, r * step + lanes.line, r < height) for r in rows]

    a, b = read(x), read(y)
    squares = [dr.fma(u, u, v * v) for u, v in zip(a, b, strict=True)]
    products = [u * v for u, v in zip(a, b, strict=True)]
    return write_runs([blur_plane(plane, size.taps) for plane in (a, b, squares, products)], lanes)


class Terms(NamedTuple):
    """What `compare_runs` finds.

    Attributes
    ----------
    similar, structure, area : Float
        For each lane, the sums of ``w s``, of w times the contrast-structure term of s, and of w.
        What is not read is not computed.
    slopes : Runs or None
        The derivatives of the sum of ``w s`` with respect to the local means of the squares, of the
        products, and of each wanted picture.
    """

    similar: Float
    structure: Float
    area: Float
    slopes: Runs | None


def compare_runs(columns: Runs, weight: Float | None, size: Size, wanted: str) -> Terms:
    """Blur along rows, and compute SSIM from the local means of all windows.

    Cost per value: 9 reads, 44 operations for the window, 40 for SSIM and its derivatives.

    Parameters
    ----------
    columns : Runs
    weight : Float, shape (H * W,) or (H * W * C,), optional
    size : Size
    wanted : str
        Names of the pictures, "x" or "y" or both, whose derivatives are needed.

    Returns
    -------
    Terms
    """
    types = types_of(columns.values)
    lanes = lanes_of(types, size.rows, size.channels, size.columns, "place channel block")
    read = columns.across(lanes, 0, BLOCK + size.reach)
    means = zip(*(blur_plane(plane, size.taps) for plane in read), strict=True)
    similar, structure, area = types.Float(0), types.Float(0), types.Float(0)
    slopes = []
    for w, (x, y, squares, product) in zip(
        weights_of(types, weight, lanes, size), means, strict=True
    ):
        both, energy = x * y, dr.fma(x, x, y * y)
        upper = dr.fma(both, 2, C1), dr.fma(product - both, 2, C2)
        lower = energy + C1, squares - energy + C2
        share = rcp(lower[0] * lower[1])
        s = upper[0] * upper[1] * share
        similar += dr.select(w > 0, w * s, 0)
        structure += dr.select(w > 0, w * upper[1] * lower[0] * share, 0)
        area += w
        by_both = 2 * (upper[1] - upper[0]) * share
        by_energy = 2 * s * (lower[0] - lower[1]) * share
        by_mean = {"x": by_both * y + by_energy * x, "y": by_both * x + by_energy * y}
        slope = [-s * lower[0] * share, 2 * upper[0] * share, *(by_mean[n] for n in wanted)]
        slopes.append([dr.select(w > 0, w * d, 0) for d in slope])
    planes = [list(plane) for plane in zip(*slopes, strict=True)]
    return Terms(similar, structure, area, write_runs(planes, lanes) if wanted else None)


def weights_of(types: ArrayTypes, weight: Float | None, lanes: Lanes, size: Size) -> list[Float]:
    """Return the weights of the windows of a block of a row; 0 beyond the end of the row."""
    inside = [lanes.inside(k) for k in range(BLOCK)]
    if weight is None:
        return [dr.select(i, types.Float(1), 0) for i in inside]
    radius, width = size.reach // 2, dr.opaque(types.UInt, size.width)
    first = (lanes.place + radius) * width + lanes.first + radius
    places = [first + k for k in range(BLOCK)]
    if dr.width(weight) > size.height * size.width:
        places = [place * lanes.channels + lanes.channel for place in places]
    return [dr.gather(types.Float, weight, *pair) for pair in zip(places, inside, strict=True)]


def return_to_rows(slopes: Runs, size: Size) -> Runs:
    """Apply the transposed blur along rows to slopes, from columns of windows to columns of pixels.

    Cost per value: 3 reads in packets and 11 operations for each plane.
    """
    types = types_of(slopes.values)
    lanes = lanes_of(types, size.rows, size.channels, size.width, "block channel place")
    read = slopes.along(lanes, size.reach)
    return write_runs([blur_plane(plane, size.taps) for plane in read], lanes)


def return_to_pixels(
    slopes: Runs, pictures: dict[str, Float], size: Size, wanted: str, factor: Float
) -> dict[str, Float]:
    """Apply the transposed blur along columns to slopes; return the derivatives, times a factor.

    Cost per value: 2.3 reads and 11 operations for each plane, 2 reads for each picture.
    """
    types = types_of(slopes.values)
    lanes = lanes_of(types, size.width, size.channels, size.height, "channel place block")
    read = slopes.across(lanes, size.reach, BLOCK + size.reach)
    by_squares, by_product, *by_means = (blur_plane(plane, size.taps) for plane in read)
    step = dr.opaque(types.UInt, size.width * size.channels)
    results = {}
    for name, by_mean in zip(wanted, by_means, strict=True):
        picture, other = pictures[name], pictures["y" if name == "x" else "x"]
        results[name] = result = dr.empty(types.Float, dr.width(picture))
        for k in range(BLOCK):
            place, inside = (lanes.first + k) * step + lanes.line, lanes.inside(k)
            u, v = (dr.gather(types.Float, p, place, inside) for p in (picture, other))
            slope = dr.fma(2 * u, by_squares[k], dr.fma(v, by_product[k], by_mean[k]))
            # Without the promise that there are no conflicts, each value becomes a program.
            mode = dr.ReduceMode.NoConflicts
            dr.scatter(result, slope * factor, place, inside, mode=mode)
    return results
