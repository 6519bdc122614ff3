"""Parameterizations: the variables that an optimiser moves, their Gaussians, and the optimisers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeAlias

import drjit as dr

from ..backend.arrays import Float, rsqrt, tanh, types_of
from ..gaussian.covariance import cholesky_from_factor, factor_from_cholesky
from ..gaussian.gaussians import Gaussians

Variables: TypeAlias = dict[str, Float]
"""Variables by name: arrays of Dr.Jit with one or several numbers for each Gaussian."""

ImageSize: TypeAlias = tuple[Float, Float] | None
"""Width and height in arrays, or None for those of the set."""


class Parameterization(NamedTuple):
    """A change of variables, differentiable by Dr.Jit.

    Attributes
    ----------
    encode : callable
        ``encode(gaussians) -> dict`` of named arrays.
    decode : callable
        ``decode(fixed, variables, size=None) -> Gaussians``, with `fixed` the argument of
        `encode`. Fields without a variable keep the values of `fixed`. `size` is the width and
        the height of `fixed`, in arrays if the program shall serve every size.
    project : callable
        ``project(fixed, variables, size=None) -> dict``: the variables, moved back into their
        bounds.
    reach : callable
        ``reach(fixed, moves) -> (pad, growth)``: how far the ellipses of the Gaussians reach, in
        pixels and as a factor, if every entry of a variable moves by ``moves[name]``.
    """

    encode: Callable[[Gaussians], Variables]
    decode: Callable[..., Gaussians]
    project: Callable[..., Variables]
    reach: Callable[[Gaussians, dict[str, float]], tuple[Float, float]]


# ---------------------------------------------------------------------------------------------
#  The parameters themselves, in units of the size of each Gaussian
# ---------------------------------------------------------------------------------------------


def _size(g: Gaussians) -> Float:
    """Geometric mean of the standard deviations of a Gaussian, in pixels: ``det F = a c``."""
    return rsqrt(g.factor[0] * g.factor[2])


def _encode_relative(g: Gaussians) -> Variables:
    return _relative_to(g, _size(g))


def _relative_to(g: Gaussians, size: Float) -> Variables:
    return {"mean": g.mean / size, "factor": g.factor * size, "color": g.color}


def _decode_relative(fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Gaussians:
    own = _size(fixed)
    units = {"mean": own, "factor": 1 / own, "color": 1}
    return replace(fixed, **{name: value * units[name] for name, value in variables.items()})


def _project_relative(fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Variables:
    inside = _relative_to(_decode_relative(fixed, variables).bounded(size), _size(fixed))
    return {name: inside[name] for name in variables}


MOVE_SHARE, GROWTH_SHARE = 0.17, 0.07
"""How far Gaussians move and grow, relative to the sum of the rates. Steps change direction: with
these shares, lists miss less than 0.1 % of the tiles just before the next build. The strict bounds,
1 and 1, would make the lists 3.4 times as long."""


def _reach_relative(fixed: Gaussians, moves: dict[str, float]) -> tuple[Float, float]:
    # An array, because another literal in every build would compile the kernels again.
    share = dr.opaque(types_of(fixed.mean).Float, MOVE_SHARE * moves.get("mean", 0.0))
    return share * _size(fixed), 1 + GROWTH_SHARE * moves.get("factor", 0.0)


SCALE_RELATIVE = Parameterization(
    _encode_relative, _decode_relative, _project_relative, _reach_relative
)
"""Mean divided by the size of the Gaussian at the start, factor times this size, and colour. One
learning rate then serves small and large Gaussians, and images of any size."""


# ---------------------------------------------------------------------------------------------
#  The parameters of GaussianImage (Zhang et al., ECCV 2024)
# ---------------------------------------------------------------------------------------------

CHOLESKY_BOUND = 0.5
"""Pixels added to the diagonal of the Cholesky factor, as GaussianImage does."""

MIN_DIAGONAL = 0.01
"""Smallest diagonal entry of the Cholesky factor in pixels. GaussianImage has no such bound, but an
entry that reaches 0 makes the covariance singular, and the set not finite."""


def _encode_cholesky(g: Gaussians) -> Variables:
    types = types_of(g.mean)
    x, y = g.mean
    width, height = (dr.opaque(types.Float, side) for side in (g.width, g.height))
    l1, l2, l3 = cholesky_from_factor(*g.factor)
    return {
        "mean": types.Float2(_atanh(2 * x / width - 1), _atanh(2 * y / height - 1)),
        "cholesky": types.Float3(l1 - CHOLESKY_BOUND, l2, l3 - CHOLESKY_BOUND),
        "color": g.color,
    }


def _atanh(x: Float) -> Float:
    return dr.atanh(dr.clip(x, -0.999999, 0.999999))


def _decode_cholesky(fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Gaussians:
    width, height = size or (fixed.width, fixed.height)
    parts: Variables = {}
    if "mean" in variables:
        x, y = (0.5 * (tanh(v) + 1) for v in variables["mean"])
        parts["mean"] = type(fixed.mean)(x * width, y * height)
    if "cholesky" in variables:
        l1, l2, l3 = variables["cholesky"]
        factor = factor_from_cholesky(l1 + CHOLESKY_BOUND, l2, l3 + CHOLESKY_BOUND)
        parts["factor"] = type(fixed.factor)(factor)
    if "color" in variables:
        parts["color"] = variables["color"]
    return replace(fixed, **parts)


def _project_cholesky(fixed: Gaussians, variables: Variables, size: ImageSize = None) -> Variables:
    if "cholesky" not in variables:
        return variables
    l1, l2, l3 = variables["cholesky"]
    least = MIN_DIAGONAL - CHOLESKY_BOUND
    inside = type(variables["cholesky"])(dr.maximum(l1, least), l2, dr.maximum(l3, least))
    return {**variables, "cholesky": inside}


def _reach_cholesky(fixed: Gaussians, moves: dict[str, float]) -> tuple[Float, float]:
    side = 0.5 * max(fixed.width, fixed.height)  # the slope of tanh is at most 1
    return moves.get("mean", 0.0) * side + moves.get("cholesky", 0.0) * fixed.cutoff, 1.0


CHOLESKY = Parameterization(_encode_cholesky, _decode_cholesky, _project_cholesky, _reach_cholesky)
"""atanh of the mean in [-1, 1], Cholesky factor of the covariance in pixels, and colour."""


class Optimizer(Protocol):
    """The type of optimisers: settings without state, and a step as a pure function.

    The state of a variable is its value and a tuple of arrays of the same type, its moments. One
    kernel then computes the gradients and the steps of all variables.
    """

    def start(self, value: Float) -> tuple:
        """Return the moments of a variable before the first step, evaluated."""

    def step(
        self, value: Float, gradient: Float, moments: tuple, rate: Float, time: Float
    ) -> tuple:
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
            Number of this step; the first is 1.
        """


