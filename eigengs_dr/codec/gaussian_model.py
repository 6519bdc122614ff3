"""The probabilities of the integers of a Gaussian, given those that are decoded before.

A number is predicted by a weighted sum of features: its mean over neighbours, other numbers of the
same Gaussian, and how near other Gaussians are. Another weighted sum, of features above 0, gives
the width of the distribution of the error. The encoder finds the weights by least squares and
stores them in the file. Chroma follows luma and the other chroma by the slope that the neighbours
have: this saves a third of the bits of chroma.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .directions import Directions
from .exact_math import log2
from .neighbors import Pass, crowding, passes_of
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
from .weights import MIN_WIDTH, Model, Weights, fit_weights, weighted

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
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
