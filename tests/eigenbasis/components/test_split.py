"""The split into low and high components."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_basis, small_model, splits


@splits
def test_split_keeps_sides_apart(backend, split):
    model = small_model(backend, split)
    low, first = model.low, model.low_components
    assert (low, first) == ((10, 6) if split else (0, 0))
    for weights in model.weights:
        assert not weights[:first, low:-1].any() or not split
        assert not weights[first:, :low].any()
        assert np.abs(weights).max(axis=1).min() > 0
    areas = 1 / np.prod(model.gaussians.to_arrays()["factor"][:, [0, 2]], axis=1)
    if split:
        assert areas[:low].min() > 5 * areas[low:].max()


def test_a_tenth_of_the_splats_is_low(backend):
    assert eg.EigenGS.fit(small_basis(), 17, True, backend=backend).low == 2
    assert eg.EigenGS.fit(small_basis(), 1, True, backend=backend).low == 0


@pytest.mark.parametrize(("width", "low"), [(511, 0), (512, 3)])
def test_auto_splits_large_images_alone(backend, width, low):
    images = np.random.default_rng(0).random((4, 8, width, 3))
    basis = eg.Eigenbasis.from_images(images, (width, 8), 3)
    assert eg.EigenGS.fit(basis, 30, backend=backend).low == low
