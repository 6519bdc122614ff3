"""From coarse to fine: the picture that a loss asks for, before any Gaussian has a place.

A pyramid of texels descends on the loss: each level is added to the next coarser sum at twice its
size (Weier et al. 2025, doi 10.1145/3730855), so coarse levels move many texels at once.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import drjit as dr

from ..backend.arrays import ArrayTypes, types_of
from ..backend.entry_points import check_fields
from ..backend.recording import freeze_program
from ..backend.types import Float, Rows, UInt
from .loss import TINY, PictureLoss
from .method import DEFAULT
from .place import Adaptive
from .state import Adam, Optimizer, zeros_like

LEAST_SIDE = 4
"""Smallest length of the shorter side of the coarsest level, in texels."""


NOISY = Adam(0.5, 0.999, 1e-8)
"""Adam for derivatives with the noise of a rendering."""


@dataclass(frozen=True)
class Agreeing(Adam):
    """Adam whose rate rises while derivatives agree with the way so far, and falls if they do not.

    With a row of values p and its derivative g at step t, and the averages m and v of `Adam`::

        r_t = r_{t-1} exp(-gain g (p - a_{t-1}) / (|g| |p - a_{t-1}|))      from least to 1
        a_t = memory a_{t-1} + (1 - memory) p
        p_t = p - lr r_t m_t / (sqrt(v_t + floor mean(v_t)) + epsilon)

    While derivatives lead on, an error is left and steps are too short; if they lead back, noise
    has moved the values (Kesten, "Accelerated stochastic approximation", 1958). Values with little
    derivative, which Adam moves as far as others, move less: what moves them is noise.

    Cost: four sums over each row.

    Parameters
    ----------
    memory : float, optional
        Decay factor of the average a of values, in [0, 1).
    gain : float, optional
        Change of the logarithm of the rate for derivatives that agree.
    first, least : float, optional
        The rate r at the start, and its lower bound: ``0 < least <= first <= 1``.
    floor : float, optional
        Share of the mean of v that is added to each, at least 0.
    fall : float, optional
        For a loss that says its `pixels`, as that of photos: a pyramid ends once the rate of its
        finest level is below this share of its highest, as texels then copy the noise of single
        photos. In [0, 1]; 0 for never. Losses that see all texels at each step need the last steps.

    Raises
    ------
    ValueError
        If one is out of range.
    """

    beta_1: float = 0.5
    memory: float = 0.9
    gain: float = 0.2
    first: float = 0.2
    least: float = 0.02
    floor: float = 0.05
    fall: float = 0.95

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, memory="[0, 1)", gain="[0, inf)", first="(0, 1]", floor="[0, inf)")
        check_fields(self, least=f"(0, {self.first}]", fall="[0, 1]")

    def start(self, value: Rows) -> tuple[Rows, ...]:
        """Return both averages of `Adam`, that of the values, and the logarithms of the rates."""
        log_rate = dr.full(type(value), math.log(self.first), (*value.shape[:-1], 1))
        dr.make_opaque(log_rate)
        return *super().start(value), type(value)(value), log_rate

    def step(
        self, value: Rows, gradient: Rows, moments: tuple[Rows, ...], rate: Float, time: Float
    ) -> tuple[Rows, tuple[Rows, ...]]:
        """Return the value and the moments after a step; see `Optimizer`."""
        m, v, average, log_rate = moments
        m, v, scale = self.averaged(gradient, m, v, rate, time)
        way = value - average
        products = gradient * way, dr.square(gradient), dr.square(way), v
        dr.eval(products)  # one kernel before the sums
        along, slopes, ways, total = (dr.sum(one, axis=-1) for one in products)
        lengths = slopes * ways
        cosine = dr.select(lengths > 0, along * dr.rsqrt(lengths), 0)
        log_rate = dr.clip(log_rate - self.gain * cosine, math.log(self.least), 0)
        floored = v + total * (self.floor / value.shape[-1])
        average = dr.lerp(value, average, self.memory)
        moved = value - scale * dr.exp(log_rate) * (m / (dr.sqrt(floored) + self.epsilon))
        return moved, (m, v, average, log_rate)

    def rate_of(self, moments: tuple[Rows, ...]) -> float:
        """Return the geometric mean of the rates r of all rows."""
        return math.exp(float(dr.mean(moments[3], axis=None).numpy()[0]))

    def average_of(self, moments: tuple[Rows, ...]) -> Rows:
        """Return the averages a, which have less noise than the values."""
        return moments[2]


@dataclass(frozen=True)
class Coarse(Adaptive):
    """Places Gaussians by the picture that a pyramid of texels finds for a loss.

    With an image, it places as `Adaptive` does.

    Attributes
    ----------
    share : float
        Largest share of the iterations that the pyramid takes, in [0, 1].
    max_steps : int
        Largest number of its steps. Once the picture has its shapes, Gaussians average more noise.
    rate : float
        Largest learning rate of its levels, relative to the range of the picture.
    decay : float
        Fraction of the rate at the end, after half a cosine.
    optimizer : Optimizer
    fit_steps : int
        Largest number of steps of a fit of its picture, which do not call the loss; there are
        `eigengs_dr.fitting.from_loss.STEPS_PER_TEXEL` for each texel of a Gaussian.
    """

    share: float = 0.9
    max_steps: int = 60
    rate: float = 0.025
    decay: float = 0.05
    optimizer: Optimizer = Agreeing()
    fit_steps: int = 150

    def __post_init__(self) -> None:
        check_fields(self, share="[0, 1]", max_steps="[0, inf)", rate="(0, inf)", decay="[0, 1]")
        check_fields(self, fit_steps="[0, inf)")
        if isinstance(self.optimizer, type) or not isinstance(self.optimizer, Optimizer):
            raise TypeError(f"Coarse: optimizer is {self.optimizer!r}; give one, such as Adam()")


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
derivatives with rendering noise. The rates were chosen on the scenes of ``bench inverse``
with the photo "coffee"."""


