"""What optimisers share: their interface, and the moving averages of gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr


class Optimizer(Protocol):
    """The type of optimisers: settings without state, and a step as a pure function.

    The state of a variable is its value and a tuple of arrays of the same type, its moments. One
    kernel then computes the gradients and the steps of all variables.
    """

    def start(self, value: Any) -> tuple:
        """Return the moments of a variable before the first step, evaluated."""

    def step(self, value: Any, gradient: Any, moments: tuple, rate: Any, time: Any) -> tuple:
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


def zeros_like(value: Any) -> Any:
    """Return evaluated zeros with the type and the shape of an array."""
    zeros = dr.zeros(type(value), value.shape)
    dr.make_opaque(zeros)
    return zeros


def debias(beta: float, time: Any) -> Any:
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

    def start(self, value: Any) -> tuple:
        """Return the moments before the first step; see `Optimizer`."""
        return zeros_like(value), zeros_like(value)

    def step(self, value: Any, gradient: Any, moments: tuple, rate: Any, time: Any) -> tuple:
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

    def start(self, value: Any) -> tuple:
        """Return the moments and the gradient before the first step; see `Optimizer`."""
        return tuple(zeros_like(value) for _ in range(4))

    def step(self, value: Any, gradient: Any, moments: tuple, rate: Any, time: Any) -> tuple:
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
