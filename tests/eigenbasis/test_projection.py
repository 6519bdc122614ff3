"""How few components are enough for one image."""

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

import eigengs_dr as eg
from _helpers.families import family, small_model, splits
from eigengs_dr.image.color import RGB_TO_YCBCR, YCBCR_OFFSET, to_planes


@pytest.fixture(scope="module")
def others():
    """Images of the family of `small_basis` that it was not made of."""
    return family(6, seed=1)


def shown(model, coefficients):
    return eg.render(model.reconstruct(coefficients)).numpy()


@splits
@pytest.mark.parametrize("target", [21, 23])
def test_encode_meets_a_bound_with_the_fewest(backend, others, split, target):
    model = small_model(backend, split)
    for image in others:
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


@splits
@pytest.mark.parametrize("mean", ["gaussians", "dense"])
def test_encode_is_as_before_without_a_target(backend, others, split, mean):
    """The same bits as least squares on all components, written out."""
    model = small_model(backend, split)
    equations = model.encoder.equations
    black = np.outer(np.append(equations.coverage, 32**2), YCBCR_OFFSET)
    seen = equations.correlate(np.moveaxis(others[0], 2, 0)) @ RGB_TO_YCBCR.T + black
    planes = to_planes(others[0], "ycbcr").reshape(3, 32, 32)
    np.testing.assert_allclose(seen, equations.correlate(planes), rtol=1e-6)
    if mean == "dense":
        seen -= equations.correlate(model.mean_image)
    arrays = model.gaussians.to_arrays()
    start = np.vstack([arrays["color"], arrays["background"]]).astype(np.float64)
    if mean == "gaussians":
        seen = seen - equations.product(start)
    columns = []
    for c, weights in enumerate(model.weights):
        rows = weights.astype(np.float64)
        gram = rows @ equations.product(rows.T)
        gram += np.eye(len(gram)) * (1e-9 * np.trace(gram) / len(gram) + 1e-30)
        right = np.einsum("jn,n->j", weights, seen[:, c].astype(np.float32))
        a = cho_solve(cho_factor(gram, lower=True), right).astype(np.float32)
        columns.append(np.einsum("j,jn->n", a, weights))
    curve_from_eigenvalues = np.stack(columns, axis=1).astype(np.float64)
    if mean == "gaussians":
        curve_from_eigenvalues = start + curve_from_eigenvalues
    found = model.encode(others[0], "projected", mean).to_arrays()
    np.testing.assert_array_equal(found["color"], curve_from_eigenvalues[:-1].astype(np.float32))
    np.testing.assert_array_equal(
        found["background"], curve_from_eigenvalues[-1].astype(np.float32)
    )


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
    with pytest.warns(UserWarning, match=r"out of reach: all 12\+6\+6 components have 2\d\."):
        found = model.project(others[0], 60)
    np.testing.assert_allclose(
        np.concatenate(found), np.concatenate(model.project(others[0])), atol=1e-5
    )
