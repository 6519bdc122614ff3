"""Adan, an adaptive optimiser with Nesterov momentum, as a `drjit.opt.Optimizer`."""

from __future__ import annotations

from typing import Any

import drjit as dr
from drjit.opt import Optimizer


class Adan(Optimizer):
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
    lr : float or Dr.Jit array
        Learning rate.
    params : mapping of str to arrays, optional
        Initial parameters.
    betas : (float, float, float), optional
        Decay factors of the moving averages, each in [0, 1).
    epsilon : float, optional
        Number that bounds the step if gradients vanish.

    Raises
    ------
    ValueError
        If a beta is outside [0, 1).
    """

    def __init__(
        self,
        lr: Any,
        params: Any = None,
        *,
        betas: tuple[float, float, float] = (0.98, 0.92, 0.99),
        epsilon: float = 1e-8,
    ) -> None:
        if not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"Adan: betas are {betas}; each must be in [0, 1)")
        self.betas, self.epsilon = betas, epsilon
        super().__init__(lr, params)

    def _step(self, cache: Any, value: Any, grad: Any, lr: Any, extra: Any, /) -> tuple[Any, Any]:
        t, m, v, n, previous = extra
        beta_1, beta_2, beta_3 = self.betas
        t = t + 1
        change = dr.select(t == 1, 0, grad - previous)
        m = dr.lerp(grad, m, beta_1)
        v = dr.lerp(change, v, beta_2)
        n = dr.lerp(dr.square(dr.fma(change, beta_2, grad)), n, beta_3)
        Float = dr.leaf_t(grad)
        time = Float(t)
        debias_1, debias_2, debias_3 = (1 - Float(beta) ** time for beta in self.betas)
        step = m / debias_1 + beta_2 * v / debias_2
        step /= dr.sqrt(n / debias_3) + self.epsilon
        scale = cache.product(Float, lr)
        return dr.fma(step, -scale, value), (t, m, v, n, grad)

    def _reset(self, key: str, value: Any, promoted: bool, /) -> None:
        flat = value.array
        zeros = [dr.opaque(type(flat), 0, flat.shape) for _ in range(4)]
        t = dr.uint32_array_t(dr.leaf_t(flat))(0)
        self.state[key] = value, promoted, None, (t, *zeros)
