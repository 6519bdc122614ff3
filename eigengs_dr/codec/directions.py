"""The directions of Gaussians, which are near those of their neighbours: along edges.

A direction is one of K, and K depends on the Gaussian. The full turn has 16 sectors; the direction
of the neighbours is in the middle of sector 0. A sector has a probability that falls with its
distance from sector 0, faster for long Gaussians and for neighbours that agree. In a sector, all
directions have one probability.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .exact_math import angle_in_turns, cos_turns, sin_turns
from .neighbors import Pass
from .range_coder import Coder, categorical
from .weights import CLASSES

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SECTORS = 16
"""Number of sectors; Gaussians with fewer directions have no sectors."""

LENGTHS, AGREEMENTS = (0.5, 1.0), (0.1, 0.25, 0.5, 1.0)
"""Bounds of the classes: by the stretch l, and by the mean vector of the neighbours."""

SHARPNESS = 16
"""A class stores its sharpness times this number, in a byte."""


class Directions:
    """Coding of the directions of all Gaussians of a section.

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
