"""Colours on shared shapes: the factorised equations against dense least squares."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from _helpers.sets import COUNT, SIZE, few, random_scene, scenes
from eigengs_dr.eigenbasis.normal_equations import RIDGE, NormalEquations, weight_matrix


def dense_matrix(scene, cutoff=np.inf):
    """Weights of all splats at all pixels, and a column of ones, in float64: (H W, N + 1)."""
    distances = scene.distances().reshape(len(scene.mean), -1)
    weights = np.exp(-0.5 * distances**2) * (distances <= cutoff)
    return np.vstack([weights, np.ones(weights.shape[1])]).T


def images(count=3, seed=0):
    return np.random.default_rng(seed).uniform(0, 1, (count, SIZE[1], SIZE[0])).astype(np.float32)


@pytest.mark.parametrize("cutoff", [2.0, 5.0])
@few
@given(scene=scenes())
def test_splat_matrix(backend, cutoff, scene):
    """Every weight of brute force, and nothing else but on the edge of a cutoff."""
    matrix = weight_matrix(replace(scene.on(backend), cutoff=cutoff)).toarray()
    expected = dense_matrix(scene, cutoff)[:, :-1].T
    away = scene.off_edge(cutoff).ravel()
    np.testing.assert_allclose(matrix[:, away], expected[:, away], atol=1e-5)


def test_solve_is_least_squares(backend):
    """The residual is that of NumPy's least squares: the ridge costs nothing that matters.

    Splats outside of the image have empty rows, and no colour.
    """
    scene = random_scene(1)
    scene.mean[:5] = [-500, 900]
    matrix = weight_matrix(scene.on(backend)).toarray().astype(np.float64).T
    assert matrix.shape == (SIZE[0] * SIZE[1], COUNT) and not matrix[:, :5].any()
    matrix = np.hstack([matrix, np.ones((len(matrix), 1))])
    targets = images().reshape(3, -1).T
    best = np.linalg.lstsq(matrix, targets, rcond=None)[0]
    equations = NormalEquations(scene.on(backend))
    found = equations.solve(equations.correlate(images()))
    left, least = (np.square(matrix @ x - targets).sum(axis=0) for x in (found, best))
    assert (left >= least * (1 - 1e-6)).all()
    np.testing.assert_allclose(left, least, rtol=1e-3)
    np.testing.assert_allclose(found[:5], 0, atol=1e-6)


def test_blocks_fit_what_is_left(backend):
    """First splats fit the image alone, with the background; the others the difference."""
    scene, low = random_scene(8), 9
    both = NormalEquations(scene.on(backend), low)
    first, rest = (scene.permuted(order).on(backend) for order in (slice(low), slice(low, None)))
    found = both.solve(both.correlate(images()))
    alone = NormalEquations(first)
    coarse = alone.solve(alone.correlate(images()))
    np.testing.assert_allclose(found[:low], coarse[:-1], atol=1e-4)
    np.testing.assert_allclose(found[-1], coarse[-1], atol=1e-4)
    left = images().reshape(3, -1).T - (weight_matrix(first).T @ coarse[:-1] + coarse[-1])
    matrix = weight_matrix(rest).astype(np.float64)
    gram = (matrix @ matrix.T).toarray()
    gram += RIDGE * gram.diagonal().mean() * np.eye(len(gram))
    np.testing.assert_allclose(found[low:-1], np.linalg.solve(gram, matrix @ left), atol=2e-3)


def test_a_matrix_too_large_is_refused(backend):
    scene = random_scene(size=(4096, 4096))._replace(factor=np.tile([1e-5, 0, 1e-5], (COUNT, 1)))
    with pytest.raises(ValueError, match="cover 402,653,184 pixels in total, the limit is"):
        NormalEquations(scene.on(backend))
