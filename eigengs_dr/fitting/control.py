"""Controls, which add, move and remove Gaussians between the steps of a descent.

`Backtrack` undoes steps that have raised the error, `Surplus` allows more Gaussians than requested,
`Redistribute` places all anew after the first steps, `Relocate` moves those of least use and lets
the surplus go, and `Perturb` adds noise to all. Each acts before its own steps. If it changes
the Gaussians, the optimiser starts anew.

They say when and how often; what they do is in `eigengs_dr.fitting.exchange` and
`eigengs_dr.fitting.redistribution`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Protocol, TypeAlias, runtime_checkable

import drjit as dr
import numpy as np

from ..backend.arrays import make_divisor, types_of
from ..backend.entry_points import check_fields
from ..backend.types import Float, Rows
from ..gaussian.gaussians import broadcast_rows
from ..raster.kernels import sum_by_image
from .exchange import MAX_ERROR, among, exchange, exchange_levels, merged
from .objective import Pixels
from .redistribution import error_by_pixel, redistribute
from .state import State

Phase: TypeAlias = Literal["densify", "redistribute", "relocate", "perturb"]
"""What a control does to a descent: it allows more Gaussians than requested, places all anew after
the first steps, moves those of least use in rounds, or adds noise to all."""


@runtime_checkable
class Control(Protocol):
    """A change of the Gaussians between steps of a descent: it adds, moves or removes some.

    Those of this package refuse numbers out of range, by a ValueError.

    It may say its `Phase` by an attribute ``phase``. A control without one acts in every descent; a
    search, levels and blocks leave some phases out, see `eigengs_dr.Method.without`.
    """

    def steps(self, iterations: int) -> Collection[int]:
        """Return the steps of a descent before which the control acts."""

    def __call__(
        self, state: State, objective: Pixels, step: int, iterations: int, key: int
    ) -> State:
        """Return the state with other Gaussians, by `eigengs_dr.fitting.state.State.replaced`.

        All random numbers depend on `key` and `step`. A control that changes how many Gaussians the
        result has sets the `count` of the state too.
        """


def act(
    control: Control, state: State, objective: Pixels, step: int, iterations: int, key: int
) -> State:
    """Return what a control returns, if its numbers of Gaussians agree.

    Raises
    ------
    TypeError
        If it is no state.
    ValueError
        If the set has fewer Gaussians than the state says, or more without a surplus.
    """
    state = control(state, objective, step, iterations, key)
    if not isinstance(state, State):
        raise TypeError(f"{control!r} returned {state!r}; a control returns the state")
    if not state.count <= state.total <= state.most:
        raise ValueError(
            f"{control!r} left {state.total} Gaussians, but the count of the state is "
            f"{state.count}; return replace(state.replaced(gaussians), count={state.total})"
        )
    return state


def phase_of(control: Control) -> Phase | None:
    """Return the phase of a control, if it says one."""
    return getattr(control, "phase", None)


EVERY = 45
"""Steps between two rounds of relocation."""

UNTIL, MIN_ROUNDS, MAX_ROUNDS = 0.65, 2, 72
"""Rounds end after this share of a descent; their smallest and largest number. In 100 steps more
steps gain more than rounds would, for the same time. With 5,000 steps, 72 rounds gain 0.07 and 0.1
dB over 40 (4 training photos, 0.0127 and 0.0254 Gaussians per pixel)."""

FULL_ROUNDS = 10
"""Number of rounds from which on noise, and the surplus of a weighted image, have their full
strength. A short descent does not recover from more: with 300 steps and 0.076 Gaussians per pixel,
a noise of 4 costs 0.8 dB."""

SURPLUS_ROUNDS = 8, 14
"""Numbers of rounds up to which there is no surplus, as in 600 steps, and from which on it is
whole, as in 1,000. With 0.02 and 0.05 Gaussians per pixel, a whole one gains 0.07 and
0.03 dB in 1,000 steps; in 600, 300 and 200 steps 0.8, 0.4 and 0.2 of it change the PSNR by -0.03
and 0, -0.17 and -0.14, and -0.22 and -0.23 dB (means of 12 training photos of 256x256 pixels). With
weights it begins at once, see `FULL_ROUNDS`: relocations move it to where the weight is. With
nearly all weight in a quarter of the picture, a whole one gains 4.9, 5.5 and 2.0 dB there in 150,
300 and 600 steps (means of 6 crops of 128x128 pixels, 320 Gaussians)."""


def round_steps(every: int, iterations: int) -> list[int]:
    """Return the steps before which rounds take place: evenly spaced up to `UNTIL`.

    Examples
    --------
    >>> round_steps(65, 1000)[:3], round_steps(45, 100)
    ([65, 130, 195], [])
    """
    until = UNTIL * iterations
    number = min(MAX_ROUNDS, int(until / every)) if every else 0
    if number < MIN_ROUNDS:
        return []
    return [round(until * (k + 1) / number) for k in range(number)]


@dataclass(frozen=True)
class Surplus:
    """Lets a redistribution place more Gaussians than requested; relocations remove them again.

    Short descents without weights have none, which costs them more than it gains, see
    `SURPLUS_ROUNDS`.

    Attributes
    ----------
    share : float
        Surplus of a long descent, relative to the number requested. With 0.0127 Gaussians per
        pixel, 1,000 steps and 9 training photos, 0.5, 1 and 2 gain 0.23, 0.24 and 0.12 dB.
    max_density : float
        Largest number of Gaussians per pixel of a set with a surplus. Denser sets do not converge
        in 1,000 steps. On 9 training photos, surpluses up to this density gain 0.24, 0.22 and 0.10
        dB with 0.0127, 0.0254 and 0.045 Gaussians per pixel. With 0.076 Gaussians per pixel, a
        surplus of 0.3 costs 0.09 dB.
    every : int
        Steps between the rounds of relocation.
    """

    phase: ClassVar[Phase] = "densify"

    share: float = 1.0
    max_density: float = 1 / 16
    every: int = EVERY

    def __post_init__(self) -> None:
        check_fields(self, share="[0, inf)", max_density="[0, 1]", every="[0, inf)")

    def steps(self, iterations: int) -> tuple[int, ...]:
        """Return the first step."""
        return (0,)

    def __call__(
        self, state: State, objective: Pixels, step: int, iterations: int, key: int
    ) -> State:
        """Return the state with the surplus that a redistribution may place."""
        none, whole = SURPLUS_ROUNDS if objective.model.curvature is None else (0, FULL_ROUNDS)
        strength = (len(round_steps(self.every, iterations)) - none) / (whole - none)
        most = self.most(state.count, math.prod(objective.size), min(1, strength))
        return replace(state, surplus=most - state.count)

    def most(self, count: int, pixels: int, strength: float = 1.0) -> int:
        """Return the largest number of Gaussians of a descent that shall end with `count`."""
        with_surplus = count + int(self.share * strength * count)
        return max(count, min(with_surplus, int(self.max_density * pixels)))


@dataclass(frozen=True)
class Redistribute:
    """Places all Gaussians anew after the first steps, denser where these left more error.

    Gaussians that a fit started from are kept, see `eigengs_dr.fitting.start.keep_fitting`.

    Attributes
    ----------
    after : int
        Largest number of steps before it.
    solve_steps : int
        Steps of the colour solve after it.
    """

    phase: ClassVar[Phase] = "redistribute"

    after: int = 20
    solve_steps: int = 10

    def __post_init__(self) -> None:
        check_fields(self, after="[0, inf)", solve_steps="[0, inf)")

    MIN_RATIO = 10
    """Smallest ratio of the steps of a descent to those before a redistribution."""

    MIN_STEPS = 10
    """Fewest steps before it. With 0.013 and 0.076 Gaussians per pixel, redistribution gains 0.07
    and 0.6 dB in 100 steps (5 photos); in 60 steps, after 6 of them, it gains 0 and 0.3 dB, less
    than more steps would in the same time."""

    def steps(self, iterations: int) -> tuple[int, ...]:
        """Return the step before which it acts; none in a short descent.

        Examples
        --------
        >>> [Redistribute().steps(steps) for steps in (99, 100, 150, 1000)]
        [(), (10,), (15,), (20,)]
        """
        first = min(self.after, iterations // self.MIN_RATIO)
        return (first,) if first >= min(self.MIN_STEPS, self.after) and first else ()

    def __call__(
        self, state: State, objective: Pixels, step: int, iterations: int, key: int
    ) -> State:
        """Return the state with a new set and its surplus."""
        if objective.levels or objective.part:
            return state
        current = dr.detach(state.gaussians)
        placed = redistribute(current, objective, state.most, self.solve_steps, key)
        if state.chosen:
            placed, _ = merged(current, placed, objective, state.most, MAX_ERROR, self.solve_steps)
        return state.replaced(placed)


@dataclass(frozen=True)
class Relocate:
    """Moves the Gaussians of least use to where they reduce the error most, again and again.

    The surplus leaves, about as many in each round. With levels, the Gaussians of
    each level move inside of it.

    Attributes
    ----------
    every : int
        Steps between two rounds.
    share : float
        Share of the Gaussians that leave their places in a round, in [0, 1].

    """

    phase: ClassVar[Phase] = "relocate"

    every: int = EVERY
    share: float = 0.1

    def __post_init__(self) -> None:
        check_fields(self, every="[0, inf)", share="[0, 1]")

    def steps(self, iterations: int) -> list[int]:
        """Return the steps of the rounds, see `round_steps`."""
        return round_steps(self.every, iterations)

    def __call__(
        self, state: State, objective: Pixels, step: int, iterations: int, key: int
    ) -> State:
        """Return the state with moved Gaussians."""
        current = dr.detach(state.gaussians)
        if objective.levels:
            return state.replaced(exchange_levels(current, objective, self.share))
        steps = self.steps(iterations)
        left = len(steps) - steps.index(step)
        excess = state.total - state.count
        dropped = excess - excess * (left - 1) // left
        lists = state.lists[-1] if state.lists else None
        moved, squares = exchange(current, objective, self.share, dropped, lists)
        return replace(state.replaced(moved), squares=squares)


@dataclass(frozen=True)
class Perturb:
    """Adds noise to means and shapes, less from round to round, to escape a poor minimum.

    Kheradmand et al. ("3D Gaussian splatting as Markov chain Monte Carlo", NeurIPS 2024) add noise
    to means. Here shapes get noise too, and each Gaussian gets as much as the image can bear, see
    `perturb`. With levels there is none: what the first level can bear costs the third one 0.5 to
    0.9 dB.

    Attributes
    ----------
    strength : float
        Noise of the first round.
    every : int
        Steps between two rounds.
    """

    phase: ClassVar[Phase] = "perturb"

    strength: float = 2.5
    every: int = EVERY

    def __post_init__(self) -> None:
        check_fields(self, strength="[0, inf)", every="[0, inf)")

    def steps(self, iterations: int) -> list[int]:
        """Return the steps of the rounds, see `round_steps`."""
        return round_steps(self.every, iterations)

    def __call__(
        self, state: State, objective: Pixels, step: int, iterations: int, key: int
    ) -> State:
        """Return the state with moved means and shapes."""
        if objective.levels:
            return state
        steps, gaussians = self.steps(iterations), dr.detach(state.gaussians)
        done = steps.index(step) / len(steps)
        strength = self.strength * min(1, len(steps) / FULL_ROUNDS) * (1 - done)
        squares, images = state.squares, objective.grid.images
        if squares is None:
            squares = sum_by_image(error_by_pixel(gaussians, objective), objective.grid)
        movable = range(state.total)
        if objective.part is not None:
            movable = movable[objective.part.movable]
        curvature = objective.model.mean_curvature(objective.grid, objective.channels)
        error = squares / (curvature * dr.opaque(type(squares), max(1, len(movable))))
        seed = int(np.random.SeedSequence([key, step]).generate_state(1)[0])
        color = broadcast_rows(gaussians.color, gaussians)
        mean, factor = perturb(
            gaussians.mean, gaussians.factor, color, movable, error, strength, seed, images
        )
        return state.replaced(replace(gaussians, mean=mean, factor=factor).bounded())


@dataclass(frozen=True)
class Backtrack:
    """Returns to where the optimiser started, at lower rates, if the error has risen much since.

    Put it before the other controls: it judges what they have not touched yet. The steps of its
    checks double, so that rates which are far too high do little harm.

    Attributes
    ----------
    rise : float
        Ratio of the squared errors above which it returns. The first steps from a good set raise
        the error of fits that end well.
    factor : float
        Factor of all learning rates after a return.
    first : int
        Steps before the first check.
    """

    rise: float = 4.0
    factor: float = 0.4
    first: int = 10

    def __post_init__(self) -> None:
        check_fields(self, rise="(0, inf)", factor="(0, 1]", first="[1, inf)")

    LEAST = 1e-8
    """Mean squared error up to which nothing returns: a set that is exact can only get worse, and
    the loop has kept it."""

    def steps(self, iterations: int) -> list[int]:
        """Return the steps of the checks.

        Examples
        --------
        >>> Backtrack().steps(300)
        [10, 20, 40, 80, 160]
        """
        return [self.first << k for k in range(32) if self.first << k < iterations]

    def __call__(
        self, state: State, objective: Pixels, step: int, iterations: int, key: int
    ) -> State:
        """Return the state, or an earlier one to return to.

        Raises
        ------
        Diverged
            If the error of an image of a batch has risen.
        """
        if objective.levels or objective.part or state.fixed is None:
            return state
        before, after = (
            sum_by_image(error_by_pixel(dr.detach(g), objective), objective.grid).numpy()
            for g in (state.fixed, state.gaussians)
        )
        (width, height), channels = objective.size, objective.channels
        least = self.LEAST * width * height * channels
        if ((after <= self.rise * before) | (before <= least)).all():
            return state
        if objective.grid.images > 1:
            raise Diverged
        return replace(state.replaced(state.fixed), speed=self.factor * state.speed)


class Diverged(Exception):
    """The images of a batch diverge from each other: one must go back, the others must not."""


SHAPE_SHARE = 0.5
"""Noise of the logarithms of the sizes, relative to that of the mean in standard deviations."""

MAX_NOISE = 1.0
"""Largest noise of a mean, in standard deviations of its Gaussian."""


def perturb(
    mean: Rows,
    factor: Rows,
    color: list,
    movable: range,
    error: Float,
    strength: float,
    seed: int,
    images: int = 1,
) -> tuple[Rows, Rows]:
    """Add noise to the means and the factors of some Gaussians.

    A Gaussian with the factor F, the size s (the geometric mean of its standard deviations) and the
    amplitude ``A = color s`` adds the squared error ``pi/2 |A|^2 |F dm|^2`` if its mean moves by
    dm. So faint Gaussians move far, and those that carry the image stay near their places; the
    nearer a fit is to its image, the smaller are the moves.

    The noise is normal: ``F dm = e z`` for the mean, with two numbers z, and
    ``F' = [[exp(e u), e v], [0, exp(e w)]] F`` for the factor, with `SHAPE_SHARE` times such
    numbers u, v and w. Each mean alone adds about ``strength^2`` times the mean error:
    ``e = strength (error / (pi |A|^2))^(1/2)``, at most `MAX_NOISE`.

    Parameters
    ----------
    mean : Array2f, shape (N, 2)
    factor : Array3f, shape (N, 3)
    color : list of Float, shape (N,)
        By channels.
    movable : range
        The Gaussians of one image that move; the images of a batch have equal noise.
    error : Float, shape (images,)
        Squared error of each image divided by the number of its Gaussians.
    strength : float
    seed : int
        Equal seeds give equal noise.
    images : int, optional

    Returns
    -------
    mean : Array2f, shape (N, 2)
        Perturbed means may lie outside the image.
    factor : Array3f, shape (N, 3)
    """
    types, total = types_of(mean), dr.width(color[0])
    count = total // images
    image, lane = make_divisor(types, count).divmod(dr.arange(types.UInt, total))
    error = dr.gather(types.Float, error, image)
    a, b, c = factor
    amplitude = sum(dr.square(row) for row in color) / (a * c)
    size = dr.opaque(types.Float, strength) * dr.sqrt(error / (dr.pi * amplitude))
    # The comparison is false where the amplitude is 0.
    size = dr.select(size < MAX_NOISE, size, types.Float(MAX_NOISE))
    moves = among(lane, movable)
    size = dr.select(moves, size, 0)
    normal, first = dr.rng(seed).normal(types.Float, 5 * count), dr.opaque(types.UInt, count)
    x, y, u, v, w = (dr.gather(types.Float, normal, lane + k * first) * size for k in range(5))
    y /= c
    u, v, w = (SHAPE_SHARE * z for z in (u, v, w))
    wider = dr.exp(u)
    return (
        mean + dr.select(moves, types.Float2((x - b * y) / a, y), 0),
        dr.select(moves, types.Float3(wider * a, dr.fma(wider, b, v * c), dr.exp(w) * c), factor),
    )
