"""Adam, an adaptive optimiser with momentum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from .moments import debias, zeros_like


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
