"""Gaussians as integers."""

import numpy as np
import pytest
from hypothesis import given

from _helpers.sets import few, scenes
from eigengs_dr.codec import quantization as qz
from eigengs_dr.codec.quantization import MAX_SYMBOL, Quantizer, Steps, log_shapes, quantize

STEPS = Steps(0.03125, 0.25)


@few
@given(scenes())
def test_rounding_moves_by_half_a_step(scene):
    symbols = quantize(scene._asdict(), STEPS)
    quantizer = Quantizer(symbols.color, STEPS.cell)
    found, q = qz.dequantize(symbols, STEPS), quantizer.precision
    near, far = log_shapes(found["factor"]), log_shapes(scene.factor)
    long = [np.hypot(shape[:, 1], shape[:, 2]) for shape in (near, far)]
    assert (np.abs(near - far)[:, 0] * q <= 0.5 * qz.SCALE_STEP + 1e-4 * q).all()
    assert (np.abs(long[0] - long[1]) * q <= 0.5 * qz.STRETCH_STEP + 1e-4 * q).all()
    a, b, c = found["factor"].T
    x, y = (found["mean"] - scene.mean).T
    # A mean in a cell without a grid is half a cell off; otherwise half a step of F m.
    grid = quantizer.parts(found["factor"])
    for away, side, parts in ((a * x + b * y, a, grid[:, 0]), (c * y, c, grid[:, 1])):
        assert (np.abs(away) <= 0.5 * STEPS.cell * side / parts * 1.01 + 1e-3 * side).all()
    unit = STEPS.color * np.exp(far[:, :1])
    amplitude = np.exp(-near[:, :1]) * found["color"] / STEPS.color
    assert (np.abs(amplitude - scene.color / unit) <= 0.5 + 1e-3).all()


def test_numbers_beyond_the_largest_are_refused():
    shape = {"factor": np.array([[1.0, 0, 1]]), "color": np.zeros((1, 1))}
    for mean in (1e9, -1e9, np.nan):
        with pytest.raises(ValueError, match="a mean is 8388608 steps or more"):
            quantize({**shape, "mean": np.full((1, 2), mean)}, Steps(1.0, 1.0))
    edge = quantize({**shape, "mean": np.full((1, 2), MAX_SYMBOL - 1.0)}, Steps(1.0, 1.0))
    assert (edge.cell == MAX_SYMBOL - 1).all()
