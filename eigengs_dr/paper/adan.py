"""The optimiser Adan of Xie et al. (2022), which EigenGS and GaussianImage use."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ..backend.entry_points import check_fields
from ..backend.types import Float, Rows
from ..fitting.state import debias, zeros_like


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

    The betas follow the convention of the authors' code: one minus the betas of the paper.

    Parameters
    ----------
    betas : (float, float, float), optional
        Decay factors of the moving averages, each in [0, 1).
    epsilon : float, optional
        Bounds the step if gradients vanish.

    Raises
    ------
    ValueError
        If a beta is outside [0, 1).
    """

    betas: tuple[float, float, float] = (0.98, 0.92, 0.99)
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        check_fields(self, epsilon="[0, inf)")
        if len(self.betas) != 3 or not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"Adan: betas are {self.betas}; give three in [0, 1)")

    def start(self, value: Rows) -> tuple[Rows, ...]:
        """Return the initial moments and gradient; see `Optimizer`."""
        return tuple(zeros_like(value) for _ in range(4))

    def step(
        self, value: Rows, gradient: Rows, moments: tuple[Rows, ...], rate: Float, time: Float
    ) -> tuple[Rows, tuple[Rows, ...]]:
        """Return the value, the moments and the gradient after a step; see `Optimizer`."""
        m, v, n, previous = moments
        beta_1, beta_2, beta_3 = self.betas
        change = dr.select(time == 1, 0, gradient - previous)
        m = dr.lerp(gradient, m, beta_1)
        v = dr.lerp(change, v, beta_2)
        n = dr.lerp(dr.square(dr.fma(change, beta_2, gradient)), n, beta_3)
        direction = m / debias(beta_1, time) + beta_2 * v / debias(beta_2, time)
        direction /= dr.sqrt(n / debias(beta_3, time)) + self.epsilon
        return dr.fma(direction, -rate, value), (m, v, n, gradient)
