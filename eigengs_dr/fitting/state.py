"""What a descent moves: its variables, the optimiser that moves them, and the state between steps.

Variables are the numbers of a Gaussian in units of its own size. An optimiser has settings and no
state; its step is a pure function.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import drjit as dr

from ..backend.arrays import rsqrt, types_of
from ..backend.entry_points import check_fields
from ..backend.types import Float, FloatLike, Rows
from ..gaussian.gaussians import Gaussians
from ..raster.lists import TileLists

Variables: TypeAlias = dict[str, Rows]
"""Variables by name: arrays of Dr.Jit with one or several numbers for each Gaussian."""

ImageSize: TypeAlias = tuple[Float, Float] | None
"""Width and height in arrays, or None for those of the set."""


@runtime_checkable
class Coordinates(Protocol):
    """A change of variables, differentiable by Dr.Jit.

    `fixed` is the set that was encoded; fields without a variable keep its values. `size` is the
    width and the height of `fixed`, in arrays if the program is to serve every size.
    """

    def encode(self, gaussians: Gaussians) -> Variables:
        """Return the variables of a set."""

    def decode(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Gaussians:
        """Return the set of variables."""

    def project(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Variables:
        """Return the variables, moved back into their bounds."""

    def reach(self, fixed: Gaussians, moves: dict[str, float]) -> tuple[FloatLike, float]:
        """Return how far ellipses reach, in pixels and as a factor, if variables move this far."""


MOVE_SHARE, GROWTH_SHARE = 0.17, 0.07
"""How far Gaussians move and grow, relative to the sum of the rates. Steps change direction: with
these shares, lists miss less than 0.1 % of the tiles just before the next build. The strict bounds,
1 and 1, would make the lists 3.4 times as long."""


@dataclass(frozen=True)
class Relative:
    """Mean divided by the size of the Gaussian at the start, factor times this size, and colour.

    The size is the geometric mean of the standard deviations, in pixels: ``det F = a c``. One
    learning rate then serves small and large Gaussians, and images of any size.
    """

    def encode(self, gaussians: Gaussians) -> Variables:
        """Return the variables mean, factor and color; see `Coordinates`."""
        return _in_units(gaussians, _size(gaussians))

    def decode(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Gaussians:
        """Return the set of variables; see `Coordinates`."""
        unit = _size(fixed)
        units: dict[str, FloatLike] = {"mean": unit, "factor": 1 / unit, "color": 1}
        fields: dict = {name: value * units[name] for name, value in variables.items()}
        return replace(fixed, **fields)

    def project(self, fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Variables:
        """Return the variables of bounded Gaussians; see `Coordinates`."""
        inside = _in_units(self.decode(fixed, variables).bounded(size), _size(fixed))
        return {name: inside[name] for name in variables}

    def reach(self, fixed: Gaussians, moves: dict[str, float]) -> tuple[FloatLike, float]:
        """Return how far Gaussians reach after some steps; see `Coordinates`."""
        # An array, because another literal in every build would compile the kernels again.
        share = dr.opaque(types_of(fixed.mean).Float, MOVE_SHARE * moves.get("mean", 0.0))
        return share * _size(fixed), 1 + GROWTH_SHARE * moves.get("factor", 0.0)


def _size(gaussians: Gaussians) -> Float:
    return rsqrt(gaussians.factor[0] * gaussians.factor[2])


def _in_units(gaussians: Gaussians, unit: Float) -> Variables:
    mean, factor = gaussians.mean / unit, gaussians.factor * unit
    return {"mean": mean, "factor": factor, "color": gaussians.color}


@runtime_checkable
class Optimizer(Protocol):
    """The type of optimisers: settings without state, and a step as a pure function.

    The state of a variable is its value and a tuple of arrays of the same type, its moments; and
    all variables share the time since their start. One kernel then computes the gradients and the
    steps of all variables.
    """

    def start(self, value: Rows) -> tuple[Rows, ...]:
        """Return the moments of a variable before the first step, evaluated."""

    def step(
        self, value: Rows, gradient: Rows, moments: tuple[Rows, ...], rate: Float, time: Float
    ) -> tuple[Rows, tuple[Rows, ...]]:
        """Return the value of a variable and its moments after a step.

        Parameters
        ----------
        value, gradient : Dr.Jit array
            Of one type, e.g. Array2f.
        moments : tuple
            From `start` or from the last step.
        rate : Float
            Learning rate.
        time : Float
            Number of this step since `start`; the first is 1.
        """


def zeros_like(value: Rows) -> Rows:
    """Return evaluated zeros with the type and the shape of an array."""
    zeros = dr.zeros(type(value), value.shape)
    dr.make_opaque(zeros)
    return zeros


def debias(beta: float, time: Float) -> Float:
    """Return ``1 - beta^time``, the weight of all gradients in a moving average so far.

    Parameters
    ----------
    beta : float
        Decay factor, in [0, 1).
    time : Float
        Number of steps, at least 1.
    """
    return 1 - dr.exp2(time * math.log2(beta)) if beta > 0 else type(time)(1)


@dataclass(frozen=True)
class Adam:
    """Adam by Kingma and Ba, "Adam: A Method for Stochastic Optimization" (2015).

    With the gradient g, and moving averages with the decay factors beta::

        m_t = beta_1 m_{t-1} + (1 - beta_1) g_t
        v_t = beta_2 v_{t-1} + (1 - beta_2) g_t^2
        p_t = p_{t-1} - lr sqrt(1 - beta_2^t) / (1 - beta_1^t) m_t / (sqrt(v_t) + epsilon)

    With equal betas, no step is longer than the learning rate.

    Parameters
    ----------
    beta_1, beta_2 : float, optional
        Decay factors of the moving averages, each in [0, 1).
    epsilon : float, optional
        Number that bounds the step if gradients vanish.

    Raises
    ------
    ValueError
        If a beta is outside [0, 1), or epsilon is negative or not finite.
    """

    beta_1: float = 0.9
    beta_2: float = 0.999
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        check_fields(self, beta_1="[0, 1)", beta_2="[0, 1)", epsilon="[0, inf)")

    def start(self, value: Rows) -> tuple[Rows, ...]:
        """Return the moments before the first step; see `Optimizer`."""
        return zeros_like(value), zeros_like(value)

    def step(
        self, value: Rows, gradient: Rows, moments: tuple[Rows, ...], rate: Float, time: Float
    ) -> tuple[Rows, tuple[Rows, ...]]:
        """Return the value and the moments after a step; see `Optimizer`."""
        m, v = moments
        m, v, scale = self.averaged(gradient, m, v, rate, time)
        return value - scale * (m / (dr.sqrt(v) + self.epsilon)), (m, v)

    def averaged(
        self, gradient: Rows, m: Rows, v: Rows, rate: Float, time: Float
    ) -> tuple[Rows, Rows, Float]:
        """Return both moving averages, and the rate without the bias of their start."""
        m = dr.lerp(gradient, m, self.beta_1)
        v = dr.lerp(dr.square(gradient), v, self.beta_2)
        return m, v, rate * dr.sqrt(debias(self.beta_2, time)) / debias(self.beta_1, time)


class Moving(NamedTuple):
    """What a step takes and returns.

    Attributes
    ----------
    variables : dict of str to arrays
        The variables that the optimiser moves.
    moments : dict of str to tuple
        The state of the optimiser for each variable.
    time : Float, shape (1,)
        Steps since the optimiser started.
    packed : Float
        The parameters of the set for the kernels.
    rate_scale : Float or None
        Factor of the learning rates of means and shapes, one for each Gaussian.
    """

    variables: Variables
    moments: dict[str, tuple[Rows, ...]]
    time: Float
    packed: Float
    rate_scale: Float | None


@dataclass(frozen=True)
class State:
    """The state of a descent between two steps.

    Attributes
    ----------
    gaussians : Gaussians
        The current set; for a batch, image after image.
    count : int
        Requested number of Gaussians of an image.
    surplus : int
        How many more a control may place before the last ones have left.
    chosen : bool
        Whether the fit started from Gaussians of the user: a redistribution keeps those that fit.
    squares : Float or None, shape (images,)
        The sums of ``h (p - t)^2`` that a control has measured before this step.
    speed : float
        Factor of all learning rates.
    fixed : Gaussians or None
        The set at which the optimiser started, whose variables move; None until the next step,
        which starts the optimiser.
    moving : Moving or None
    since : int
        The step at which the optimiser started.
    lists : tuple of TileLists
        Lists of the current set: one for each level, and one for the whole set.
    until : int
        The step that needs new lists.
    """

    gaussians: Gaussians
    count: int
    surplus: int = 0
    chosen: bool = False
    squares: Float | None = None
    speed: float = 1.0
    fixed: Gaussians | None = None
    moving: Moving | None = None
    since: int = 0
    lists: tuple[TileLists, ...] = ()
    until: int = 0

    def replaced(self, gaussians: Gaussians) -> State:
        """Return the state with another set, from which the optimiser starts anew.

        A control that changes the number of the result sets `count` too.
        """
        return replace(self, gaussians=gaussians, squares=None, fixed=None, moving=None, lists=())

    @property
    def most(self) -> int:
        """Largest number of Gaussians of an image."""
        return self.count + self.surplus

    @property
    def total(self) -> int:
        """Number of Gaussians of an image."""
        return len(self.gaussians) // dr.width(self.gaussians.background[0])


def begin(gaussians: Gaussians, images: int = 1, chosen: bool = False) -> State:
    """Return the state before the first step from the Gaussians of one image after another."""
    return State(gaussians, len(gaussians) // images, chosen=chosen)
