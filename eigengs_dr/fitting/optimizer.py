"""The optimiser Adam. Settings without state; a step is a pure function."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import drjit as dr

from ..backend.types import Float, Rows


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
        If a beta is outside [0, 1).
    """

    beta_1: float = 0.9
    beta_2: float = 0.999
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        betas = (self.beta_1, self.beta_2)
        if not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"Adam: betas are {betas}; each must be in [0, 1)")

    def start(self, value: Rows) -> tuple[Rows, ...]:
        """Return the moments before the first step; see `Optimizer`."""
        return zeros_like(value), zeros_like(value)

    def step(
        self, value: Rows, gradient: Rows, moments: tuple[Rows, ...], rate: Float, time: Float
    ) -> tuple[Rows, tuple[Rows, ...]]:
        """Return the value and the moments after a step; see `Optimizer`."""
        m, v = moments
        m = dr.lerp(gradient, m, self.beta_1)
        v = dr.lerp(dr.square(gradient), v, self.beta_2)
        scale = rate * dr.sqrt(debias(self.beta_2, time)) / debias(self.beta_1, time)
        return value - scale * (m / (dr.sqrt(v) + self.epsilon)), (m, v)
