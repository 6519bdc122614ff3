"""A descent of one variable by an optimiser."""

import drjit as dr
import numpy as np


def minimize(optimizer, value, gradient, rate, steps):
    """Values after each step, shape (steps, n), for ``gradient(value)`` on the device."""
    Float, moments, path = type(value), optimizer.start(value), []
    for t in range(1, steps + 1):
        value, moments = optimizer.step(value, gradient(value), moments, Float(rate), Float(t))
        dr.eval(value, moments)
        path.append(value.numpy().copy())
    return np.array(path)
