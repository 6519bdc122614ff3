"""How few components are enough for one image."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_model, splits
from eigengs_dr.image.space import to_planes


def shown(model, coefficients):
    return eg.render(model.reconstruct(coefficients)).numpy()


@splits
@pytest.mark.parametrize("target", [21, 23])
def test_encode_meets_a_bound_with_the_fewest(backend, others, split, target):
    model = small_model(backend, split)
    for image in others[:3]:
        found = model.project(image, target)
        assert eg.psnr(image, shown(model, found), "ycbcr") >= target - 1e-3
        counts = [len(w) for w in found]
        assert sum(counts) < sum(model.components)
        for c in np.flatnonzero(counts):
            fewer = [k - (i == c) for i, k in enumerate(counts)]
            best = truncated(model, fewer).project(image)
            assert eg.psnr(image, shown(model, best), "ycbcr") < target + 1e-3
        np.testing.assert_allclose(
            np.concatenate(found),
            np.concatenate(truncated(model, counts).project(image)),
            atol=1e-4,
        )


def truncated(model, counts):
    weights = tuple(w[:k] for w, k in zip(model.weights, counts, strict=True))
    values = tuple(v[:k] for v, k in zip(model.eigenvalues, counts, strict=True))
    return eg.EigenGS(model.gaussians, weights, values, model.mean_image, model.low)


def test_an_image_of_a_subspace_needs_no_more(backend):
    model = small_model(backend)
    only = (np.array([0.0, 0.9], np.float32), np.zeros(0), np.array([0.5], np.float32))
    image = shown(model, only)
    found = model.project(image, 55)
    assert [len(w) for w in found] == [2, 0, 1]
    np.testing.assert_allclose(np.concatenate(found), np.concatenate(only), atol=2e-3)
    assert [len(w) for w in model.project(shown(model, (only[1],) * 3), 55)] == [0, 0, 0]


def test_encode_with_a_dense_mean(backend, others):
    model, image = small_model(backend), others[0]
    left = eg.render(model.encode(image, "projected", "dense", target_psnr=24)).numpy()
    nothing = eg.render(model.encode(0 * image, "projected", "dense", target_psnr=1)).numpy()
    assert left.shape == nothing.shape
    planes = to_planes(left, "ycbcr").reshape(3, 32, 32) + model.mean_image
    error = planes - to_planes(image, "ycbcr").reshape(3, 32, 32)
    assert -10 * np.log10(np.square(error).mean()) >= 24 - 1e-3


def test_wrong_or_unmet_targets(backend, others):
    model = small_model(backend)
    with pytest.raises(ValueError, match="colors 'projected'"):
        model.encode(others[0], target_psnr=24)
    for target in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="target_psnr is"):
            model.project(others[0], target)
    with pytest.warns(UserWarning, match=r"out of reach: all 12\+6\+6 components reach 2\d\."):
        found = model.project(others[0], 60)
    np.testing.assert_allclose(
        np.concatenate(found), np.concatenate(model.project(others[0])), atol=1e-5
    )
