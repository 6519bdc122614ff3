"""The brightness of the texture over uv, which gives its mean, its maximum and its emission.

A survey evaluates the shown brightness at the centres of cells, the midpoint rule. By Poisson's
summation formula, the rule with the spacing h gives the integral of a Gaussian with the standard
deviation s to ``2 exp(-2 (pi s / h)^2)``: to 5e-4 for ``h = s / RESOLVED``. Values that are clamped
or decoded have no closed form; the same points give their mean to the order of ``h^2``.

Positions of emission are sampled with the density of the cells of a `Survey`, interpolated linearly
between their centres, as a ``bitmap`` interpolates its texels.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eigengs_dr.backend.arrays import Bool, types_of
from eigengs_dr.raster.evaluate import widen
from eigengs_dr.raster.lookup.points import cell_side, fold, list_cells, sum_at_points, value_terms
from eigengs_dr.raster.parameters import (
    EXP2_SCALE,
    NUM_SHAPE_PARAMS,
    kernel_covariance,
    kernel_radius,
    pack_parameters,
    unpack_parameters,
)

from .color import brightness, show_all
from .versions import Texture

RESOLVED = 0.65
"""Standard deviation of a Gaussian, in spacings of the points, that the points resolve."""

FINEST = 0.25
"""Smallest spacing of the points, in texels. The largest is one texel, as in a bitmap."""

MOST, FEWEST = 1 << 22, 8
"""Largest number of points, and smallest number along a side."""


@dataclass(frozen=True)
class Survey:
    """Brightness on a grid of cells over the unit square of uv.

    Attributes
    ----------
    columns, rows : int
    brightness : Float, shape (rows * columns,)
        At the centres of the cells, row after row.
    mean, largest : Float, shape (1,)
    """

    columns: int
    rows: int
    brightness: Any
    mean: Any
    largest: Any


def make_survey(texture: Texture) -> Survey:
    """Evaluate the brightness of a ``gaussian_texture`` in cells.

    Cells are as large as texels, or smaller if a Gaussian needs it. If `MOST` or `FINEST` forbids
    cells that are small enough, Gaussians are widened by ``(RESOLVED h)^2``, which keeps their
    integrals.

    Parameters
    ----------
    texture : mitsuba.Texture

    Returns
    -------
    Survey
        Without gradients.
    """
    with dr.suspend_grad():
        number = NUM_SHAPE_PARAMS + texture.channels
        packed = dr.detach(texture.packed)
        count = len(texture.source.start)
        rows = unpack_parameters(packed, dr.arange(mi.UInt32, count), number)
        smallest = _smallest_deviation(rows)
        columns, lines, spacing = _grid(texture, smallest)
        cells, radius = texture.cells, kernel_radius(texture.cutoff)
        if RESOLVED * spacing > 1.001 * smallest:
            packed, cells = _widened(texture, rows, RESOLVED * spacing)
        index = dr.arange(mi.UInt32, columns * lines)
        uv = mi.Point2f(index % columns, index // columns) + 0.5
        u, v = texture.transform.apply(uv * mi.Point2f(1 / columns, 1 / lines))
        (x, _), (y, _) = (
            fold(c * side, side, texture.wrap)
            for c, side in ((u, texture.width), (v, texture.height))
        )
        terms = value_terms(radius)
        sums = sum_at_points(cells, packed, number, x, y, mi.Bool(True), terms, texture.channels)
        coded = [s + b for s, b in zip(sums, texture.background, strict=True)]
        seen = show_all(texture, coded)
        light = brightness(texture, seen) + dr.zeros(mi.Float, columns * lines)
        dr.eval(light)
        survey = Survey(columns, lines, light, dr.mean(light), dr.max(light))
        dr.eval(survey.mean, survey.largest)
    return survey


def _smallest_deviation(rows: list) -> float:
    """Return the smallest standard deviation of drawn Gaussians, in texels."""
    _, _, a, b, c, *color = rows
    # The largest singular value of F, squared, is m + sqrt(m^2 - (ac)^2) with m = |F|^2 / 2.
    middle = 0.5 * (a * a + b * b + c * c)
    steepest = middle + dr.safe_sqrt(middle * middle - dr.square(a * c))
    drawn = dr.isfinite(steepest) & (a > 0) & (c > 0)
    drawn &= dr.mask_t(drawn)(sum(dr.abs(k) for k in color) > 0)
    return EXP2_SCALE * float(dr.rsqrt(dr.maximum(dr.max(dr.select(drawn, steepest, 0)), 1e-12))[0])


def _grid(texture: Texture, smallest: float) -> tuple[int, int, float]:
    """Return the number of columns and rows of points, and their spacing in texels."""
    size = np.array([[texture.width], [texture.height]])
    linear = np.array(texture.to_uv.matrix, np.float64)[:2, :2] * size
    spans = np.minimum(np.hypot(*linear), 1e9)  # of the unit square, in texels
    wanted = spans / min(max(smallest / RESOLVED, FINEST), 1.0)
    wanted *= min(1.0, math.sqrt(MOST / wanted.prod()))
    columns, rows = (max(FEWEST, math.ceil(n)) for n in np.minimum(wanted, MOST / FEWEST))
    return columns, rows, float((spans / (columns, rows)).max())


def _widened(texture: Texture, rows: list, deviation: float) -> tuple[Any, Any]:
    """Return the Gaussians convolved with a round one: their parameters and their cells."""
    types = types_of(texture.packed)
    variance, zero = dr.opaque(types.Float, deviation**2), types.Float(0)
    wide, amplitude = widen(rows[:NUM_SHAPE_PARAMS], kernel_covariance([variance, zero, variance]))
    dr.eval(wide)
    size = (texture.width, texture.height)
    side = max(cell_side(*size, len(texture.source.start)), round(deviation))
    cells = list_cells(wide, *size, kernel_radius(texture.cutoff), side)
    return pack_parameters([*wide, *(amplitude * k for k in rows[NUM_SHAPE_PARAMS:])]), cells


def outside_of_recordings(compute: Callable[[], Any]) -> Any:
    """Call a function that launches programs, even while Dr.Jit records one.

    Renderers call textures while they record a program, in which nothing can be evaluated. Another
    thread records nothing.

    Parameters
    ----------
    compute : callable

    Returns
    -------
    Any
        The result of `compute`, or its exception.
    """
    if not dr.flag(dr.JitFlag.SymbolicScope):
        return compute()
    outcome: list[Any] = []

    def run() -> None:
        try:
            outcome.extend((True, compute()))
        except BaseException as error:
            outcome.extend((False, error))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    fine, result = outcome
    if not fine:
        raise result
    return result


DARKEST = 0.005
"""Smallest density of a cell, relative to the mean: light may lie beside its centre. With 0.02, the
share of samples in the dark alone makes the noise of small lamps 14 %."""


@dataclass(frozen=True)
class Emission:
    """A distribution of positions in the unit square.

    Attributes
    ----------
    columns, rows : int
        Number of cells.
    cells : mitsuba.DiscreteDistribution2D
        Probabilities of the cells.
    """

    columns: int
    rows: int
    cells: Any

    def sample(self, sample: Any, active: Bool) -> tuple[Any, Any]:
        """Return positions (Point2f) and their densities for samples of the unit square."""
        cell, _, rest = self.cells.sample(sample, active)
        p = mi.Point2f(cell) + 0.5 + mi.warp.square_to_tent(rest)
        # At the borders the tent of a cell folds back into the square.
        p = dr.abs(p) * mi.Point2f(1 / self.columns, 1 / self.rows)
        p = dr.minimum(p, 2 - p)
        return p, self.density(p, active)

    def density(self, p: Any, active: Bool) -> Any:
        """Return the density at positions; 0 outside of the unit square."""
        inside = (p.x >= 0) & (p.x <= 1) & (p.y >= 0) & (p.y <= 1)
        x, y = (
            dr.select(inside, v, 0) * n - 0.5 for v, n in ((p.x, self.columns), (p.y, self.rows))
        )
        left, top = dr.floor(x), dr.floor(y)
        across, down = x - left, y - top
        corners = []
        for j in (0, 1):
            for i in (0, 1):
                column = mi.UInt32(dr.clip(left + i, 0, self.columns - 1))
                row = mi.UInt32(dr.clip(top + j, 0, self.rows - 1))
                corners.append(self.cells.pdf(mi.Point2u(column, row), active & inside))
        upper, lower = dr.lerp(*corners[:2], across), dr.lerp(*corners[2:], across)
        return dr.select(inside, dr.lerp(upper, lower, down) * (self.columns * self.rows), 0)


def emission_of(survey: Survey) -> Emission:
    """Return the distribution of emission for a survey of the brightness."""
    density = np.maximum(survey.brightness.numpy(), 0).reshape(survey.rows, survey.columns)
    floor = DARKEST * density.mean() or 1.0
    cells = mi.DiscreteDistribution2D(np.maximum(density, floor))
    return Emission(survey.columns, survey.rows, cells)
