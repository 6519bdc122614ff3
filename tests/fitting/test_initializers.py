"""Where a fit starts: from a basis, or from a placement."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import SIDE, SPLATS, family, small_model
from _helpers.halves import picture
from eigengs_dr.fitting.options import FitOptions
from eigengs_dr.fitting.refine import refine
from eigengs_dr.fitting.start import initialize
from eigengs_dr.image.planes import to_planes
from eigengs_dr.image.resize import resample


@pytest.mark.parametrize("init", ["grid", "random", "eigen"])
def test_other_starts_stay_where_they_were_put(init):
    """They are not placed anew, but they relocate in a long descent."""
    image = np.tile(picture(), (3, 3, 1)) if init == "eigen" else picture()
    count = None if init == "eigen" else 60
    control = initialize(image, FitOptions(gaussians=count, init=init)).control
    assert control is not None and not control.redistributes


def test_relocation_gains_from_any_start():
    image = eg.sample("coffee")[100:164, 200:264]
    options = FitOptions(gaussians=200, init="grid", iterations=300)
    start = initialize(image, options)
    moved, left = (
        refine(problem, image, options.method.schedule, 300).row["psnr_rgb"]
        for problem in (start, start._replace(control=None))
    )
    assert moved > left + 0.5


@pytest.fixture(scope="module")
def others():
    """Images of the family that were not trained on."""
    return family(8, seed=1)


def test_fit_starts_from_the_exact_colours(backend, others):
    model = small_model(backend)
    result = eg.fit(others[0], iterations=0, init="eigen", basis=model, backend=backend)
    expected = eg.render(model.encode(others[0])).numpy()
    assert eg.psnr(result.image, others[0]) == pytest.approx(eg.psnr(expected, others[0]), abs=0.02)
    assert len(result.gaussians) == SPLATS
    assert result.mean_image is None


def test_fit_at_another_size_solves_again(backend, others):
    model, image = small_model(backend), resample(others[0], 60, 44).clip(0, 1)
    result = eg.fit(image, iterations=0, init="eigen", basis=model, backend=backend)
    encoded = eg.psnr(eg.render(model.encode(image)), image, "ycbcr")
    assert result.trace[0]["psnr_ycbcr"] >= encoded - 1e-3


def test_fit_by_the_paper(backend, others):
    """Projected colours beside the dense mean image, refined from there."""
    model = small_model(backend)
    result = eg.fit(others[0], iterations=100, preset="eigengs", basis=model, backend=backend)
    shown = model.encode(others[0], "projected", "dense")
    start = (
        to_planes(eg.render(shown).numpy(), "ycbcr") + model.dense_mean(SIDE, SIDE).reshape(-1, 3).T
    )
    error = np.square(start - to_planes(others[0], "ycbcr")).mean()
    assert result.trace[0]["psnr_ycbcr"] == pytest.approx(-10 * np.log10(error), abs=0.01)
    assert result.trace[-1]["psnr_ycbcr"] > result.trace[0]["psnr_ycbcr"] + 1
    whole = eg.render(result.gaussians).numpy() + result.mean_image
    np.testing.assert_array_equal(whole, result.image)
    assert eg.psnr(result.image, others[0], "ycbcr") == max(r["psnr_ycbcr"] for r in result.trace)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gaussians": 50}, "gaussians is 50, but the basis has 100"),
        ({"space": "rgb"}, "space is 'rgb', but the basis is in 'ycbcr'"),
        ({"basis": "nothing"}, "basis 'nothing' is neither a file nor one of: natural"),
        ({"basis": "natural"}, "more than an image of 32x32 has pixels"),
        ({"preset": "eigengs", "init": "grid"}, "preset 'eigengs' starts from a basis"),
    ],
)
def test_fit_refuses_another_basis(backend, options, words, others):
    options = {"basis": small_model(backend), "init": "eigen", **options}
    with pytest.raises(ValueError, match=words):
        eg.fit(others[0], backend=backend, **options)