def zeros_like(value: Float) -> Float:
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
    """Adam of Kingma and Ba, "Adam: A Method for Stochastic Optimization" (2015).

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
        If a beta is outside [0, 1).
    """

    beta_1: float = 0.9
    beta_2: float = 0.999
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        betas = (self.beta_1, self.beta_2)
        if not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"Adam: betas are {betas}; each must be in [0, 1)")

    def start(self, value: Float) -> tuple:
        """Return the moments before the first step; see `Optimizer`."""
        return zeros_like(value), zeros_like(value)

    def step(
        self, value: Float, gradient: Float, moments: tuple, rate: Float, time: Float
    ) -> tuple:
        """Return the value and the moments after a step; see `Optimizer`."""
        m, v = moments
        m = dr.lerp(gradient, m, self.beta_1)
        v = dr.lerp(dr.square(gradient), v, self.beta_2)
        scale = rate * dr.sqrt(debias(self.beta_2, time)) / debias(self.beta_1, time)
        return value - scale * (m / (dr.sqrt(v) + self.epsilon)), (m, v)


@dataclass(frozen=True)
class Adan:
    """Adan of Xie et al., "Adan: Adaptive Nesterov Momentum Algorithm" (2022), no weight decay.

    With the gradient g, its change ``d_t = g_t - g_{t-1}`` (0 in the first step) and the decay
    factors beta of three moving averages::

        m_t = beta_1 m_{t-1} + (1 - beta_1) g_t
        v_t = beta_2 v_{t-1} + (1 - beta_2) d_t
        n_t = beta_3 n_{t-1} + (1 - beta_3) (g_t + beta_2 d_t)^2
        p_t = p_{t-1} - lr (m_t / (1 - beta_1^t) + beta_2 v_t / (1 - beta_2^t))
                          / (sqrt(n_t / (1 - beta_3^t)) + epsilon)

    The betas are those of the authors' implementation: one minus the betas of the paper.

    Parameters
    ----------
    betas : (float, float, float), optional
        Decay factors of the moving averages, each in [0, 1).
    epsilon : float, optional
        Number that bounds the step if gradients vanish.

    Raises
    ------
    ValueError
        If a beta is outside [0, 1).
    """

    betas: tuple[float, float, float] = (0.98, 0.92, 0.99)
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"Adan: betas are {self.betas}; each must be in [0, 1)")

    def start(self, value: Float) -> tuple:
        """Return the moments and the gradient before the first step; see `Optimizer`."""
        return tuple(zeros_like(value) for _ in range(4))

    def step(
        self, value: Float, gradient: Float, moments: tuple, rate: Float, time: Float
    ) -> tuple:
        """Return the value, the moments and the gradient after a step; see `Optimizer`."""
        m, v, n, previous = moments
        beta_1, beta_2, beta_3 = self.betas
        change = dr.select(time == 1, 0, gradient - previous)
        m = dr.lerp(gradient, m, beta_1)
        v = dr.lerp(change, v, beta_2)
        n = dr.lerp(dr.square(dr.fma(change, beta_2, gradient)), n, beta_3)
        move = m / debias(beta_1, time) + beta_2 * v / debias(beta_2, time)
        move /= dr.sqrt(n / debias(beta_3, time)) + self.epsilon
        return dr.fma(move, -rate, value), (m, v, n, gradient)
