"""The probabilities of the integers of a Gaussian, given those that were decoded before.

A number is predicted by a weighted sum of features: its mean over neighbours, and other numbers of
the same Gaussian. Another weighted sum, of positive features, gives the width of the distribution
of the error. The encoder fits the weights by least squares and stores them in the file. Chroma is
predicted from luma and from the other chroma by the regression slope of the neighbours, which saves
a third of the bits of chroma. Directions and places in cells are equally probable.

Gaussians are in the order of a Hilbert curve through their cells. Their parameters are coded in
passes: every 16th Gaussian, then those halfway between, and so on. So each Gaussian, except in the
first pass, has known neighbours on both sides, and a pass takes few calls. All numbers are the same
on every machine, see `eigengs_dr.codec.exact_math`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from ..backend.types import Doubles, Integers
from .exact_math import in_order, log2
from .quantization import (
    SCALE_STEP,
    STRETCH_STEP,
    Steps,
    Symbols,
    factors_of,
    parts_of,
    precision,
    turns_of,
)
from .range_coder import Coder
from .weights import MIN_WIDTH, Weights, fit_weights

STRIDES = (8, 4, 2, 1)
"""Distances along the curve, in Gaussians, of the passes after the first one."""

NEIGHBOUR_OFFSETS = np.array([-3, -1, 1, 3])
"""Positions of the known neighbours, in strides."""


class Pass(NamedTuple):
    """The Gaussians of a pass.

    Attributes
    ----------
    rows : ndarray of int64, shape (n,)
    known : ndarray of int64, shape (K, n)
        Neighbours that earlier passes coded; none in the first pass.
    weight : ndarray of float64, shape (K, n)
        Weights of the neighbours, with sum 1: inverse to the square of the distance.
    """

    rows: Integers
    known: Integers
    weight: Doubles

    def mean(self, values: Doubles) -> Doubles:
        """Return the weighted means, shape (n,), of the values (N,) of the neighbours."""
        return in_order(self.weight * values[self.known])


def passes_of(cells: Integers) -> list[Pass]:
    """Divide Gaussians, in the order of the curve, into passes; the cells have shape (N, 2)."""
    index = np.arange(len(cells))
    first = index[:: 2 * STRIDES[0]]
    passes = [Pass(first, np.zeros((0, len(first)), np.int64), np.zeros((0, len(first))))]
    for stride in STRIDES:
        rows = index[stride :: 2 * stride]
        known = rows + stride * NEIGHBOUR_OFFSETS[:, None]
        inside = (known >= 0) & (known < len(cells))
        known = np.clip(known, 0, len(cells) - 1)
        weight = np.where(inside, 1 / (squared_distance(cells[rows], cells[known]) + 1), 0)
        passes.append(Pass(rows, known, weight / in_order(weight)))
    return [part for part in passes if len(part.rows)]


def squared_distance(one: Integers, other: Integers) -> Doubles:
    """Return the squared distances of cells, shape (..., 2)."""
    difference = (one - other).astype(np.float64)
    return difference[..., 0] * difference[..., 0] + difference[..., 1] * difference[..., 1]


Features = Callable[[Pass], tuple[Doubles, Doubles]]
"""Returns the features of centres and of widths, shape (F, n), for the n Gaussians of a pass."""


class GaussianCoder:
    """Coding of all numbers of the Gaussians of a section, except their cells.

    Parameters
    ----------
    coder : Encoder or Decoder
    cells : ndarray of int64, shape (N, 2)
        In the order of the curve.
    weights : list of Weights, optional
        None for an encoder, which fits weights and stores them in the attribute `weights`.
    rich : bool, optional
        Whether the encoder uses all features.
    """

    def __init__(
        self,
        coder: Coder,
        cells: Integers,
        weights: list[Weights] | None = None,
        rich: bool = True,
    ) -> None:
        self.coder, self.cells, self.rich = coder, cells, rich
        self.known, self.weights = iter(weights) if weights else None, weights or []
        self.passes = passes_of(cells)
        self.values = np.zeros(len(cells))  # known values of the kind that is being coded

    def code(self, given: Symbols, steps: Steps) -> Symbols:
        """Code the numbers; a decoder uses only their shapes."""
        color, ones = np.zeros_like(given.color), np.ones(len(self.cells))
        for k, values in enumerate(given.color.T):
            color[:, k] = self._numbers(partial(self._color_features, color, k), ones, values)
        fineness = precision(color)
        log_fineness, step = log2(fineness), SCALE_STEP / fineness
        scale = self._numbers(partial(self._scale_features, log_fineness, step), step, given.scale)
        s, step = scale * step, STRETCH_STEP / fineness
        features = partial(self._stretch_features, log_fineness, s, step)
        stretch = self._numbers(features, step, given.stretch)
        turn = self.coder.uniform(turns_of(stretch * step, fineness), given.turn)
        parts = parts_of(factors_of(scale, stretch, turn, fineness), fineness, steps.cell)
        place = [self.coder.uniform(parts[:, axis], given.part[:, axis]) for axis in range(2)]
        return Symbols(self.cells, np.stack(place, axis=1), color, scale, stretch, turn)

    def _numbers(self, features: Features, step: Doubles, given: Integers) -> Integers:
        """Code one kind of numbers, pass by pass."""
        result = np.zeros_like(given)
        weights = next(self.known) if self.known else self._fit(features, step, given)
        self.values = np.zeros(len(step))
        for part in self.passes:
            centers, widths = features(part)
            rows, unit = part.rows, step[part.rows]
            center = in_order(weights.center[:, None] * centers) / unit
            width = np.maximum(in_order(weights.width[:, None] * widths) / unit, MIN_WIDTH)
            result[rows] = self.coder.numbers(center, width, given[rows])
            self.values[rows] = result[rows] * unit
        return result

    def _fit(self, features: Features, step: Doubles, given: Integers) -> Weights:
        """Fit the weights to numbers that are all known, and store them."""
        self.values = given * step
        pairs = zip(*(features(part) for part in self.passes), strict=True)
        center, width = (np.ascontiguousarray(np.concatenate(kind, axis=1).T) for kind in pairs)
        order = np.concatenate([part.rows for part in self.passes])
        weights = fit_weights(center, width, self.values[order], step[order], self.rich)
        self.weights.append(weights)
        return weights

    def _color_features(self, color: Integers, k: int, part: Pass) -> tuple[Doubles, Doubles]:
        """Return the features of channel k: its neighbours, and the two channels before it."""
        rows, values = part.rows, self.values
        center, width = [part.mean(values)], [np.ones(len(rows)), part.mean(np.abs(values))]
        for other in color.T[max(0, k - 2) : k].astype(np.float64):
            slope = part.mean(other * values) / (part.mean(other * other) + 1)
            center += [other[rows], slope * other[rows]]
            width += [np.abs(other[rows]), np.abs(part.mean(other))]
        return np.stack(center), np.stack(width)

    def _scale_features(
        self, log_fineness: Doubles, step: Doubles, part: Pass
    ) -> tuple[Doubles, Doubles]:
        """Return the features of s."""
        rows, ones = part.rows, np.ones(len(part.rows))
        center = [ones, log_fineness[rows], part.mean(self.values), part.mean(log_fineness)]
        return np.stack(center), np.stack([ones, step[rows]])

    def _stretch_features(
        self, log_fineness: Doubles, s: Doubles, step: Doubles, part: Pass
    ) -> tuple[Doubles, Doubles]:
        """Return the features of l."""
        rows, ones = part.rows, np.ones(len(part.rows))
        center = [ones, log_fineness[rows], s[rows], part.mean(self.values)]
        return np.stack(center), np.stack([ones, step[rows]])