Size: TypeAlias = tuple[int, int]
"""Width and height of a level of a pyramid, whose texels are stored row after row."""


def texel_levels(width: int, height: int) -> list[Size]:
    """Return the levels of a pyramid from fine to coarse, each of half the size, rounded up."""
    levels = [(width, height)]
    while min(levels[-1]) >= 2 * LEAST_SIDE:
        width, height = -(-width // 2), -(-height // 2)
        levels.append((width, height))
    return levels


def enlarge(values: Float, coarse: Size, fine: Size) -> Float:
    """Return a level at twice its size: bilinear, with the border texels repeated outside.

    The weights along an axis are 3/4 for the texel that holds the centre, and 1/4 for the next.
    """
    types = types_of(values)
    texel, (width, height) = dr.arange(types.UInt, fine[0] * fine[1]), coarse
    row, column = texel // fine[0], texel % fine[0]
    total = types.Float(0)
    for y, at_y in _parents(row, height):
        for x, at_x in _parents(column, width):
            total = dr.fma(at_y * at_x, dr.gather(types.Float, values, y * width + x), total)
    return total


def shrink(values: Float, fine: Size, coarse: Size) -> Float:
    """Return the transpose of `enlarge`: from a derivative by the finer level to the coarser."""
    types = types_of(values)
    texel, (width, height) = dr.arange(types.UInt, coarse[0] * coarse[1]), coarse
    row, column = texel // width, texel % width
    total = types.Float(0)
    for y, at_y in _children(row, height, fine[1]):
        for x, at_x in _children(column, width, fine[0]):
            weight = at_y * at_x
            child = dr.gather(types.Float, values, y * fine[0] + x, weight > 0)
            total = dr.fma(weight, child, total)
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


def _sum_levels(values: Sequence[Rows], levels: Sequence[Size]) -> Float:
    """Return the sum of all levels as rows of pixels."""
    total = values[-1]
    for value, (fine, coarse) in zip(values[-2::-1], [*pairwise(levels)][::-1], strict=True):
        total = type(total)([enlarge(plane, coarse, fine) for plane in total]) + value
        dr.eval(total)
    return dr.ravel(total)


def texel_sums(
    types: ArrayTypes,
    loss: PictureLoss,
    coarse: Coarse,
    steps: int,
    start: Sequence[float],
    unit: float = 1.0,
) -> Generator[Float, None, None]:
    """Descend on a loss by a pyramid of texels; each channel of a level has a rate of its own.

    Parameters
    ----------
    types : ArrayTypes
    loss : PictureLoss
    coarse : Coarse
    steps : int
    start : sequence of float
        The channels of all texels before the first step.
    unit : float, optional
        The range of the values, for the rate.

    Yields
    ------
    Float, shape (H * W * C,)
        The sums of all levels before the first step and after each, as rows of pixels; and last
        those of `fill_unseen`. If an `Agreeing` optimizer ends early, these are of its averages.
    """
    optimizer, channels = coarse.optimizer, loss.number
    levels = texel_levels(loss.grid.width, loss.grid.height)

    def advance(
        values: list,
        moments: list,
        time: Float,
        sums: Float,
        slopes: list[Float],
        size: Float,
        squares: Rows,
    ) -> tuple[list, list, Float, Float, list[Float], Rows]:
        slope = _planes(loss.pull_back(sums, slopes), channels)
        rests, later = size == 0, time + 1  # without a derivative nothing moves
        squares = squares + dr.square(slope)
        falling = 0.5 + 0.5 * dr.cos(time * (math.pi / steps))
        rate = dr.fma(falling, (1 - coarse.decay), coarse.decay) * (coarse.rate * unit)
        for k, value in enumerate(values):
            if k:
                slope = type(slope)([shrink(plane, levels[k - 1], levels[k]) for plane in slope])
            dr.eval(slope)
            moved = optimizer.step(value, slope, moments[k], rate, later)
            values[k], moments[k] = dr.select(rests, (value, moments[k]), moved)
        sums = _sum_levels(values, levels)
        time = dr.select(rests, time, later)
        return values, moments, time, sums, loss.seen(sums), squares

    values = [dr.zeros(types.FloatX, (channels, width * height)) for width, height in levels]
    values[-1] += types.FloatX([types.Float(value) for value in start])
    dr.make_opaque(values)
    moments, sums = [optimizer.start(value) for value in values], _sum_levels(values, levels)
    pictures, time = loss.seen(sums), dr.opaque(types.Float, 0)
    squares, rates = zeros_like(values[0]), list[float]()
    with freeze_program(advance) as take_step:
        yield sums
        for step in range(1, steps + 1):
            slopes, size = loss.step(pictures)
            values, moments, time, sums, pictures, squares = take_step(
                values, moments, time, sums, slopes, size, squares
            )
            yield sums
            if step % LOOK or loss.loss.pixels is None or not isinstance(optimizer, Agreeing):
                continue
            rates.append(optimizer.rate_of(moments[0]))
            if step >= SETTLED and rates[-1] < optimizer.fall * max(rates):
                sums = _sum_levels([optimizer.average_of(one) for one in moments], levels)
                break
    if steps:
        yield dr.ravel(fill_unseen(_planes(sums, channels), squares, levels))


LOOK = 5
"""Steps from one look at the rates to the next; each waits for the steps before."""

SETTLED = 25
"""Steps before which a pyramid does not end. Rates may fall for a while before: after 15 steps,
a picture of 256x256 that a loss saw by means of 4x4 pixels ended 1.7 dB worse."""

DOUBT = 0.01
"""Share of the mean square of derivatives at which a texel counts half."""


def fill_unseen(picture: Rows, squares: Rows, levels: Sequence[Size]) -> Rows:
    """Replace texels on which a loss hardly depends by what lies around them.

    A texel of a coarser level is the mean of finer ones, by their weights, and shows where theirs
    are small: the pull and push of S. Gortler et al., The lumigraph, SIGGRAPH 1996. Cost: about
    three calls of `enlarge` per channel.

    Parameters
    ----------
    picture : Rows, shape (C, H * W)
    squares : Rows, shape (C, H * W)
        Sums of the squares of derivatives by the texels.
    levels : sequence of Size
        From fine to coarse.
    """
    return type(picture)([_filled(*one, levels) for one in zip(picture, squares, strict=True)])


def _filled(plane: Float, square: Float, levels: Sequence[Size]) -> Float:
    """Fill a channel, see `fill_unseen`."""
    weight = square / dr.maximum(square + DOUBT * dr.mean(square), TINY)
    steps, sums = [*pairwise(levels)], [(plane * weight, weight)]
    for fine, coarse in steps:
        sums.append((shrink(sums[-1][0], fine, coarse), shrink(sums[-1][1], fine, coarse)))
        dr.eval(sums[-1])
    total, weight = sums.pop()
    known = dr.sum(weight)
    average = dr.select(known > 0, dr.sum(total) / dr.maximum(known, TINY), dr.mean(plane))
    shown = dr.select(weight > 0, total / dr.maximum(weight, TINY), average)
    for (total, weight), (fine, coarse) in zip(sums[::-1], steps[::-1], strict=True):
        mean = total / dr.maximum(weight, TINY)
        shown = dr.lerp(enlarge(shown, coarse, fine), mean, dr.minimum(weight, 1))
        dr.eval(shown)
    return shown


def _planes(rows: Float, channels: int) -> Rows:
    """Return the channels of rows of pixels, each as a row."""
    types = types_of(rows)
    first = dr.arange(types.UInt, dr.width(rows) // channels) * channels
    return types.FloatX([dr.gather(types.Float, rows, first + c) for c in range(channels)])
