"""Parts of a set."""

import numpy as np

from _helpers.footprints import matrices
from eigengs_dr.blocks.draw import draw
from eigengs_dr.gaussian.file import CUTOFF, SetData, crop


def random_set(count=200, size=(96, 64)):
    """Gaussians of many sizes and angles."""
    rng = np.random.default_rng(3)
    mean = rng.uniform(0, size, (count, 2))
    a, c = np.exp(rng.uniform(-2.5, 0.5, (2, count)))
    factor = np.stack([a, rng.normal(0, 0.3, count), c], axis=1)
    color = rng.normal(0, 0.3, (count, 3))
    arrays = {"mean": mean, "factor": factor, "color": color, "background": [0.4, 0.5, 0.5]}
    return SetData({k: np.asarray(v, np.float32) for k, v in arrays.items()}, size, "data")


def test_only_gaussians_that_touch_are_kept():
    data = random_set()
    part = crop(data, (40, 30), (8, 8))
    assert 0 < len(part.arrays["mean"]) < len(data.arrays["mean"])
    kept = np.isin(data.arrays["color"][:, 0], part.arrays["color"][:, 0])
    variances = np.diagonal(matrices(*data.arrays["factor"].T.astype(float)), axis1=1, axis2=2)
    away = np.abs(data.arrays["mean"] - (44, 34)) - CUTOFF * np.sqrt(variances)
    assert kept[(away <= 4).all(axis=1)].all()
    assert not kept[(away > 5.1).any(axis=1)].any()


def test_part_without_gaussians_is_background():
    data = random_set(1)
    data.arrays["mean"][:] = 2
    data.arrays["factor"][:] = [2, 0, 2]
    part = crop(data, (50, 30), (4, 3))
    assert len(part.arrays["mean"]) == 0
    found = draw(part, "llvm")
    np.testing.assert_array_equal(found, np.broadcast_to(np.float32([0.4, 0.5, 0.5]), (3, 4, 3)))
