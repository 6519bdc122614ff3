"""Components as renderings of shared splats, also split into low and high ones."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SIDE, SPLATS, small_basis, small_model, splits
from eigengs_dr.eigenbasis.components import TrainOptions, fit_model
from eigengs_dr.eigenbasis.normal_equations import NormalEquations


@splits
def test_components_are_rendered(backend, split):
    """Every component is what its weights make of the splats, the mean image too."""
    model, basis = small_model(backend, split), small_basis()
    assert model.components == (12, 6, 6)
    assert len(model.gaussians) == SPLATS
    mean = eg.render(model.gaussians).numpy()
    expected = basis.reconstruct([np.zeros(k) for k in model.components])
    assert eg.psnr(mean, expected, "ycbcr") > 50
    # A tenth of 100 splats is few for the first components.
    assert model.figures["psnr_components"] > (30 if split else 40)
    none = [np.zeros(k, np.float32) for k in model.components]
    for channel, j in ((0, 0), (0, 11), (2, 3)):
        only = [w.copy() for w in none]
        only[channel][j] = 1
        shown = eg.render(model.reconstruct(tuple(only))).numpy() - mean
        wanted = basis.reconstruct(only) - basis.reconstruct(none)
        share = 0.2 if split and j < model.low_components else 0.03
        assert np.square(shown - wanted).sum() < share * np.square(wanted).sum()


def test_weights_are_the_best(backend):
    """No change of the weights lowers the error: it is orthogonal to all splats."""
    model, basis = small_model(backend), small_basis()
    equations = NormalEquations(model.gaussians)
    for weights, planes in zip(model.weights, basis.components, strict=True):
        correlations = equations.correlate(planes)
        gradient = equations.product(weights.T.astype(float)) - correlations
        assert np.abs(gradient).max() < 2e-3 * np.abs(correlations).max()


def test_psnr_components_is_the_weighted_error(backend):
    model, basis = small_model(backend), small_basis()
    error = 0.0
    for c, values in enumerate(basis.eigenvalues):
        weights = model.weights[c]
        shapes = model.gaussians.to_arrays() | {
            "color": weights[:, :-1].T,
            "background": weights[:, -1],
        }
        found = eg.Gaussians.from_arrays(**shapes, size=(SIDE, SIDE), space="data", backend=backend)
        planes = np.moveaxis(eg.render(found).numpy(), 2, 0)
        error += values @ np.square(planes - basis.components[c]).sum(axis=(1, 2))
    expected = -10 * np.log10(error / basis.mean.size)
    assert model.figures["psnr_components"] == pytest.approx(expected, abs=0.05)


def test_bands_start_apart(backend):
    """Each side of the paper's training draws a start of its own."""
    seen = []
    options = TrainOptions(
        (SIDE, SIDE), gaussians=20, frequency_aware=True, preset="eigengs", iterations=1
    )
    fit_model(
        small_basis(), options, backend, after_round=lambda states, *_: seen.append(states[-1])
    )
    first, second = (state["rows"][0, :5, :2] for state in seen)
    assert not np.array_equal(first, second)


def test_split_keeps_sides_apart(backend):
    model = small_model(backend, split=True)
    low, first = model.low, model.low_components
    assert (low, first) == (10, 6)
    for weights in model.weights:
        assert not weights[:first, low:-1].any()
        assert not weights[first:, :low].any()
        assert np.abs(weights).max(axis=1).min() > 0
    areas = 1 / np.prod(model.gaussians.to_arrays()["factor"][:, [0, 2]], axis=1)
    assert areas[:low].min() > 5 * areas[low:].max()


def test_a_tenth_of_the_splats_is_low(backend):
    assert eg.EigenGS.fit(small_basis(), 17, True, backend=backend).low == 2
    assert eg.EigenGS.fit(small_basis(), 1, True, backend=backend).low == 0


@pytest.mark.parametrize(("width", "low"), [(511, 0), (512, 3)])
def test_auto_splits_large_images_alone(backend, width, low):
    images = np.random.default_rng(0).random((4, 8, width, 3))
    basis = eg.Eigenbasis.from_images(images, (width, 8), 3)
    assert eg.EigenGS.fit(basis, 30, backend=backend).low == low
