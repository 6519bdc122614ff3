"""From coarse to fine: the picture that a loss asks for, before any Gaussian has a place.

A pyramid of texels descends on the loss: each level is added to the next coarser sum at twice its
size (Weier et al. 2025, doi 10.1145/3730855), so coarse levels move many texels at once.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import drjit as dr
import numpy as np

from ..backend.arrays import types_of
from ..backend.recording import freeze_program
from ..backend.types import Float, UInt
from .loss import LossObjective
from .method import DEFAULT
from .place import Adaptive
from .state import Adam, Optimizer

LEAST_SIDE = 4
"""Smallest length of the shorter side of the coarsest level, in texels."""


NOISY = Adam(0.5, 0.999, 1e-8)
"""Adam for derivatives with the noise of a rendering."""


@dataclass(frozen=True)
class Coarse(Adaptive):
    """Places Gaussians by the picture that a pyramid of texels finds for a loss.

    With an image, it places as `Adaptive` does.

    Attributes
    ----------
    share : float
        Share of the iterations that the pyramid takes, in [0, 1].
    rate : float
        Largest learning rate of its levels, relative to the range of the picture.
    decay : float
        Fraction of the rate at the end, after half a cosine.
    optimizer : Optimizer
    fit_steps : int
        Steps of a fit of its picture, which do not call the loss.
    """

    share: float = 0.5
    rate: float = 0.005
    decay: float = 0.05
    optimizer: Optimizer = NOISY
    fit_steps: int = 150


COARSE_TO_FINE = replace(
    DEFAULT,
    place=Coarse(),
    controls=(),
    optimizer=NOISY,
    rates={"mean": 0.0125, "factor": 0.0075, "color": 0.0009},
    decay=1.0,
    rate_exponent=0.0,
    average=0.8,
)
"""The method of a loss without an image: a pyramid of texels, then Gaussians that move little, for
derivatives with the noise of a rendering. The rates were chosen on the scenes of ``bench inverse``
with the photo "coffee"."""


@dataclass(frozen=True)
class TexelLevel:
    """The texels of a level of a pyramid.

    Attributes
    ----------
    width, height, channels : int
    """

    width: int
    height: int
    channels: int

    @property
    def values(self) -> int:
        """Number of values."""
        return self.width * self.height * self.channels

    def place(self, UInt: type) -> tuple[UInt, UInt, UInt]:
        """Return the row, the column and the channel of each value."""
        value = dr.arange(UInt, self.values)
        pixel = value // self.channels
        return pixel // self.width, pixel % self.width, value % self.channels

    def at(self, row: UInt, column: UInt, channel: UInt) -> UInt:
        """Return the index of a value."""
        return (row * self.width + column) * self.channels + channel


def texel_levels(width: int, height: int, channels: int) -> list[TexelLevel]:
    """Return the levels of a pyramid from fine to coarse, each of half the size, rounded up."""
    levels = [TexelLevel(width, height, channels)]
    while min(levels[-1].width, levels[-1].height) >= 2 * LEAST_SIDE:
        levels.append(TexelLevel(-(-levels[-1].width // 2), -(-levels[-1].height // 2), channels))
    return levels


def enlarge(values: Float, coarse: TexelLevel, fine: TexelLevel) -> Float:
    """Return a level at twice its size: bilinear, with the border texels repeated outside.

    The weights along an axis are 3/4 for the texel that holds the centre, and 1/4 for the next.
    """
    types = types_of(values)
    row, column, channel = fine.place(types.UInt)
    total = types.Float(0)
    for y, at_y in _parents(row, coarse.height):
        for x, at_x in _parents(column, coarse.width):
            texel = dr.gather(types.Float, values, coarse.at(y, x, channel))
            total = dr.fma(at_y * at_x, texel, total)
    return total


def shrink(values: Float, fine: TexelLevel, coarse: TexelLevel) -> Float:
    """Return the transpose of `enlarge`: from a derivative by the finer level to the coarser."""
    types = types_of(values)
    row, column, channel = coarse.place(types.UInt)
    total = types.Float(0)
    for y, at_y in _children(row, coarse.height, fine.height):
        for x, at_x in _children(column, coarse.width, fine.width):
            weight = at_y * at_x
            texel = dr.gather(types.Float, values, fine.at(y, x, channel), weight > 0)
            total = dr.fma(weight, texel, total)
    return total


def _parents(place: UInt, count: int) -> list[tuple[UInt, float]]:
    """Return the two coarse texels of a fine one along an axis, with their weights."""
    Int = dr.int32_array_t(type(place))
    near, odd = Int(place // 2), Int(place % 2)
    far = dr.clip(near + 2 * odd - 1, 0, count - 1)
    return [(type(place)(near), 0.75), (type(place)(far), 0.25)]


def _children(place: UInt, count: int, fine: int) -> list[tuple[UInt, Float]]:
    """Return the fine texels of a coarse one along an axis, with their weights."""
    Int, Float = dr.int32_array_t(type(place)), dr.float32_array_t(type(place))
    children = []
    for step in (-1, 0, 1, 2):
        child = 2 * Int(place) + step
        inside = (child >= 0) & (child < fine)
        parents = _parents(type(place)(dr.maximum(child, 0)), count)
        weight = sum(dr.select(parent == place, Float(w), 0) for parent, w in parents)
        children.append((type(place)(child), dr.select(inside, weight, 0)))
    return children


def _sum_levels(values: Sequence[Float], levels: Sequence[TexelLevel]) -> Float:
    total = values[-1]
    for value, (fine, coarse) in zip(values[-2::-1], [*pairwise(levels)][::-1], strict=True):
        total = enlarge(total, coarse, fine) + value
        dr.eval(total)
    return total


def texel_sums(
    objective: LossObjective, coarse: Coarse, steps: int, start: Sequence[float], unit: float = 1.0
) -> Generator[Float, None, None]:
    """Descend on a loss by a pyramid of texels.

    Parameters
    ----------
    objective : LossObjective
    coarse : Coarse
    steps : int
    start : sequence of float
        The channels of all texels before the first step.
    unit : float, optional
        The range of the values, for the rate.

    Yields
    ------
    Float, shape (H * W * C,)
        The sums of all levels before the first step and after each, as rows of pixels.
    """
    types, optimizer = objective.types, coarse.optimizer
    levels = texel_levels(*objective.size, objective.channels)

    def advance(
        values: list,
        moments: list,
        time: Float,
        sums: Float,
        slopes: list[Float],
        size: Float,
    ) -> tuple[list, list, Float, Float, list[Float]]:
        slope: Any = objective.pull_back(sums, slopes)
        rests, later = size == 0, time + 1  # without a derivative nothing moves
        falling = 0.5 + 0.5 * dr.cos(time * (math.pi / steps))
        rate = dr.fma(falling, (1 - coarse.decay), coarse.decay) * (coarse.rate * unit)
        for k, value in enumerate(values):
            if k:
                slope = shrink(slope, levels[k - 1], levels[k])
            dr.eval(slope)
            moved = optimizer.step(value, slope, moments[k], rate, later)
            values[k], moments[k] = dr.select(rests, (value, moments[k]), moved)
        sums = _sum_levels(values, levels)
        return values, moments, dr.select(rests, time, later), sums, objective.seen(sums)

    values: list = [dr.zeros(types.Float, level.values) for level in levels[:-1]]
    values.append(types.Float(np.tile(start, levels[-1].values // len(start))))
    dr.make_opaque(values)
    moments, sums = [optimizer.start(value) for value in values], _sum_levels(values, levels)
    pictures, time = objective.seen(sums), dr.opaque(types.Float, 0)
    with freeze_program(advance) as take_step:
        yield sums
        for _ in range(steps):
            slopes, size = objective.step(pictures)
            values, moments, time, sums, pictures = take_step(
                values, moments, time, sums, slopes, size
            )
            yield sums
