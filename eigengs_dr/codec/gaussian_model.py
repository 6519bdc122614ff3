"""The probabilities of the integers of a Gaussian, given those that are decoded before.

A number is predicted by a weighted sum of features: its mean over neighbours, other numbers of the
same Gaussian, and how near other Gaussians are. Another weighted sum, of features above 0, gives
the width of the distribution of the error. The encoder finds the weights by least squares and
stores them in the file. Chroma follows luma and the other chroma by the slope that the neighbours
have: this saves a third of the bits of chroma.

Gaussians are in the order of a Hilbert curve through their cells. Their parameters are coded in
passes: every 16th Gaussian, then those half way between, and so on. So each Gaussian but the first
ones has known neighbours on both sides, and a pass takes few calls. All numbers here are the same
on every machine, see `eigengs_dr.codec.exact_math`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from ..backend.types import Doubles, Integers
from .exact_math import angle_in_turns, cos_turns, in_order, log2, sin_turns
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
from .range_coder import Coder, categorical
from .weights import CLASSES, MIN_WIDTH, Model, Weights, fit_weights

STRIDES = (8, 4, 2, 1)
"""Distances of the passes after the first one, along the curve."""

PLACES = np.array([-3, -1, 1, 3])
"""Known neighbours, in strides."""

COARSE = 16
"""Bound of the number of squares for each Gaussian, where a window counts Gaussians."""


class Pass(NamedTuple):
    """The Gaussians of a pass.

    Attributes
    ----------
    rows : ndarray of int64, shape (n,)
    known : ndarray of int64, shape (K, n)
        Neighbours that earlier passes coded; none in the first pass.
    weight : ndarray of float64, shape (K, n)
        Weights of the neighbours, whose sum is 1: they fall with the square of the distance.
    """

    rows: Integers
    known: Integers
    weight: Doubles

    def mean(self, values: Doubles) -> Doubles:
        """Return the weighted means of values (N,) of the neighbours, shape (n,)."""
        return in_order(self.weight * values[self.known])


def passes_of(cells: Integers) -> list[Pass]:
    """Divide Gaussians, in the order of the curve, into passes; cells have the shape (N, 2)."""
    index = np.arange(len(cells))
    first = index[:: 2 * STRIDES[0]]
    passes = [Pass(first, np.zeros((0, len(first)), np.int64), np.zeros((0, len(first))))]
    for stride in STRIDES:
        rows = index[stride :: 2 * stride]
        other = rows + stride * PLACES[:, None]
        inside = (other >= 0) & (other < len(cells))
        other = np.clip(other, 0, len(cells) - 1)
        near = np.where(inside, 1 / (squared_distance(cells[rows], cells[other]) + 1), 0)
        passes.append(Pass(rows, other, near / in_order(near)))
    return [found for found in passes if len(found.rows)]


def squared_distance(one: Integers, other: Integers) -> Doubles:
    """Return the squares of the distances of cells, shape (..., 2)."""
    away = (one - other).astype(np.float64)
    return away[..., 0] * away[..., 0] + away[..., 1] * away[..., 1]


def crowding(cells: Integers) -> list[Doubles]:
    """Return logarithms, shape (N,), that tell how near other Gaussians are.

    The numbers of Gaussians in a small and in a large window, and the square of the distance to the
    nearer neighbour along the curve.
    """
    counts = [_count(cells - cells.min(axis=0), reach) for reach in (1, 2)]
    ends = np.pad(squared_distance(cells[1:], cells[:-1]), 1, constant_values=np.inf)
    nearer = np.minimum(ends[1:], ends[:-1]) if len(cells) > 1 else np.zeros(1)
    return [*map(log2, counts), log2(nearer + 1)]


def _count(cells: Integers, reach: int) -> Doubles:
    """Count Gaussians in windows of ``2 reach + 1`` squares, of ``2^reach`` cells or more."""
    shift, side = reach, 2 * reach + 1
    while int(np.prod((cells.max(axis=0) >> shift) + 1)) > COARSE * len(cells) + 256:
        shift += 1
    x, y = (cells >> shift).T
    grid = np.zeros((int(y.max()) + side + 1, int(x.max()) + side + 1), np.int64)
    np.add.at(grid, (y + reach + 1, x + reach + 1), 1)
    sums = grid.cumsum(axis=0).cumsum(axis=1)
    inside = sums[y + side, x + side] - sums[y, x + side] - sums[y + side, x] + sums[y, x]
    return inside.astype(np.float64)


SECTORS = 16
"""Number of sectors; Gaussians with fewer directions have no sectors."""

LENGTHS, AGREEMENTS = (0.5, 1.0), (0.1, 0.25, 0.5, 1.0)
"""Bounds of the classes: by the stretch l, and by the mean vector of the neighbours."""

SHARPNESS = 16
"""A class stores its sharpness times this number, in a byte."""


class Directions:
    """Coding of the directions of all Gaussians of a section, which are near those of neighbours.

    A direction is one of K, and K depends on the Gaussian. The full turn has 16 sectors; the
    direction of the neighbours is in the middle of sector 0. A sector has a probability that falls
    with its distance from sector 0, faster for long Gaussians and for neighbours that agree. In a
    sector, all directions have one probability.

    Parameters
    ----------
    passes : list of Pass
    length : ndarray of float64, shape (N,)
        Stretches l.
    turns : ndarray of int64, shape (N,)
        Numbers of directions.
    """

    def __init__(self, passes: list[Pass], length: Doubles, turns: Integers) -> None:
        self.passes, self.length, self.turns = passes, length, turns
        self.u, self.v = np.zeros(len(turns)), np.zeros(len(turns))

    def code(self, coder: Coder, sharpness: Integers, given: Integers) -> Integers:
        """Code the directions, integers from 0 to ``turns - 1``."""
        result = np.zeros_like(self.turns)
        for part in self.passes:
            rows, turns = part.rows, self.turns[part.rows]
            ahead, label = self._look(part)
            away = _code_pass(coder, turns, label, sharpness, (given[rows] - ahead) % turns)
            result[rows] = (away + ahead) % turns
            self._learn(rows, result[rows])
        return result

    def fit(self, given: Integers) -> Integers:
        """Return the sharpness of each class for which directions take the fewest bits."""
        self._learn(np.arange(len(given)), given)
        chances = np.stack([sector_chances(k) for k in range(256)])
        bits = -np.log2(chances / chances.sum(axis=1, keepdims=True))
        counts = np.zeros((CLASSES, SECTORS))
        for part in self.passes:
            ahead, label = self._look(part)
            turns = self.turns[part.rows]
            many = turns >= SECTORS
            sector = _sector((given[part.rows] - ahead) % turns, turns)
            np.add.at(counts, (label[many], sector[many]), 1)
        return np.asarray((counts @ bits.T).argmin(axis=1))

    def _learn(self, rows: Integers, turn: Integers) -> None:
        angle, length = turn / self.turns[rows], self.length[rows]
        self.u[rows], self.v[rows] = length * cos_turns(angle), length * sin_turns(angle)

    def _look(self, part: Pass) -> tuple[Integers, Integers]:
        """Return the directions of the neighbours of a pass, and the classes."""
        u, v = part.mean(self.u), part.mean(self.v)
        ahead = np.rint(angle_in_turns(v, u) * self.turns[part.rows]).astype(np.int64)
        label = np.digitize(self.length[part.rows], LENGTHS) * (len(AGREEMENTS) + 1)
        return ahead, label + np.digitize(np.sqrt(u * u + v * v), AGREEMENTS)


def _code_pass(
    coder: Coder, turns: Integers, labels: Integers, sharpness: Integers, given: Integers
) -> Integers:
    """Code directions relative to those of the neighbours."""
    sector, few = np.zeros_like(turns), turns < SECTORS
    wanted = _sector(given, turns)
    for label in np.unique(labels[~few]):
        rows = np.flatnonzero((labels == label) & ~few)
        model = categorical(sector_chances(int(sharpness[label])))
        sector[rows] = coder.code(model, wanted[rows])
    first = np.where(few, 0, _first(sector, turns))
    last = np.where(few, turns, _first(sector + 1, turns))
    place = np.where(few, given, (given - first) % turns)
    return (first + coder.uniform(last - first, place)) % turns


def _sector(turn: Integers, turns: Integers) -> Integers:
    """Return the sectors of directions relative to those of the neighbours."""
    return (2 * SECTORS * turn + turns) // (2 * turns) % SECTORS


def _first(sector: Integers, turns: Integers) -> Integers:
    """Return the first direction of a sector; of sector 0, it is before that of the neighbours."""
    return -(-(2 * sector - 1) * turns // (2 * SECTORS))


def sector_chances(sharpness: int) -> Doubles:
    """Return the probabilities of the sectors, up to a factor: highest at 0."""
    away = np.minimum(np.arange(SECTORS), SECTORS - np.arange(SECTORS)) * 0.25
    return np.asarray(1 / (1 + sharpness / SHARPNESS * away * away))


Features = Callable[[Pass], tuple[Doubles, Doubles]]
"""The features of centres and of widths, shape (F, n), for the n Gaussians of a pass."""


class GaussianCoder:
    """Coding of all numbers of the Gaussians of a section but their cells.

    Parameters
    ----------
    coder : Encoder or Decoder
    cells : ndarray of int64, shape (N, 2)
        In the order of the curve.
    model : Model, optional
        None for an encoder, which finds one; the attribute `model` then holds it.
    rich : bool, optional
        Whether the encoder may use all features.
    """

    def __init__(
        self, coder: Coder, cells: Integers, model: Model | None = None, rich: bool = True
    ) -> None:
        self.coder, self.cells, self.rich = coder, cells, rich
        self.known, self.model = iter(model.weights) if model else None, model or Model()
        self.passes, self.crowding = passes_of(cells), crowding(cells)
        self.values = np.zeros(len(cells))  # of the kind that is being coded, as far as known

    def code(self, given: Symbols, steps: Steps) -> Symbols:
        """Code the numbers; a decoder takes their shapes only."""
        color, one = np.zeros_like(given.color), np.ones(len(self.cells))
        for k, values in enumerate(given.color.T):
            color[:, k] = self._numbers(partial(self._color_features, color, k), one, values)
        fineness = precision(color)
        bright, step = log2(fineness), SCALE_STEP / fineness
        scale = self._numbers(partial(self._scale_features, bright, step), step, given.scale)
        s, step = scale * step, STRETCH_STEP / fineness
        features = partial(self._stretch_features, bright, s, step)
        stretch = self._numbers(features, step, given.stretch)
        length = stretch * step
        directions = Directions(self.passes, length, turns_of(length, fineness))
        if self.known is None and self.rich:
            self.model.sharpness = directions.fit(given.turn)
        turn = directions.code(self.coder, self.model.sharpness, given.turn)
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
            result[rows] = self.coder.numbers(center, width, weights.tails, given[rows])
            self.values[rows] = result[rows] * unit
        return result

    def _fit(self, features: Features, step: Doubles, given: Integers) -> Weights:
        """Find the weights for numbers that are all known, and note them in the model."""
        self.values = given * step
        both = zip(*(features(part) for part in self.passes), strict=True)
        center, width = (np.ascontiguousarray(np.concatenate(kind, axis=1).T) for kind in both)
        order = np.concatenate([part.rows for part in self.passes])
        found = fit_weights(center, width, self.values[order], step[order], self.rich)
        self.model.weights.append(found)
        return found

    def _color_features(self, color: Integers, k: int, part: Pass) -> tuple[Doubles, Doubles]:
        """Return the features of channel k: the channel near by, and the two channels before it."""
        rows, here = part.rows, self.values
        center, width = [part.mean(here)], [np.ones(len(rows)), part.mean(np.abs(here))]
        for other in color.T[max(0, k - 2) : k].astype(np.float64):
            slope = part.mean(other * here) / (part.mean(other * other) + 1)
            center += [other[rows], slope * other[rows]]
            width += [np.abs(other[rows]), np.abs(part.mean(other))]
        return np.stack(center), np.stack([*width, *(near[rows] for near in self.crowding[:2])])

    def _scale_features(
        self, bright: Doubles, step: Doubles, part: Pass
    ) -> tuple[Doubles, Doubles]:
        """Return the features of s: small Gaussians are where many are."""
        rows, one = part.rows, np.ones(len(part.rows))
        center = [one, bright[rows], *(near[rows] for near in self.crowding)]
        center += [part.mean(self.values), part.mean(bright)]
        return np.stack(center), np.stack([one, step[rows]])

    def _stretch_features(
        self, bright: Doubles, s: Doubles, step: Doubles, part: Pass
    ) -> tuple[Doubles, Doubles]:
        """Return the features of l."""
        rows, one = part.rows, np.ones(len(part.rows))
        center = [one, bright[rows], s[rows], self.crowding[1][rows], part.mean(self.values)]
        return np.stack(center), np.stack([one, step[rows]])
