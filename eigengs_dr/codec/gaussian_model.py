"""The probabilities of the integers of a Gaussian, given those that were decoded before.

A number is predicted by a weighted sum of features: its mean over neighbours, other numbers of the
same Gaussian, and the density of Gaussians. Another weighted sum, of positive features, gives the
width of the distribution of the error. The encoder fits the weights by least squares and stores
them in the file. Chroma is predicted from luma and from the other chroma by the regression slope of
the neighbours, which saves a third of the bits of chroma.

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
"""Distances along the curve, in Gaussians, of the passes after the first one."""

NEIGHBOUR_OFFSETS = np.array([-3, -1, 1, 3])
"""Positions of the known neighbours, in strides."""

MAX_SQUARES_PER_GAUSSIAN = 16
"""Largest number of squares per Gaussian in the grid that counts Gaussians."""


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


def crowding(cells: Integers) -> list[Doubles]:
    """Return logarithms, shape (N,), that measure the density of Gaussians.

    These are of the numbers of Gaussians in a small and in a large window, and of the squared
    distance to the nearer neighbour along the curve.
    """
    counts = [_count(cells - cells.min(axis=0), reach) for reach in (1, 2)]
    ends = np.pad(squared_distance(cells[1:], cells[:-1]), 1, constant_values=np.inf)
    nearer = np.minimum(ends[1:], ends[:-1]) if len(cells) > 1 else np.zeros(1)
    return [*map(log2, counts), log2(nearer + 1)]


def _count(cells: Integers, reach: int) -> Doubles:
    """Count Gaussians in windows of ``2 reach + 1`` squares, of ``2^reach`` cells or more."""
    shift, side = reach, 2 * reach + 1
    limit = MAX_SQUARES_PER_GAUSSIAN * len(cells) + 256
    while int(np.prod((cells.max(axis=0) >> shift) + 1)) > limit:
        shift += 1
    x, y = (cells >> shift).T
    grid = np.zeros((int(y.max()) + side + 1, int(x.max()) + side + 1), np.int64)
    np.add.at(grid, (y + reach + 1, x + reach + 1), 1)
    sums = grid.cumsum(axis=0).cumsum(axis=1)
    inside = sums[y + side, x + side] - sums[y, x + side] - sums[y + side, x] + sums[y, x]
    return inside.astype(np.float64)


SECTORS = 16
"""Number of sectors of directions; Gaussians with fewer directions have no sectors."""

LENGTHS, AGREEMENTS = (0.5, 1.0), (0.1, 0.25, 0.5, 1.0)
"""Bounds of the classes of directions: by the stretch l, and by the length of the mean vector of
the neighbours."""

SHARPNESS_SCALE = 16
"""Factor of the sharpness of a class as it is stored, in a byte."""


class Directions:
    """Coding of the directions of all Gaussians of a section, relative to those of neighbours.

    A Gaussian has one of K directions, where K depends on the Gaussian. The full turn is divided
    into 16 sectors; the direction of the neighbours is in the middle of sector 0. The probability
    of a sector decreases with its distance from sector 0, faster for elongated Gaussians and for
    neighbours that agree. Within a sector, all directions are equally probable.

    Parameters
    ----------
    passes : list of Pass
    length : ndarray of float64, shape (N,)
        Stretches l.
    turns : ndarray of int64, shape (N,)
        Number of directions of each Gaussian.
    """

    def __init__(self, passes: list[Pass], length: Doubles, turns: Integers) -> None:
        self.passes, self.length, self.turns = passes, length, turns
        self.u, self.v = np.zeros(len(turns)), np.zeros(len(turns))

    def code(self, coder: Coder, sharpness: Integers, given: Integers) -> Integers:
        """Code the directions, integers from 0 to ``turns - 1``."""
        result = np.zeros_like(self.turns)
        for part in self.passes:
            rows, turns = part.rows, self.turns[part.rows]
            predicted, label = self._predict(part)
            offset = _code_pass(coder, turns, label, sharpness, (given[rows] - predicted) % turns)
            result[rows] = (offset + predicted) % turns
            self._update(rows, result[rows])
        return result

    def fit(self, given: Integers) -> Integers:
        """Return the sharpness of each class with which directions take the fewest bits."""
        self._update(np.arange(len(given)), given)
        chances = np.stack([sector_chances(k) for k in range(256)])
        bits = -np.log2(chances / chances.sum(axis=1, keepdims=True))
        counts = np.zeros((CLASSES, SECTORS))
        for part in self.passes:
            predicted, label = self._predict(part)
            turns = self.turns[part.rows]
            has_sectors = turns >= SECTORS
            sector = _sector((given[part.rows] - predicted) % turns, turns)
            np.add.at(counts, (label[has_sectors], sector[has_sectors]), 1)
        return np.asarray((counts @ bits.T).argmin(axis=1))

    def _update(self, rows: Integers, turn: Integers) -> None:
        """Store the direction vectors of coded Gaussians."""
        angle, length = turn / self.turns[rows], self.length[rows]
        self.u[rows], self.v[rows] = length * cos_turns(angle), length * sin_turns(angle)

    def _predict(self, part: Pass) -> tuple[Integers, Integers]:
        """Return the mean directions of the neighbours of a pass, and the classes."""
        u, v = part.mean(self.u), part.mean(self.v)
        predicted = np.rint(angle_in_turns(v, u) * self.turns[part.rows]).astype(np.int64)
        label = np.digitize(self.length[part.rows], LENGTHS) * (len(AGREEMENTS) + 1)
        return predicted, label + np.digitize(np.sqrt(u * u + v * v), AGREEMENTS)


def _code_pass(
    coder: Coder, turns: Integers, labels: Integers, sharpness: Integers, given: Integers
) -> Integers:
    """Code directions relative to those of the neighbours."""
    sector, few = np.zeros_like(turns), turns < SECTORS
    given_sector = _sector(given, turns)
    for label in np.unique(labels[~few]):
        rows = np.flatnonzero((labels == label) & ~few)
        model = categorical(sector_chances(int(sharpness[label])))
        sector[rows] = coder.code(model, given_sector[rows])
    first = np.where(few, 0, _first(sector, turns))
    last = np.where(few, turns, _first(sector + 1, turns))
    place = np.where(few, given, (given - first) % turns)
    return (first + coder.uniform(last - first, place)) % turns


def _sector(turn: Integers, turns: Integers) -> Integers:
    """Return the sectors of directions relative to those of the neighbours."""
    return (2 * SECTORS * turn + turns) // (2 * turns) % SECTORS


def _first(sector: Integers, turns: Integers) -> Integers:
    """Return the first direction of a sector; that of sector 0 is below 0."""
    return -(-(2 * sector - 1) * turns // (2 * SECTORS))


def sector_chances(sharpness: int) -> Doubles:
    """Return the probabilities of the sectors, up to a factor; sector 0 has the highest."""
    distance = np.minimum(np.arange(SECTORS), SECTORS - np.arange(SECTORS)) * 0.25
    return np.asarray(1 / (1 + sharpness / SHARPNESS_SCALE * distance * distance))


Features = Callable[[Pass], tuple[Doubles, Doubles]]
"""Returns the features of centres and of widths, shape (F, n), for the n Gaussians of a pass."""


class GaussianCoder:
    """Coding of all numbers of the Gaussians of a section, except their cells.

    Parameters
    ----------
    coder : Encoder or Decoder
    cells : ndarray of int64, shape (N, 2)
        In the order of the curve.
    model : Model, optional
        None for an encoder, which fits a model and stores it in the attribute `model`.
    rich : bool, optional
        Whether the encoder uses all features.
    """

    def __init__(
        self, coder: Coder, cells: Integers, model: Model | None = None, rich: bool = True
    ) -> None:
        self.coder, self.cells, self.rich = coder, cells, rich
        self.known, self.model = iter(model.weights) if model else None, model or Model()
        self.passes, self.crowding = passes_of(cells), crowding(cells)
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
        """Fit the weights to numbers that are all known, and store them in the model."""
        self.values = given * step
        pairs = zip(*(features(part) for part in self.passes), strict=True)
        center, width = (np.ascontiguousarray(np.concatenate(kind, axis=1).T) for kind in pairs)
        order = np.concatenate([part.rows for part in self.passes])
        weights = fit_weights(center, width, self.values[order], step[order], self.rich)
        self.model.weights.append(weights)
        return weights

    def _color_features(self, color: Integers, k: int, part: Pass) -> tuple[Doubles, Doubles]:
        """Return the features of channel k: its neighbours, and the two channels before it."""
        rows, values = part.rows, self.values
        center, width = [part.mean(values)], [np.ones(len(rows)), part.mean(np.abs(values))]
        for other in color.T[max(0, k - 2) : k].astype(np.float64):
            slope = part.mean(other * values) / (part.mean(other * other) + 1)
            center += [other[rows], slope * other[rows]]
            width += [np.abs(other[rows]), np.abs(part.mean(other))]
        return np.stack(center), np.stack([*width, *(near[rows] for near in self.crowding[:2])])

    def _scale_features(
        self, log_fineness: Doubles, step: Doubles, part: Pass
    ) -> tuple[Doubles, Doubles]:
        """Return the features of s: Gaussians are small where they are dense."""
        rows, ones = part.rows, np.ones(len(part.rows))
        center = [ones, log_fineness[rows], *(near[rows] for near in self.crowding)]
        center += [part.mean(self.values), part.mean(log_fineness)]
        return np.stack(center), np.stack([ones, step[rows]])

    def _stretch_features(
        self, log_fineness: Doubles, s: Doubles, step: Doubles, part: Pass
    ) -> tuple[Doubles, Doubles]:
        """Return the features of l."""
        rows, ones = part.rows, np.ones(len(part.rows))
        center = [ones, log_fineness[rows], s[rows], self.crowding[1][rows], part.mean(self.values)]
        return np.stack(center), np.stack([ones, step[rows]])
