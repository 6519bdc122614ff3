"""The brightness of the texture over uv, which gives its mean, its maximum and its emission.

A survey evaluates the shown brightness at the centres of cells, the midpoint rule. By Poisson's
summation formula, the rule with the spacing h gives the integral of a Gaussian with the standard
deviation s to ``2 exp(-2 (pi s / h)^2)``: to 5e-4 for ``h = s / RESOLVED``. Values that are clamped
or decoded have no closed form; the same points give their mean to the order of ``h^2``.
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

from eigengs_dr.backend.arrays import types_of
from eigengs_dr.raster.evaluate import widen
from eigengs_dr.raster.layout import pack_parameters, unpack_parameters
from eigengs_dr.raster.lookup.points import (
    cell_side,
    fold,
    list_cells,
    sum_at_points,
    value_terms,
)
from eigengs_dr.raster.parameters import (
    EXP2_SCALE,
    NUM_SHAPE_PARAMS,
    kernel_covariance,
    kernel_radius,
)

from .values import brightness, show_all

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


def make_survey(texture: Any) -> Survey:
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


def _grid(texture: Any, smallest: float) -> tuple[int, int, float]:
    """Return the number of columns and rows of points, and their spacing in texels."""
    size = np.array([[texture.width], [texture.height]])
    linear = np.array(texture.to_uv.matrix, np.float64)[:2, :2] * size
    spans = np.minimum(np.hypot(*linear), 1e9)  # of the unit square, in texels
    wanted = spans / min(max(smallest / RESOLVED, FINEST), 1.0)
    wanted *= min(1.0, math.sqrt(MOST / wanted.prod()))
    columns, rows = (max(FEWEST, math.ceil(n)) for n in np.minimum(wanted, MOST / FEWEST))
    return columns, rows, float((spans / (columns, rows)).max())


def _widened(texture: Any, rows: list, deviation: float) -> tuple[Any, Any]:
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
