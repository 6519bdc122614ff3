"""Pictures of models: everything is there, in scale, and the outlines are where the splats are."""

import numpy as np
import pytest

from _helpers.photos import SMALL, random_fields
from eigengs_dr.eigenbasis.options import TrainOptions
from eigengs_dr.eigenbasis.training import train
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.resize import GAP, resample
from eigengs_dr.raster.render import render
from eigengs_dr.viewer import pictures
from eigengs_dr.viewer.pictures import LIGHTER, comparison, ellipses, overlay
from eigengs_dr.viewer.sheets import CELL, component_sheet

CAPTION = 12
"""Height of the line above a picture."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    photos = random_fields(folder / "photos", 12)
    settings = TrainOptions(**SMALL, frequency_aware=True)
    return train(photos, folder / "model.npz", settings)


def cell(sheet, column, row):
    """One picture of the first table."""
    x, y = column * (CELL + GAP), CAPTION + GAP + row * (CELL + GAP)
    return sheet[y : y + CELL, x : x + CELL]


def test_the_mean_comes_first(trained):
    sheet = component_sheet(trained.model, trained.basis)
    rendered = resample(render(trained.model.gaussians).numpy(), CELL, CELL)
    np.testing.assert_allclose(cell(sheet, 0, 1), rendered, atol=1e-5)
    mean = resample(trained.basis.reconstruct([np.zeros(6)] * 3), CELL, CELL)
    np.testing.assert_allclose(cell(sheet, 0, 0), mean, atol=1e-5)
    np.testing.assert_array_equal(cell(component_sheet(trained.model), 0, 0), cell(sheet, 0, 1))


def test_a_component_is_above_its_rendering_on_one_scale(trained):
    model, basis = trained.model, trained.basis
    sheet = component_sheet(model, basis)
    for column, j in ((1, 0), (2, 1)):
        shown = cell(sheet, column, 0) - 0.5
        component = resample(basis.components[0][j][..., None], CELL, CELL)
        factor = shown[..., :1].ravel() @ component.ravel() / np.square(component).sum()
        np.testing.assert_allclose(shown, np.repeat(factor * component, 3, 2), atol=1e-4)
        assert 0.4 < np.abs(shown).max() < 0.8
    high = cell(sheet, 4, 1) - 0.5  # component 5 of all 54 fine splats looks like the original
    assert np.corrcoef(high.ravel(), cell(sheet, 4, 0).ravel())[0, 1] > 0.95


def test_sheets_are_of_moderate_size(trained):
    for sheet in (component_sheet(trained.model, trained.basis), component_sheet(trained.model)):
        assert sheet.shape[2] == 3
        assert max(sheet.shape) < 2000
        assert np.isfinite(sheet).all()


def test_a_basis_of_something_else_is_refused(trained):
    with pytest.raises(ValueError, match="pass the basis it was fitted to"):
        component_sheet(trained.model, trained.basis.truncated(5))


def test_outlines_are_one_standard_deviation_away():
    covariance = np.array([[90.0, 40.0], [40.0, 50.0]])
    lower = np.linalg.cholesky(np.linalg.inv(covariance))
    factor = [[lower[0, 0], lower[1, 0], lower[1, 1]]]
    splat = Gaussians.from_arrays([[30, 25]], factor, [[1.0]], size=(80, 40), space="data")
    picture = ellipses(splat)
    assert picture.shape == (400, 800, 3)
    y, x = np.nonzero(picture[..., 0] < 0.6)
    away = np.stack([x + 0.5, y + 0.5], axis=1) / 10 - [30, 25]
    distance = np.sqrt(np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away))
    assert len(x) > 300
    np.testing.assert_allclose(distance, 1, atol=0.06)


def test_low_splats_have_another_colour():
    means, factors = [[10, 10], [30, 10]], [[0.2, 0, 0.2]] * 2
    splats = Gaussians.from_arrays(means, factors, [[1.0]] * 2, size=(40, 20), space="data")
    drawn = 1 - ellipses(splats, low=1)
    left, right = drawn[:, :400].sum(axis=(0, 1)), drawn[:, 400:].sum(axis=(0, 1))
    assert left[2] > left[0]  # orange lacks blue
    assert right[0] > right[2]  # and blue lacks red


def test_a_thin_set_can_be_drawn():
    splat = Gaussians.from_arrays([[1, 9]], [[1, 0, 0.01]], [[1.0]], size=(1, 5000), space="data")
    assert ellipses(splat).shape == (800, 1, 3)


def round_splats(means, sigma, size, space="data", channels=1):
    colors = np.ones((len(means), channels))
    factors = [[1 / sigma, 0, 1 / sigma]] * len(means)
    return Gaussians.from_arrays(means, factors, colors, size=size, space=space)


def test_an_overlay_is_the_picture_lightened_below_the_outlines():
    picture = np.random.default_rng(0).uniform(0, 1, (40, 60, 3))
    drawn = overlay(round_splats([[10, 10]], 2.0, (30, 20)), picture)  # scaled: 4 around (20, 20)
    assert drawn.shape == picture.shape
    y, x = np.mgrid[:40, :60] + 0.5
    away = np.abs(np.hypot(x - 20, y - 20) - 4)
    expected = LIGHTER + (1 - LIGHTER) * picture
    np.testing.assert_allclose(drawn[away > 2], expected[away > 2], atol=0.003)
    assert (drawn[away < 0.3][:, 0] < 0.6).all()


@pytest.mark.parametrize(
    ("space", "channels"), [("ycbcr", 3), ("rgb", 3), ("linear", 3), ("data", 1), ("data", 3)]
)
def test_an_overlay_of_every_space(space, channels):
    splats = round_splats([[10, 10]], 4.0, (30, 20), space, channels)
    drawn = overlay(splats, np.ones((20, 30, channels)))
    assert drawn.shape == (20, 30, 3)
    assert drawn.min() < 0.5 < drawn.max()


def test_single_outlines_can_be_told_apart(monkeypatch):
    """Of many splats some are drawn, always the same, and neither the first nor every third."""
    monkeypatch.setattr(pictures, "MAX_OUTLINES", 4)
    splats = round_splats([[30 + 60 * n, 10] for n in range(10)], 5.0, (600, 20))
    drawn, again = (overlay(splats, np.ones((20, 600, 1)))[..., 0] for _ in range(2))
    np.testing.assert_array_equal(drawn, again)
    shown = np.flatnonzero(drawn.reshape(20, 10, 60).min(axis=(0, 2)) < 1)
    assert len(shown) == 4
    assert len(set(np.diff(shown))) > 1


@pytest.mark.parametrize("mean", [[-1e6, 5], [5, 1e6], [3e38, 3e38]])
def test_what_lies_outside_is_not_drawn(mean):
    assert (overlay(round_splats([mean], 4.0, (30, 20)), np.ones((20, 30, 1))) == 1).all()


@pytest.mark.parametrize("sigma", [1e6, 1e30])
def test_what_is_huge_is_not_drawn(sigma):
    drawn = overlay(round_splats([[sigma, 5]], sigma, (30, 20)), np.ones((20, 30, 1)))
    assert (drawn == 1).all()


def test_a_comparison_repeats_the_pixels_of_small_images():
    image, fit = np.random.default_rng(0).uniform(0, 1, (2, 20, 100, 3))
    splats = round_splats([[30, 10]], 4.0, (100, 20))
    shown = comparison(image, fit, splats)
    assert shown.shape == (6 * 20, 3 * 600, 3)
    for k, part in enumerate((image, fit)):
        for first in (0, 5):
            np.testing.assert_array_equal(
                shown[first::6, 600 * k + first : 600 * (k + 1) : 6], part
            )
    large = fit.repeat(6, axis=0).repeat(6, axis=1)
    np.testing.assert_array_equal(shown[:, 1200:], overlay(splats, large))


@pytest.mark.parametrize(("height", "width", "times"), [(300, 512, 1), (700, 1, 1), (1, 511, 2)])
def test_a_comparison_keeps_the_shape(height, width, times):
    grey = np.full((height, width, 1), 0.5)
    shown = comparison(grey, grey, round_splats([[0.5, 0.5]], 4.0, (width, height)))
    assert shown.shape == (times * height, 3 * times * width, 3)
