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
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from ..backend.types import Doubles, Integers
from ..storage.npz import BadValue
from .exact_math import angle_in_turns, cos_turns, log2, sin_turns, sum_in_order
from .quantization import Quantizer, Steps, Symbols
from .range_coder import TAILS, Coder, categorical

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
        return sum_in_order(self.weight * values[self.known])


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
        passes.append(Pass(rows, known, weight / sum_in_order(weight)))
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


# --- What a section stores -----------------------------------------------------------------------

MIN_WIDTH = 0.1
"""Smallest width of a distribution, in steps."""

WIDTH_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2)
"""Factors of the mean absolute error that are tried as the width."""

CLASSES = 15
"""Number of classes of directions, see `Directions`."""

MIN_RICH_COUNT = 1500
"""Number of Gaussians below which all weights may take more bytes than they save."""


class Prediction(NamedTuple):
    """The prediction of one kind of numbers.

    Attributes
    ----------
    center, width : ndarray of float64
        Weights of the features.
    tails : int
        One of `eigengs_dr.codec.range_coder.TAILS`.
    """

    center: Doubles
    width: Doubles
    tails: int


@dataclass
class SectionModel:
    """All parameters that a section stores besides the integers.

    Attributes
    ----------
    predictions : list of Prediction
        For each channel, for the scale, and for the stretch.
    sharpness : ndarray of int64, shape (CLASSES,)
        Concentration of directions around those of the neighbours, from 0 to 255.
    """

    predictions: list[Prediction] = field(default_factory=list)
    sharpness: Integers = field(default_factory=lambda: np.zeros(CLASSES, np.int64))

    def to_bytes(self, rich: bool) -> bytes:
        """Return the bytes of a model; if it is not rich, only of the first weights."""
        used, parts = slice(None) if rich else slice(0, 1), list[bytes]()
        for center, width, tails in self.predictions:
            high = width[used].astype("<f2").view("<u2") >> 8
            parts.append(bytes([TAILS.index(tails)]))
            parts += [center[used].astype("<f2").tobytes(), high.astype(np.uint8).tobytes()]
        if rich:
            parts.append(self.sharpness.astype(np.uint8).tobytes())
        return b"".join(parts)

    @classmethod
    def from_bytes(cls, data: bytes, channels: int, rich: bool) -> tuple[SectionModel, bytes]:
        """Return a model and the bytes after it; the bytes need not be trusted."""
        model = cls()

        def take(count: int) -> bytes:
            nonlocal data
            if count > len(data):
                raise BadValue("the weights are truncated")
            taken, data = data[:count], data[count:]
            return taken

        for numbers in feature_counts(channels):
            used = numbers if rich else (1, 1)
            [tails] = take(1)
            if tails >= len(TAILS):
                raise BadValue("the weights name an unknown distribution")
            center, width = np.zeros(numbers[0]), np.zeros(numbers[1])
            center[: used[0]] = np.frombuffer(take(2 * used[0]), "<f2")
            high = np.frombuffer(take(used[1]), np.uint8).astype("<u2") << 8
            width[: used[1]] = high.view("<f2")
            model.predictions.append(Prediction(center, width, TAILS[tails]))
        if rich:
            model.sharpness = np.frombuffer(take(CLASSES), np.uint8).astype(np.int64)
        return model, data


def feature_counts(channels: int) -> list[tuple[int, int]]:
    """Return the number of features of the centre and of the width, for each `Prediction`."""
    colors = [(1 + 2 * min(k, 2), 4 + 2 * min(k, 2)) for k in range(channels)]
    return [*colors, (7, 2), (5, 2)]


