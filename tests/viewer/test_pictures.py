"""Pictures of models: everything is there, in scale, and the outlines are where the splats are."""

import numpy as np
import pytest

from _helpers.families import small_basis, small_model
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.image.resize import resample
from eigengs_dr.image.sheet import GAP
from eigengs_dr.raster.render import render
from eigengs_dr.viewer.pictures import (
    CELL_SIDE,
    MAX_OUTLINES,
    WHITE_SHARE,
    comparison,
    component_sheet,
    ellipses,
    overlay,
)


def test_a_sheet_has_components_above_their_renderings():
    model, basis = small_model("llvm"), small_basis()
    sheet, alone = component_sheet(model, basis), component_sheet(model)
    for found in (sheet, alone):
        assert found.shape[2] == 3 and max(found.shape) < 2000
        assert np.isfinite(found).all()
    step, top = CELL_SIDE + GAP, 12 + GAP  # below a line of text
    cells = [
        [sheet[top + row * step :, column * step :][:CELL_SIDE, :CELL_SIDE] for row in range(2)]
        for column in range(3)
    ]
    np.testing.assert_array_equal(cells[0][1], alone[top : top + CELL_SIDE, :CELL_SIDE])
    mean = basis.reconstruct([np.zeros(k) for k in model.components])
    rendered = render(model.gaussians).numpy()
    for shown, expected in zip(cells[0], (mean, rendered), strict=True):
        np.testing.assert_allclose(shown, resample(expected, CELL_SIDE, CELL_SIDE), atol=1e-5)
    for column, j in ((1, 0), (2, 1)):
        shown = cells[column][0] - 0.5
        component = resample(basis.components[0][j][..., None], CELL_SIDE, CELL_SIDE)
        factor = shown[..., :1].ravel() @ component.ravel() / np.square(component).sum()
        np.testing.assert_allclose(shown, np.repeat(factor * component, 3, 2), atol=1e-4)
        assert 0.4 < np.abs(shown).max() < 0.8
    # A rendering looks like the original.
    assert np.corrcoef(*(part.ravel() for part in cells[1]))[0, 1] > 0.95


def test_outlines_are_one_standard_deviation_away():
    factor = np.array([[0.11, 0.0], [-0.09, 0.14]])
    splat = Gaussians.from_arrays(
        [[30, 25]], [[*factor[:, 0], factor[1, 1]]], [[1.0]], size=(80, 40), space="data"
    )
    picture = ellipses(splat)
    assert picture.shape == (400, 800, 3)
    y, x = np.nonzero(picture[..., 0] < 0.6)
    away = np.stack([x + 0.5, y + 0.5], axis=1) / 10 - [30, 25]
    assert len(x) > 300
    np.testing.assert_allclose(np.linalg.norm(away @ factor, axis=1), 1, atol=0.06)


def round_splats(means, sigma, size):
    factors = [[1 / sigma, 0, 1 / sigma]] * len(means)
    colors = np.ones((len(means), 3))
    return Gaussians.from_arrays(means, factors, colors, size=size)


def test_low_splats_have_another_colour():
    drawn = 1 - ellipses(round_splats([[10, 10], [30, 10]], 5.0, (40, 20)), low=1)
    left, right = drawn[:, :400].sum(axis=(0, 1)), drawn[:, 400:].sum(axis=(0, 1))
    assert left[2] > left[0]  # orange lacks blue
    assert right[0] > right[2]  # and blue lacks red


def test_a_thin_set_can_be_drawn():
    splat = Gaussians.from_arrays([[1, 9]], [[1, 0, 0.01]], [[1.0]], size=(1, 5000), space="data")
    assert ellipses(splat).shape == (800, 1, 3)


def test_an_overlay_is_the_picture_lightened_below_the_outlines():
    picture = np.random.default_rng(0).uniform(0, 1, (40, 60, 3))
    drawn = overlay(round_splats([[10, 10]], 2.0, (30, 20)), picture)  # scaled: 4 around (20, 20)
    assert drawn.shape == picture.shape
    y, x = np.mgrid[:40, :60] + 0.5
    away = np.abs(np.hypot(x - 20, y - 20) - 4)
    expected = WHITE_SHARE + (1 - WHITE_SHARE) * picture
    np.testing.assert_allclose(drawn[away > 2], expected[away > 2], atol=0.003)
    assert (drawn[away < 0.3][:, 0] < 0.6).all()


def test_single_outlines_can_be_told_apart():
    """Of many splats some are drawn, always the same, and neither the first nor every third."""
    means = [[4 + 8 * n, 4 + 8 * k] for k in range(30) for n in range(100)]
    splats = round_splats(means, 1.0, (800, 240))
    drawn, again = (overlay(splats, np.ones((240, 800, 1)))[..., 0] for _ in range(2))
    np.testing.assert_array_equal(drawn, again)
    shown = np.flatnonzero(drawn.reshape(30, 8, 100, 8).min(axis=(1, 3)) < 1)
    assert len(shown) == MAX_OUTLINES
    assert len(set(np.diff(shown))) > 2


@pytest.mark.parametrize(
    ("mean", "sigma"),
    [([-1e6, 5], 4.0), ([5, 1e6], 4.0), ([3e38, 3e38], 4.0), ([1e6, 5], 1e6), ([1e30, 5], 1e30)],
)
def test_what_is_outside_or_huge_is_not_drawn(mean, sigma):
    assert (overlay(round_splats([mean], sigma, (30, 20)), np.ones((20, 30, 1))) == 1).all()


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
