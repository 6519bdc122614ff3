"""The brightness of Gaussians over uv, which gives the mean, the maximum and the emission.

A survey evaluates the displayed brightness at the centres of cells, the midpoint rule. By Poisson's
summation formula, the rule with the spacing h gives the integral of a Gaussian with the standard
deviation s to ``2 exp(-2 (pi s / h)^2)``: to 5e-4 for ``h = s / RESOLVED``. Values that are clamped
or decoded have no closed form; the same points give their mean to the order of ``h^2``.

Positions of emission are sampled with the density of the cells of a `Survey`, interpolated linearly
between their centres, as a ``bitmap`` interpolates its texels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import upload_rows
from eigengs_dr.backend.recording import guest
from eigengs_dr.backend.types import Float, Mask, Texture, UInt
from eigengs_dr.gaussian.covariance import max_deviation
from eigengs_dr.raster.evaluate import widen
from eigengs_dr.raster.lookup.cells import CellLists, cell_side, list_cells
from eigengs_dr.raster.lookup.points import Packed, sum_at_points, value_terms
from eigengs_dr.raster.parameters import EXP2_SCALE, kernel_covariance
from eigengs_dr.relight.directions import LatLong

from .color import brightness, keep_finite, shown_channels
from .texels import neighbours

RESOLVED = 0.65
"""Smallest standard deviation of a Gaussian that points resolve, in spacings of the points."""

FINEST, COARSEST = 0.25, 1.0
"""Smallest and largest spacing of the points, in texels; the largest is that of a bitmap."""

MOST, FEWEST = 1 << 22, 8
"""Largest number of points, and smallest number along a side."""


class Survey(NamedTuple):
    """Brightness at the centres of a grid of cells over the unit square of uv.

    Attributes
    ----------
    brightness : TensorXf, shape (rows, columns, 1)
    mean, largest : Float, shape (1,)
    """

    brightness: Float
    mean: Float
    largest: Float


class Spacing(NamedTuple):
    """Spacing of the points of a survey.

    Attributes
    ----------
    finest, coarsest : float
        Smallest and largest spacing, in texels.
    resolved : float
        Standard deviation of the smallest Gaussian, in spacings, between these two.
    """

    finest: float = FINEST
    coarsest: float = COARSEST
    resolved: float = RESOLVED


def make_survey(texture: Texture, spacing: Spacing | None = None) -> Survey:
    """Evaluate the brightness of a sum of Gaussians in cells, without gradients.

    Cells are as large as texels, or smaller if a Gaussian needs it. If `MOST` or the smallest
    spacing forbids cells that are small enough, Gaussians are widened by ``(RESOLVED h)^2``, which
    keeps their integrals; not where they sum to logarithms, whose integrals it would change.

    Parameters
    ----------
    texture : mitsuba.Texture or mitsuba.Emitter
        A plugin of this package.
    spacing : Spacing, optional
    """
    with dr.suspend_grad():
        if texture.drawn:
            columns, lines, _ = _grid(texture, RESOLVED, Spacing())
            return _survey(texture, columns, lines)
        table, size = dr.detach(texture.table), (texture.width, texture.height)
        parameters = texture.source.parameters()
        shape, color = parameters.shape, [keep_finite(c) for c in parameters.color]
        dr.eval(shape, color)
        smallest = _smallest_deviation(shape, color)
        columns, lines, width = _grid(texture, smallest, spacing or Spacing())
        cells, packed, deviation = table.lists.cells, table.packed, RESOLVED * width
        if deviation > 1.001 * smallest and texture.space.affine:
            variance, zero = dr.opaque(mi.Float, deviation**2), mi.Float(0)
            shape, amplitude = widen(shape, kernel_covariance([variance, zero, variance]))
            dr.eval(shape)
            color = [amplitude * c for c in color]
            side = max(cell_side(*size, cells.count), round(deviation))
            cells = list_cells([(shape, side)], *size, packed.radius)
            packed = Packed(cells.pack(shape, color), len(color), texture.cutoff)
        return _survey(texture, columns, lines, (cells, packed))


def _survey(
    texture: Texture, columns: int, rows: int, listed: tuple[CellLists, Packed] | None = None
) -> Survey:
    """Survey what texels show, or Gaussians in lists, in a grid of cells."""
    index, everywhere = dr.arange(mi.UInt32, columns * rows), mi.Bool(True)
    uv = mi.Point2f(index % columns, index // columns) + 0.5
    (x, _), (y, _), _ = texture.point(uv * mi.Point2f(1 / columns, 1 / rows))
    if listed is None:
        seen = texture.texels.at(x, y, everywhere)
    else:
        cells, packed = listed
        sums = sum_at_points(cells, packed, x, y, everywhere, value_terms(packed))
        sums = sums[texture.part] if packed.channels > texture.channels else sums
        background = texture.table.background[texture.part]
        seen = shown_channels(texture, [s + b for s, b in zip(sums, background, strict=True)])
    light = brightness(texture, seen) + dr.zeros(mi.Float, columns * rows)
    dr.eval(light)
    survey = Survey(mi.TensorXf(light, (rows, columns, 1)), dr.mean(light), dr.max(light))
    dr.eval(survey.mean, survey.largest)
    return survey


def _smallest_deviation(shape: list, color: list) -> float:
    """Return the smallest standard deviation of visible Gaussians, in texels."""
    a, b, c, *values = (np.asarray(row.numpy(), np.float64) for row in [*shape[2:], *color])
    visible = (a > 0) & (c > 0) & (np.abs(values).sum(axis=0) > 0)
    with np.errstate(all="ignore"):  # the axes have the product 1 / (a c)
        deviation = EXP2_SCALE / (a * c * max_deviation(a, b, c))
    return float(deviation[visible & np.isfinite(deviation)].min(initial=1e6))


def _grid(texture: Texture, smallest: float, spacing: Spacing) -> tuple[int, int, float]:
    """Return the number of columns and rows of points, and their spacing in texels."""
    spans = np.minimum(texture.spans(), 1e9)
    counts = spans / min(max(smallest / spacing.resolved, spacing.finest), spacing.coarsest)
    counts *= min(1.0, math.sqrt(MOST / counts.prod()))
    columns, rows = (math.ceil(max(FEWEST, n)) for n in np.minimum(counts, MOST / FEWEST))
    return columns, rows, float((spans / (columns, rows)).max())


Result = TypeVar("Result")


def outside_of_recordings(compute: Callable[[], Result]) -> Result:
    """Call a function that launches programs, even while Dr.Jit records one.

    Renderers call textures while they record a program, in which nothing can be evaluated. Another
    thread records nothing; this one, which waits for it, may hold the lock. So may the caller of a
    loading thread, in which a material asks for the mean of its texture.
    """
    if not dr.flag(dr.JitFlag.SymbolicScope):
        return guest()(compute)()
    with ThreadPoolExecutor(1) as another:
        return another.submit(guest()(compute)).result()


DARKEST = 0.005
"""Smallest density of a cell, relative to the mean: light may lie beside its centre. With 0.02, the
share of samples in the dark alone makes the noise of small lamps 14 %."""


@dataclass(frozen=True)
class Emission:
    """A distribution of positions in the unit square: of rows, and of the cells of each row.

    Of a ``mitsuba.DiscreteDistribution2D`` of Mitsuba 3.9, `drjit.freeze` does not see the arrays:
    a replay would read the memory where those of the recording were.

    Attributes
    ----------
    rows : Float, shape (rows,)
        Cumulative distribution of the rows, up to 1.
    cells : Float, shape (rows * columns,)
        Cumulative distribution of the cells of each row, up to 1.
    densities : TensorXf, shape (rows, columns)
        Densities at the centres of the cells, between which they are interpolated linearly.
    """

    rows: Float
    cells: Float
    densities: mi.TensorXf

    @property
    def bytes(self) -> int:
        """Bytes of the arrays: two numbers for each cell, and the sum of each row."""
        rows, columns = self.densities.shape
        return (2 * rows * columns + rows) * dr.itemsize_v(mi.Float)

    def sample(self, sample: mi.Point2f, active: Mask) -> tuple[mi.Point2f, Float]:
        """Return positions (Point2f) and their densities for samples of the unit square."""
        rows, columns = self.densities.shape
        row, y = _search(self.rows, mi.UInt32(0), rows, sample.y, active)
        column, x = _search(self.cells, row * columns, columns, sample.x, active)
        # At the borders the tent of a cell folds back into the square.
        p = mi.Point2f(column, row) + 0.5 + mi.warp.square_to_tent(mi.Point2f(x, y))
        p = dr.abs(p) * mi.Point2f(1 / columns, 1 / rows)
        p = dr.minimum(p, 2 - p)
        return p, self.density(p, active)

    def density(self, p: mi.Point2f, active: Mask) -> Float:
        """Return the density at positions; 0 outside of the unit square."""
        # On cuda, Dr.Jit 1.5 ends the process when a frozen rendering meets a texture object
        # without acceleration, and the fractions of an accelerated one have 8 bits.
        inside = active & dr.all((p >= 0) & (p <= 1))
        rows, columns = self.densities.shape
        left, right, along = neighbours(p.x * columns, columns)
        upper, lower, down = neighbours(p.y * rows, rows)

        def between(row: UInt) -> Float:
            """Return the density in a row."""
            values = (
                dr.gather(mi.Float, self.densities.array, row * columns + column, inside)
                for column in (left, right)
            )
            return dr.lerp(*values, along)

        return dr.select(inside, dr.lerp(between(upper), between(lower), down), 0)


def _search(
    cumulative: Float, first: UInt, count: int, sample: Float, active: Mask
) -> tuple[UInt, Float]:
    """Return the entry of `count` from `first` on that a sample falls into, and where in it.

    The place is uniform in [0, 1], so that it serves as another sample.
    """

    def sum_of(entry: UInt, active: Mask) -> Float:
        return dr.gather(mi.Float, cumulative, first + entry, active)

    entry = dr.binary_search(0, count - 1, lambda i: sum_of(i, active) <= sample)
    below = sum_of(entry - 1, active & (entry > 0))
    part = dr.maximum(sum_of(entry, active) - below, dr.smallest(mi.Float))
    return entry, dr.clip((sample - below) / part, 0, 1)


def emission_of(survey: Survey, over_sphere: bool = False) -> Emission:
    """Return the distribution of emission for a survey, of a square or of a sphere."""
    density = np.maximum(survey.brightness.numpy()[..., 0], 0)
    if over_sphere:
        density *= LatLong(*density.shape[::-1]).areas()[:, None]
    floor = DARKEST * density.mean() or 1.0
    density = np.maximum(density, floor)
    relative = density / density.mean(dtype=np.float64).astype(np.float32)
    cells = np.cumsum(density, axis=1, dtype=np.float64)
    rows = np.cumsum(cells[:, -1])
    sums = [rows / rows[-1], (cells / cells[:, -1:]).ravel(), relative.ravel()]
    by_row, by_cell, densities = upload_rows(mi.Float, sums)
    return Emission(by_row, by_cell, mi.TensorXf(densities, relative.shape))