def fit_prediction(
    center: Doubles, width: Doubles, values: Doubles, step: Doubles, rich: bool = True
) -> Prediction:
    """Return the prediction with which the numbers take few bits.

    Parameters
    ----------
    center, width : ndarray, shape (N, F)
        Features of the centre and of the width of each distribution.
    values, step : ndarray, shape (N,)
        The numbers, which are multiples of the steps.
    rich : bool, optional
        Whether all weights may differ from 0, or only the first one of each.
    """
    width_weights, deviation = np.zeros(width.shape[1]), np.maximum(step, 1e-9)
    used = slice(None) if rich else slice(0, 1)
    center_weights = np.zeros(center.shape[1])
    for _ in range(3):
        scaled = center[:, used] / deviation[:, None]
        ridge = 1e-3 * len(values) ** 0.5 * np.eye(scaled.shape[1])
        known = np.append(values / deviation, np.zeros(len(ridge)))
        solution = np.linalg.lstsq(np.vstack([scaled, ridge]), known, rcond=None)[0]
        center_weights[used] = stored_center(solution)
        error = values - sum_in_order(center_weights[:, None] * center.T)
        width_weights[used] = _fit_width(width[:, used], np.abs(error) + 0.1 * step, deviation)
        deviation = np.maximum(sum_in_order(width_weights[:, None] * width.T), MIN_WIDTH * step)
    trials = [(w, tails) for tails in TAILS for w in WIDTH_FACTORS]
    best = min(trials, key=lambda trial: _bits(error / step, trial[0] * deviation / step, trial[1]))
    return Prediction(center_weights, stored_width(width_weights * best[0]), best[1])


def _fit_width(features: Doubles, error: Doubles, deviation: Doubles) -> Doubles:
    """Return non-negative weights of features whose weighted sum approximates absolute errors."""
    from scipy.optimize import nnls  # imported here, because decoders do not need it

    return np.asarray(nnls(features / deviation[:, None], error / deviation)[0])


def _bits(error: Doubles, width: Doubles, tails: int) -> float:
    """Estimate the bits that errors, in steps, take with a distribution."""
    t = error / width
    density = np.log2(width) + 0.5 * (tails + 1) * np.log2(1 + t * t / tails)
    return float(density.sum()) + len(t) * {2: 1.5, 4: 1.415, 8: 1.369}[tails]


def stored_center(weights: Doubles) -> Doubles:
    """Round weights to half precision, as in files."""
    return np.clip(np.nan_to_num(weights), -6e4, 6e4).astype(np.float16).astype(np.float64)


def stored_width(weights: Doubles) -> Doubles:
    """Round positive weights to half precision with a mantissa of two bits, as in files."""
    half = np.clip(np.nan_to_num(weights), 0, 4e4).astype("<f2").view("<u2")
    return ((half + 0x80) & 0xFF00).astype("<u2").view("<f2").astype(np.float64)


# --- The coder -----------------------------------------------------------------------------------

Features = Callable[[Pass], tuple[Doubles, Doubles]]
"""Returns the features of centres and of widths, shape (F, n), for the n Gaussians of a pass."""


