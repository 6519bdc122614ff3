"""Quantization: Gaussians as integers, with steps of equal effect on the image.

With the amplitude ``A = color size`` of a Gaussian, where the size is the geometric mean of the
standard deviations, a change of the Gaussian changes the image by the squared error

    pi (|dA|^2 + |A|^2 (ds^2 + dl^2 + (sinh(2 l) / 2)^2 dt^2 + 1/2 |F dm|^2))

for a change of A, the logarithm s of the inverse size, the stretch l (half the logarithm of the
ratio of the axes), twice the angle t of the axes, and the mean m. All mixed products vanish. So a
single step for everything is best: the step of A is ``Steps.color``, and the steps of s, l, sinh(2
l) t / 2 and F m are ``1 / Q`` for a Gaussian whose colour has Q steps. A faint Gaussian has a
coarse shape and position, and a round Gaussian has no angle. The factors `SCALE_STEP` and others
were tuned on training photos.

A mean lies in a square cell, see `Steps.cell`, which each Gaussian divides into a grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.types import Doubles, Floats, Integers
from .exact_math import cos_turns, exp2, sin_turns, sum_in_order

MAX_SYMBOL = 1 << 23
"""Bound of the absolute value of integers; finer steps are not worth storing. Cells differ by less
than twice the bound, which fits `eigengs_dr.codec.range_coder.MAX_LEVELS`."""

SCALE_STEP, STRETCH_STEP, TURN_STEP, MEAN_STEP = 1.2, 1.0, 1.0, 1.4142135623730951
"""Steps of s, l, the angle and the mean, times Q."""

MIN_PRECISION = 1.0
"""Smallest Q, used for the shape of a Gaussian whose colour has 0 steps."""

DEAD_ZONE = 0.08
"""Fraction of a step by which colours are rounded towards 0; it saves bits for little error."""

MAX_TURNS, MAX_PARTS = 1 << 20, 1 << 16
"""Largest number of directions, and of parts of a side of a cell."""

LOG2E = 1.4426950408889634


class Steps(NamedTuple):
    """Sizes of the steps, exactly representable in single precision, as in files.

    Attributes
    ----------
    color : float
        Step of the colour, with 1 as white, times the size of the Gaussian in pixels.
    cell : float
        Side of a cell in pixels.
    """

    color: float
    cell: float


class Symbols(NamedTuple):
    """N Gaussians as integers.

    Attributes
    ----------
    cell : ndarray of int64, shape (N, 2)
        Column and row of the cell of the mean.
    part : ndarray of int64, shape (N, 2)
        Column and row of the mean in the grid of its cell, see `Quantizer.parts`.
    color : ndarray of int64, shape (N, C)
        Steps of the colours.
    scale, stretch : ndarray of int64, shape (N,)
        Steps of s and l.
    turn : ndarray of int64, shape (N,)
        Direction, from 0 to the number from `Quantizer.turns`, minus 1.
    """

    cell: Integers
    part: Integers
    color: Integers
    scale: Integers
    stretch: Integers
    turn: Integers

    def select(self, chosen: slice | NDArray[np.integer]) -> Symbols:
        """Return the Gaussians of a slice or of indices."""
        return Symbols(*(part[chosen] for part in self))


class Quantizer:
    """The steps of the shapes and of the places of N Gaussians, which follow from their colours.

    Parameters
    ----------
    color : ndarray of int64, shape (N, C)
        Steps of the colours.
    cell : float
        Side of a cell in pixels.

    Attributes
    ----------
    precision : ndarray of float64, shape (N,)
        Q of each Gaussian.
    scale_step, stretch_step : ndarray of float64, shape (N,)
        Steps of s and l.
    """

    def __init__(self, color: Integers, cell: float) -> None:
        squares = np.square(color.T.astype(np.float64))
        self.precision = np.maximum(np.sqrt(sum_in_order(squares)), MIN_PRECISION)
        self.scale_step = SCALE_STEP / self.precision
        self.stretch_step = STRETCH_STEP / self.precision
        self.cell = cell

    def turns(self, length: Doubles) -> Integers:
        """Return the number of directions for stretches l, shape (N,)."""
        with np.errstate(all="ignore"):
            ratio = exp2(2 * LOG2E * length)
            turns = np.rint((ratio - 1 / ratio) * self.precision * (1.5707963267948966 / TURN_STEP))
        return np.clip(turns, 1, MAX_TURNS).astype(np.int64)

    def factors(self, scale: Integers, stretch: Integers, turn: Integers) -> Doubles:
        """Return the factors a, b, c, shape (N, 3), for integers, by exact arithmetic."""
        length = stretch * self.stretch_step
        angle = turn / self.turns(length)
        with np.errstate(all="ignore"):
            ratio, size = exp2(2 * LOG2E * length), exp2(LOG2E * (scale * self.scale_step))
            sinh = 0.5 * (ratio - 1 / ratio)
            cosine = cos_turns(0.5 * angle)
            a = np.sqrt(1 / ratio + 2 * sinh * cosine * cosine)
            return np.stack([a * size, sinh * sin_turns(angle) / a * size, size / a], axis=1)

    def parts(self, factor: Doubles) -> Integers:
        """Return the number of parts of the sides of each cell, shape (N, 2)."""
        with np.errstate(all="ignore"):
            unit = self.precision * (self.cell / MEAN_STEP)
            parts = np.rint(np.stack([factor[:, 0] * unit, factor[:, 2] * unit], axis=1))
        return np.clip(np.nan_to_num(parts, nan=1.0), 1, MAX_PARTS).astype(np.int64)


def log_shapes(factor: Floats) -> Doubles:
    """Return the matrix logarithms ``1/2 log(F^T F) = [[s + u, v], [v, s - u]]``.

    Parameters
    ----------
    factor : ndarray, shape (N, 3)
        a, b, c.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        s, u, v. The geometric mean of the two standard deviations is ``exp(-s)``. The vector (u, v)
        gives elongation and direction, and is 0 for a round Gaussian.
    """
    a, b, c = np.asarray(factor, np.float64).T
    half, across, size = 0.5 * (a * a - b * b - c * c), a * b, np.log(a * c)
    # The larger eigenvalue of F^T F is a sum of positive numbers: there is no cancellation.
    largest = 0.5 * (a * a + b * b + c * c) + np.hypot(half, across)
    length = 0.5 * (np.log(largest) - size)
    angle = np.arctan2(across, half)
    return np.stack([0.5 * size, length * np.cos(angle), length * np.sin(angle)], axis=1)


def quantize(arrays: dict[str, Floats], steps: Steps, dead_zone: float = 0.0) -> Symbols:
    """Round Gaussians to integers.

    Parameters
    ----------
    arrays : dict of ndarray
        mean (N, 2), factor (N, 3) and color (N, C), see `eigengs_dr.Gaussians`.
    steps : Steps
    dead_zone : float, optional
        Fraction of a step by which colours are rounded towards 0.

    Returns
    -------
    Symbols

    Raises
    ------
    ValueError
        If the absolute value of an integer would be `MAX_SYMBOL` or more.
    """
    s, u, v = log_shapes(arrays["factor"]).T
    amplitude = np.asarray(arrays["color"], np.float64) / (steps.color * np.exp(s))[:, None]
    rounded = np.copysign(np.floor(np.maximum(np.abs(amplitude) + 0.5 - dead_zone, 0)), amplitude)
    color = _to_integers("color", rounded)
    quantizer = Quantizer(color, steps.cell)
    scale = _to_integers("shape", s * quantizer.precision / SCALE_STEP)
    stretch = _to_integers("shape", np.hypot(u, v) * quantizer.precision / STRETCH_STEP)
    turns = quantizer.turns(stretch * quantizer.stretch_step)
    turn = np.rint(np.arctan2(v, u) / (2 * np.pi) * turns).astype(np.int64) % turns
    factor = quantizer.factors(scale, stretch, turn)
    parts = quantizer.parts(factor)
    mean = np.asarray(arrays["mean"], np.float64) / steps.cell
    cell_y, part_y = _place(mean[:, 1], parts[:, 1])
    # The error in y shifts x, so that both coordinates of F (m' - m) are small.
    error_y = cell_y + (part_y + 0.5) / parts[:, 1] - mean[:, 1]
    cell_x, part_x = _place(mean[:, 0] - factor[:, 1] / factor[:, 0] * error_y, parts[:, 0])
    return Symbols(
        np.stack([cell_x, cell_y], axis=1),
        np.stack([part_x, part_y], axis=1),
        color,
        scale,
        stretch,
        turn,
    )


def dequantize(symbols: Symbols, steps: Steps) -> dict[str, Floats]:
    """Return mean (N, 2), factor (N, 3) and color (N, C) for integers.

    With ``Q = max(1, |color|)`` and the integers i, j, k of scale, stretch and turn::

        s = 1.2 i / Q,  l = j / Q,  K = max(1, round(pi sinh(2 l) Q)),  t = 2 pi k / K
        a' = sqrt(exp(-2 l) + 2 sinh(2 l) cos(t / 2)^2)
        (a, b, c) = exp(s) (a', sinh(2 l) sin(t) / a', 1 / a')

    A cell with the side h has ``round(a Q h / sqrt(2))`` parts across and ``round(c Q h /
    sqrt(2))`` along, from 1 to `MAX_PARTS`; the mean is in the middle of its part. The colour is
    its integers times the step and ``exp(s)``. Numbers of damaged files may overflow to infinity
    or zero.
    """
    quantizer = Quantizer(symbols.color, steps.cell)
    factor = quantizer.factors(symbols.scale, symbols.stretch, symbols.turn)
    parts = quantizer.parts(factor)
    with np.errstate(all="ignore"):
        size = exp2(LOG2E * (symbols.scale * quantizer.scale_step))
        return {
            "mean": (symbols.cell + (symbols.part + 0.5) / parts) * steps.cell,
            "factor": factor,
            "color": symbols.color * (steps.color * size)[:, None],
        }


def _place(values: Floats, parts: Integers) -> tuple[Integers, Integers]:
    """Return the cells of coordinates, and their parts inside the cells."""
    cell = _to_integers("mean", np.floor(values))
    return cell, np.clip((values - cell) * parts, 0, parts - 1).astype(np.int64)


def _to_integers(name: str, counts: Floats) -> Integers:
    """Round numbers of steps to integers; for errors see `quantize`."""
    if not (np.abs(counts) < MAX_SYMBOL).all():
        raise ValueError(
            f"pack: a {name} is {MAX_SYMBOL} steps or more from zero; call bounded() first, or "
            "allow a larger loss"
        )
    return np.rint(counts).astype(np.int64)
