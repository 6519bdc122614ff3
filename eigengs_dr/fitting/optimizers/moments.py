"""What optimisers share: their interface, and the moving averages of gradients."""

from __future__ import annotations

import math
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