class GaussianCoder:
    """Coding of all numbers of the Gaussians of a section, except their cells.

    Parameters
    ----------
    coder : Encoder or Decoder
    cells : ndarray of int64, shape (N, 2)
        In the order of the curve.
    model : SectionModel, optional
        None for an encoder, which fits a model and stores it in the attribute `model`.
    rich : bool, optional
        Whether the encoder uses all features.
    """

    def __init__(
        self, coder: Coder, cells: Integers, model: SectionModel | None = None, rich: bool = True
    ) -> None:
        self.coder, self.cells, self.rich = coder, cells, rich
        self.known = iter(model.predictions) if model else None
        self.model = model or SectionModel()
        self.passes, self.crowding = passes_of(cells), crowding(cells)
        self.values = np.zeros(len(cells))  # known values of the kind that is being coded

    def code(self, given: Symbols, steps: Steps) -> Symbols:
        """Code the numbers; a decoder uses only their shapes."""
        color, ones = np.zeros_like(given.color), np.ones(len(self.cells))
        for k, values in enumerate(given.color.T):
            color[:, k] = self._numbers(partial(self._color_features, color, k), ones, values)
        quantizer = Quantizer(color, steps.cell)
        log_q, step = log2(quantizer.precision), quantizer.scale_step
        scale = self._numbers(partial(self._scale_features, log_q, step), step, given.scale)
        s, step = scale * step, quantizer.stretch_step
        features = partial(self._stretch_features, log_q, s, step)
        stretch = self._numbers(features, step, given.stretch)
        length = stretch * step
        directions = Directions(self.passes, length, quantizer.turns(length))
        if self.known is None and self.rich:
            self.model.sharpness = directions.fit(given.turn)
        turn = directions.code(self.coder, self.model.sharpness, given.turn)
        parts = quantizer.parts(quantizer.factors(scale, stretch, turn))
        place = [self.coder.uniform(parts[:, axis], given.part[:, axis]) for axis in range(2)]
        return Symbols(self.cells, np.stack(place, axis=1), color, scale, stretch, turn)

    def _numbers(self, features: Features, step: Doubles, given: Integers) -> Integers:
        """Code one kind of numbers, pass by pass."""
        result = np.zeros_like(given)
        center_weights, width_weights, tails = (
            next(self.known) if self.known else self._fit(features, step, given)
        )
        self.values = np.zeros(len(step))
        for part in self.passes:
            centers, widths = features(part)
            rows, unit = part.rows, step[part.rows]
            center = sum_in_order(center_weights[:, None] * centers) / unit
            width = np.maximum(sum_in_order(width_weights[:, None] * widths) / unit, MIN_WIDTH)
            result[rows] = self.coder.numbers(center, width, tails, given[rows])
            self.values[rows] = result[rows] * unit
        return result

    def _fit(self, features: Features, step: Doubles, given: Integers) -> Prediction:
        """Fit a prediction to numbers that are all known, and store it in the model."""
        self.values = given * step
        pairs = zip(*(features(part) for part in self.passes), strict=True)
        center, width = (np.ascontiguousarray(np.concatenate(kind, axis=1).T) for kind in pairs)
        order = np.concatenate([part.rows for part in self.passes])
        found = fit_prediction(center, width, self.values[order], step[order], self.rich)
        self.model.predictions.append(found)
        return found

    def _color_features(self, color: Integers, k: int, part: Pass) -> tuple[Doubles, Doubles]:
        """Return the features of channel k: its neighbours, and the two channels before it."""
        rows, values = part.rows, self.values
        center, width = [part.mean(values)], [np.ones(len(rows)), part.mean(np.abs(values))]
        for other in color.T[max(0, k - 2) : k].astype(np.float64):
            slope = part.mean(other * values) / (part.mean(other * other) + 1)
            center += [other[rows], slope * other[rows]]
            width += [np.abs(other[rows]), np.abs(part.mean(other))]
        return np.stack(center), np.stack([*width, *(near[rows] for near in self.crowding[:2])])

    def _scale_features(self, log_q: Doubles, step: Doubles, part: Pass) -> tuple[Doubles, Doubles]:
        """Return the features of s: Gaussians are small where they are dense."""
        rows, ones = part.rows, np.ones(len(part.rows))
        center = [ones, log_q[rows], *(near[rows] for near in self.crowding)]
        center += [part.mean(self.values), part.mean(log_q)]
        return np.stack(center), np.stack([ones, step[rows]])

    def _stretch_features(
        self, log_q: Doubles, s: Doubles, step: Doubles, part: Pass
    ) -> tuple[Doubles, Doubles]:
        """Return the features of l."""
        rows, ones = part.rows, np.ones(len(part.rows))
        center = [
            ones,
            log_q[rows],
            s[rows],
            self.crowding[1][rows],
            part.mean(self.values),
        ]
        return np.stack(center), np.stack([ones, step[rows]])
