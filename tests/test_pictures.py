"""Pictures of models: everything is there, in scale, and the outlines are where the splats are."""

import numpy as np
import pytest
from test_training import SMALL, random_fields

from eigengs_dr.gaussians import Gaussians
from eigengs_dr.images import resampled
from eigengs_dr.pictures import CELL, GAP, component_sheet, ellipses
from eigengs_dr.rendering import render
from eigengs_dr.training import Settings, train

CAPTION = 12
"""Height of the line above a picture."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    photos = random_fields(folder / "photos", 12)
    settings = Settings(**SMALL, frequency_aware=True)
    return train(photos, folder / "model.npz", settings)


def cell(sheet, column, row):
    """One picture of the first table."""
    x, y = column * (CELL + GAP), CAPTION + GAP + row * (CELL + GAP)
    return sheet[y : y + CELL, x : x + CELL]


def test_the_mean_comes_first(trained):
    sheet = component_sheet(trained.model, trained.basis)
    rendered = resampled(render(trained.model.gaussians).numpy(), CELL, CELL)
    np.testing.assert_allclose(cell(sheet, 0, 1), rendered, atol=1e-5)
    mean = resampled(trained.basis.reconstruct([np.zeros(6)] * 3), CELL, CELL)
    np.testing.assert_allclose(cell(sheet, 0, 0), mean, atol=1e-5)
    np.testing.assert_array_equal(cell(component_sheet(trained.model), 0, 0), cell(sheet, 0, 1))


def test_a_component_is_above_its_rendering_on_one_scale(trained):
    model, basis = trained.model, trained.basis
    sheet = component_sheet(model, basis)
    for column, j in ((1, 0), (2, 1)):
        shown = cell(sheet, column, 0) - 0.5
        component = resampled(basis.components[0][j][..., None], CELL, CELL)
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
