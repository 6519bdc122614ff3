"""Splats as whole numbers."""

import numpy as np
import pytest
from hypothesis import given

from _helpers.packed import STEPS
from _helpers.sets import SIZE, few, scenes
from eigengs_dr.codec import egs as packed
from eigengs_dr.codec.hilbert_index import MAX_LEVELS
from eigengs_dr.codec.quantization import MAX_SYMBOL, _round_to_steps, quantize
from eigengs_dr.gaussian.covariance import factors_from_log_shapes, log_shapes


@given(scenes())
def test_shapes_are_the_logarithms_of_matrices(scene):
    shape = log_shapes(scene.factor)
    np.testing.assert_allclose(factors_from_log_shapes(shape), scene.factor, rtol=1e-6, atol=1e-6)
    a, b, c = scene.factor.T
    inverse = np.stack([a * a, a * b, a * b, b * b + c * c], -1).reshape(-1, 2, 2)
    values, vectors = np.linalg.eigh(inverse)
    log = np.einsum("nij,nj,nkj->nik", vectors, 0.5 * np.log(values), vectors)
    s, u, v = shape.T
    expected = np.stack([s + u, v, v, s - u], -1).reshape(-1, 2, 2)
    np.testing.assert_allclose(log, expected, atol=1e-5)


def test_shapes_of_extreme_splats():
    factor = np.array([[1e-4, 0, 4], [4, 0, 1e-4], [1, 0, 1], [1e-30, 0, 1e-30], [4, -4, 1e-4]])
    np.testing.assert_allclose(
        factors_from_log_shapes(log_shapes(factor)), factor, rtol=1e-6, atol=1e-9
    )


@few
@given(scenes())
def test_rounding_moves_by_half_a_step(scene):
    shape = log_shapes(scene.factor)
    symbols = quantize(scene.mean, shape, scene.color, STEPS)
    found = packed.EgsContent([symbols], STEPS, np.zeros(3, np.float32), SIZE, "data").arrays()
    near = log_shapes(found["factor"])
    assert np.abs(found["mean"] - scene.mean).max() <= STEPS.mean / 2 + 1e-5
    assert np.abs(near - shape)[:, 0].max() <= STEPS.scale / 2 + 1e-5
    assert np.abs(near - shape)[:, 1:].max() <= STEPS.stretch / 2 + 1e-5
    unit = np.exp(near[:, :1]) * STEPS.color
    assert (np.abs(found["color"] - scene.color) <= unit / 2 + 1e-5).all()


def test_numbers_beyond_the_largest_are_refused():
    with pytest.raises(ValueError, match="a mean is 8388608 steps or more"):
        quantize(np.full((1, 2), 1e9), np.zeros((1, 3)), np.zeros((1, 3)), STEPS)
    ends = np.array([[-MAX_SYMBOL + 1.0], [MAX_SYMBOL - 1.0]])
    assert int(np.ptp(_round_to_steps("mean", ends, 1.0))).bit_length() == MAX_LEVELS
    with pytest.raises(ValueError, match="a mean is"):
        _round_to_steps("mean", ends + 1, 1.0)
