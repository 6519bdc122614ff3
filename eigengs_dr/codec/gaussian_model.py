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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .exact_math import angle_in_turns, cos_turns, log2, sin_turns
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
from .weights import CLASSES, MIN_WIDTH, Model, Weights, fit_weights, weighted

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

STRIDES = (8, 4, 2, 1)
"""Distances of the passes after the first one, along the curve."""

PLACES = (-3, -1, 1, 3)
"""Known neighbours, in strides."""

COARSE = 16
"""Bound of the number of squares for each Gaussian, where a window counts Gaussians."""


class Pass(NamedTuple):
    """The Gaussians of a pass.

    Attributes
    ----------
    rows : ndarray of int64, shape (n,)
    known : list of ndarray of int64, shape (n,)
        Neighbours that earlier passes coded; empty in the first pass.
    weight : list of ndarray of float64, shape (n,)
        Weights of the neighbours, whose sum is 1: they fall with the square of the distance.
    """

    rows: IntArray
    known: list[IntArray]
    weight: list[Array]

    def mean(self, values: Array) -> Array:
        """Return the weighted means of values (N,) of the neighbours, shape (n,)."""
        total = np.zeros(len(self.rows))
        for known, weight in zip(self.known, self.weight, strict=True):
            total = total + weight * values[known]
        return total


def passes_of(cells: IntArray) -> list[Pass]:
    """Divide Gaussians, in the order of the curve, into passes; cells have the shape (N, 2)."""
    index = np.arange(len(cells))
    passes = [Pass(index[:: 2 * STRIDES[0]], [], [])]
    for stride in STRIDES:
        rows = index[stride :: 2 * stride]
        known, weight = list[IntArray](), list[Array]()
        total = np.zeros(len(rows))
        for place in PLACES:
            other = rows + place * stride
            inside = (other >= 0) & (other < len(cells))
            other = np.clip(other, 0, len(cells) - 1)
            near = np.where(inside, 1 / (squared_distance(cells[rows], cells[other]) + 1), 0)
            known, weight, total = [*known, other], [*weight, near], total + near
        passes.append(Pass(rows, known, [w / total for w in weight]))
    return [found for found in passes if len(found.rows)]


def squared_distance(one: IntArray, other: IntArray) -> Array:
    """Return the squares of the distances of cells (N, 2)."""
    x, y = (one - other).T.astype(np.float64)
    return x * x + y * y


def crowding(cells: IntArray) -> list[Array]:
    """Return logarithms, shape (N,), that tell how near other Gaussians are.

    The numbers of Gaussians in a small and in a large window, and the square of the distance to the
    nearer neighbour along the curve.
    """
    corner = cells.min(axis=0)
    counts = [_count(cells - corner, shift, reach) for shift, reach in ((1, 1), (2, 2))]
    ends = squared_distance(cells[1:], cells[:-1])
    before, after = np.append(ends[:1], ends), np.append(ends, ends[-1:])
    if len(cells) == 1:
        before = after = np.zeros(1)
    return [*map(log2, counts), log2(np.minimum(before, after) + 1)]


def _count(cells: IntArray, shift: int, reach: int) -> Array:
    """Count Gaussians in windows of ``2 reach + 1`` squares a side, of ``2^shift`` cells."""
    while int(np.prod((cells.max(axis=0) >> shift) + 1)) > COARSE * len(cells) + 256:
        shift += 1
    x, y = (cells >> shift).T
    grid = np.zeros((int(y.max()) + 2 * reach + 2, int(x.max()) + 2 * reach + 2), np.int64)
    np.add.at(grid, (y + reach + 1, x + reach + 1), 1)
    sums = grid.cumsum(axis=0).cumsum(axis=1)
    side = 2 * reach + 1
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
    coder : Encoder or Decoder
    passes : list of Pass
    length : ndarray of float64, shape (N,)
        Stretches l.
    turns : ndarray of int64, shape (N,)
        Numbers of directions.
    """

    def __init__(self, coder: Coder, passes: list[Pass], length: Array, turns: IntArray) -> None:
        self.coder, self.passes, self.length, self.turns = coder, passes, length, turns
        self.u, self.v = np.zeros(len(turns)), np.zeros(len(turns))

    def code(self, sharpness: IntArray, given: IntArray | None = None) -> IntArray:
        """Code the directions, integers from 0 to ``turns - 1``."""
        result = np.zeros_like(self.turns)
        for part in self.passes:
            rows = part.rows
            ahead, label = self._look(part)
            turns = self.turns[rows]
            away = None if given is None else (given[rows] - ahead) % turns
            away = self._code_pass(turns, label, sharpness, away)
            result[rows] = (away + ahead) % turns
            self._learn(rows, result[rows])
        return result

    def fit(self, given: IntArray) -> IntArray:
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

    def _learn(self, rows: IntArray, turn: IntArray) -> None:
        angle, length = turn / self.turns[rows], self.length[rows]
        self.u[rows], self.v[rows] = length * cos_turns(angle), length * sin_turns(angle)

    def _look(self, part: Pass) -> tuple[IntArray, IntArray]:
        """Return the directions of the neighbours of a pass, and the classes."""
        u, v = part.mean(self.u), part.mean(self.v)
        ahead = np.rint(angle_in_turns(v, u) * self.turns[part.rows]).astype(np.int64)
        label = np.digitize(self.length[part.rows], LENGTHS) * (len(AGREEMENTS) + 1)
        return ahead, label + np.digitize(np.sqrt(u * u + v * v), AGREEMENTS)

    def _code_pass(
        self, turns: IntArray, labels: IntArray, sharpness: IntArray, given: IntArray | None
    ) -> IntArray:
        """Code directions relative to those of the neighbours."""
        sector, few = np.zeros_like(turns), turns < SECTORS
        wanted = None if given is None else _sector(given, turns)
        for label in np.unique(labels[~few]):
            rows = np.flatnonzero((labels == label) & ~few)
            model = categorical(sector_chances(int(sharpness[label])))
            inside = None if wanted is None else wanted[rows]
            sector[rows] = self.coder.table(model, len(rows), inside)
        first = np.where(few, 0, _first(sector, turns))
        last = np.where(few, turns, _first(sector + 1, turns))
        place = None if given is None else np.where(few, given, (given - first) % turns)
        return (first + self.coder.uniform(last - first, place)) % turns


def _sector(turn: IntArray, turns: IntArray) -> IntArray:
    """Return the sectors of directions relative to those of the neighbours."""
    return (2 * SECTORS * turn + turns) // (2 * turns) % SECTORS


def _first(sector: IntArray, turns: IntArray) -> IntArray:
    """Return the first direction of a sector; of sector 0, it is before that of the neighbours."""
    return -(-(2 * sector - 1) * turns // (2 * SECTORS))


def sector_chances(sharpness: int) -> Array:
    """Return the probabilities of the sectors, up to a factor: highest at 0."""
    away = np.minimum(np.arange(SECTORS), SECTORS - np.arange(SECTORS)) * 0.25
    return np.asarray(1 / (1 + sharpness / SHARPNESS * away * away))


Features = Callable[[Pass], tuple[list[Array], list[Array]]]
"""The features of centres and widths for the Gaussians of a pass."""


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
        self, coder: Coder, cells: IntArray, model: Model | None = None, rich: bool = True
    ) -> None:
        self.coder, self.cells, self.rich = coder, cells, rich
        self.known, self.model = iter(model.weights) if model else None, model or Model()
        self.passes, self.crowding = passes_of(cells), crowding(cells)
        self.values = np.zeros(len(cells))  # of the kind that is being coded, as far as known

    def code(self, channels: int, steps: Steps, given: Symbols | None = None) -> Symbols:
        """Code the numbers; an encoder needs them."""
        color = np.zeros((len(self.cells), channels), np.int64)
        for k in range(channels):
            known = None if given is None else given.color[:, k]
            one = np.ones(len(self.cells))
            color[:, k] = self._numbers(self._color_features(color, k), one, known)
        fineness = precision(color)
        self.bright = log2(fineness)
        step, known = SCALE_STEP / fineness, None if given is None else given.scale
        scale = self._numbers(self._scale_features(step), step, known)
        s = scale * step
        step, known = STRETCH_STEP / fineness, None if given is None else given.stretch
        stretch = self._numbers(self._stretch_features(step, s), step, known)
        length = stretch * step
        turns = turns_of(length, fineness)
        directions = Directions(self.coder, self.passes, length, turns)
        if self.known is None and self.rich and given is not None:
            self.model.sharpness = directions.fit(given.turn)
        turn = directions.code(self.model.sharpness, None if given is None else given.turn)
        parts = parts_of(factors_of(s, length, turn / turns), fineness, steps.cell)
        part = np.zeros_like(self.cells)
        for axis in range(2):
            known = None if given is None else given.part[:, axis]
            part[:, axis] = self.coder.uniform(parts[:, axis], known)
        return Symbols(self.cells, part, color, scale, stretch, turn)

    def _numbers(self, features: Features, step: Array, given: IntArray | None) -> IntArray:
        """Code one kind of numbers, pass by pass."""
        result = np.zeros(len(step), np.int64)
        if self.known is None:
            assert given is not None
            weights = self._fit(features, step, given)
            self.model.weights.append(weights)
        else:
            weights = next(self.known)
        self.values = np.zeros(len(step))
        for part in self.passes:
            centers, widths = features(part)
            rows, unit = part.rows, step[part.rows]
            center = weighted(weights.center, centers) / unit
            width = np.maximum(weighted(weights.width, widths) / unit, MIN_WIDTH)
            known = None if given is None else given[rows]
            result[rows] = self.coder.numbers(center, width, weights.tails, known)
            self.values[rows] = result[rows] * unit
        return result

    def _fit(self, features: Features, step: Array, given: IntArray) -> Weights:
        """Find the weights for numbers that are all known."""
        self.values = given * step
        both = zip(*(features(part) for part in self.passes), strict=True)
        center, width = (
            np.stack([np.concatenate(rows) for rows in zip(*kind, strict=True)], axis=1)
            for kind in both
        )
        order = np.concatenate([part.rows for part in self.passes])
        return fit_weights(center, width, self.values[order], step[order], self.rich)

    def _color_features(self, color: IntArray, k: int) -> Features:
        """Return the features of channel k: the channel near by, and the two channels before it."""
        before = [color[:, j].astype(np.float64) for j in range(max(0, k - 2), k)]

        def features(part: Pass) -> tuple[list[Array], list[Array]]:
            rows, here = part.rows, self.values
            center, width = [part.mean(here)], [np.ones(len(rows)), part.mean(np.abs(here))]
            for other in before:
                slope = part.mean(other * here) / (part.mean(other * other) + 1)
                center += [other[rows], slope * other[rows]]
                width += [np.abs(other[rows]), np.abs(part.mean(other))]
            return center, [*width, *(values[rows] for values in self.crowding[:2])]

        return features

    def _scale_features(self, step: Array) -> Features:
        """Return the features of s: small Gaussians are where many are."""

        def features(part: Pass) -> tuple[list[Array], list[Array]]:
            rows, one = part.rows, np.ones(len(part.rows))
            center = [one, self.bright[rows], *(values[rows] for values in self.crowding)]
            return [*center, part.mean(self.values), part.mean(self.bright)], [one, step[rows]]

        return features

    def _stretch_features(self, step: Array, s: Array) -> Features:
        """Return the features of l."""

        def features(part: Pass) -> tuple[list[Array], list[Array]]:
            rows, one = part.rows, np.ones(len(part.rows))
            center = [one, self.bright[rows], s[rows], self.crowding[1][rows]]
            return [*center, part.mean(self.values)], [one, step[rows]]

        return features
