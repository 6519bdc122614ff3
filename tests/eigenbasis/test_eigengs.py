"""EigenGS: shared Gaussians of a family, images encoded at once."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import (
    SIDE,
    SPLATS,
    family,
    fidelity,
    rendered,
    small_basis,
    small_model,
    splits,
)
from eigengs_dr.fitting.objective import Pixels
from eigengs_dr.fitting.solve import solve
from eigengs_dr.image.io import ImageError
from eigengs_dr.image.resize import resample
from eigengs_dr.image.space import to_planes


def test_one_seed_one_model(backend):
    again = eg.EigenGS.fit(small_basis(), SPLATS, frequency_aware=False, backend=backend)
    for one, two in zip(again.weights, small_model(backend).weights, strict=True):
        np.testing.assert_array_equal(one, two)


def test_paper_preset(backend):
    """Joint training fits the components better with every round; the mean comes solved."""
    few, more = (
        eg.EigenGS.fit(small_basis(), SPLATS, preset="eigengs", iterations=steps, backend=backend)
        for steps in (20, 300)
    )
    assert more.figures["psnr_components"] > few.figures["psnr_components"] + 1
    mean = eg.render(more.gaussians).numpy()
    nothing = small_basis().reconstruct([np.zeros(k) for k in more.components])
    assert eg.psnr(mean, nothing, "ycbcr") > 35
    split = eg.EigenGS.fit(
        small_basis(), SPLATS, True, preset="eigengs", iterations=20, backend=backend
    )
    assert split.low == 10
    assert not split.weights[0][6:, :10].any()


def test_oblong_family(backend):
    """Width and height are not exchanged anywhere."""
    images = family(20, 48)[:, 10:30]
    basis = eg.Eigenbasis.from_images(images, (48, 20), 8)
    for split in (False, True):
        model = eg.EigenGS.fit(basis, SPLATS, split, backend=backend)
        pca = fidelity([basis.reconstruct(basis.project(image)) for image in images], images)
        allowed = 3 if split else 0.5  # 10 splats for 4 components a channel
        assert fidelity(rendered(model, images, "projected"), images) > pca - allowed
        assert fidelity(rendered(model, images), images) > 32
        assert model.dense_mean(7, 9).shape == (9, 7, 3)


@pytest.mark.parametrize("empty", [(0,), (1, 2), (0, 1, 2)])
def test_channels_without_coefficients_are_those_of_the_mean(backend, empty):
    """And change no other channel."""
    model = small_model(backend)
    some = [np.ones(min(2, k), np.float32) for k in model.components]
    mean, full = (model.reconstruct(c).to_arrays() for c in ([[]] * 3, some))
    found = model.reconstruct([[] if c in empty else a for c, a in enumerate(some)]).to_arrays()
    for name in ("color", "background"):
        wanted = np.where(np.isin(np.arange(3), empty), mean[name], full[name])
        np.testing.assert_array_equal(found[name], wanted)
    np.testing.assert_array_equal(mean["color"], model.gaussians.to_arrays()["color"])


# --- Encode ------------------------------------------------------------------------------------


@splits
def test_projection_is_that_of_pca(backend, split, others):
    model, basis = small_model(backend, split), small_basis()
    pca = fidelity([basis.reconstruct(basis.project(image)) for image in others], others)
    assert fidelity(rendered(model, others, "projected"), others) > pca - 0.1
    if split:  # few large splats render the first components with an error that others see
        return
    for found, expected in zip(model.project(others[0]), basis.project(others[0]), strict=True):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found[:3], expected[:3], atol=0.1 * scale)


def test_projection_is_the_closest_point(backend, others):
    model = small_model(backend)
    best = model.project(others[0])

    def distance(coefficients):
        shown = to_planes(eg.render(model.reconstruct(coefficients)).numpy(), "ycbcr")
        return np.square(shown - to_planes(others[0], "ycbcr")).sum()

    least = distance(best)
    for channel, j in ((0, 0), (0, 7), (1, 2), (2, 5)):
        for step in (-0.05, 0.05):
            moved = [w.copy() for w in best]
            moved[channel][j] += step
            assert distance(moved) > least


@splits
def test_exact_colours_are_those_of_conjugate_gradients(backend, split, others):
    model = small_model(backend, split)
    encoded = model.encode(others[0])
    target = np.moveaxis(to_planes(others[0], "ycbcr").reshape(3, SIDE, SIDE), 0, 2)
    iterated = solve(encoded, Pixels.plain(target, encoded), 100)
    exact, slow = (eg.psnr(eg.render(g), others[0], "ycbcr") for g in (encoded, iterated))
    # With the split, small splats fit what large ones leave: on so smooth an image, that costs.
    assert slow - (3 if split else 0.02) < exact < slow + 0.1
    assert fidelity(rendered(model, others), others) > fidelity(
        rendered(model, others, "projected"), others
    )


@pytest.mark.parametrize("colors", ["exact", "projected"])
def test_dense_mean(backend, colors, others):
    """The paper's form: Gaussians plus the mean image as pixels."""
    model = small_model(backend)
    planes = [
        to_planes(eg.render(model.encode(others[0], colors, mean)).numpy(), "ycbcr")
        for mean in ("gaussians", "dense")
    ]
    dense = model.dense_mean(SIDE, SIDE).reshape(-1, 3).T
    np.testing.assert_allclose(planes[0], planes[1] + dense, atol=0.02)


@pytest.mark.parametrize("size", [(32, 32), (64, 64), (48, 20), (17, 90)])
def test_any_size_and_aspect(backend, size, others):
    """The splats are those of the image at the model's own size, scaled."""
    model = small_model(backend)
    image = resample(others[0], *size).clip(0, 1)
    encoded = model.encode(image)
    assert (encoded.width, encoded.height) == size
    assert eg.render(encoded).shape == (size[1], size[0], 3)
    small = model.encode(resample(image, SIDE, SIDE))
    np.testing.assert_allclose(encoded.to_arrays()["color"], small.to_arrays()["color"], atol=1e-3)
    assert eg.psnr(eg.render(encoded), image, "ycbcr") > 25


def test_wrong_arguments(backend):
    model = small_model(backend)
    with pytest.raises(ValueError, match="coefficients have shapes"):
        model.reconstruct(model.project(family(1)[0])[:2])
    with pytest.raises(ValueError, match="coefficients have shapes"):
        model.reconstruct([np.zeros(13)] * 3)
    with pytest.raises(ValueError, match="colors 'best' is unknown; use one of exact, projected"):
        model.encode(family(1)[0], "best")
    with pytest.raises(ValueError, match="mean 'none' is unknown"):
        model.encode(family(1)[0], mean="none")
    with pytest.raises(ImageError):
        model.encode(np.zeros((4, 4, 5)))


# --- Odd families ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["one", "identical", "grey", "two"])
@pytest.mark.filterwarnings("ignore:.* at most .* components per channel:UserWarning")
@splits
def test_few_or_equal_images(backend, kind, split):
    images = {
        "one": family(1),
        "identical": np.repeat(family(1), 5, axis=0),
        "grey": np.repeat(family(10)[..., :1], 3, axis=3),
        "two": family(2),
    }[kind]
    basis = eg.Eigenbasis.from_images(images, (SIDE, SIDE), 5)
    model = eg.EigenGS.fit(basis, SPLATS, split, backend=backend)
    for options in (("projected",), ("exact",), ("projected", "dense")):
        picture = eg.render(model.encode(images[0], *options)).numpy()
        assert np.isfinite(picture).all()
    assert fidelity(rendered(model, images[:1], "projected"), images[:1]) > 28


def test_coefficients_are_finite():
    model = small_model("llvm")
    with pytest.raises(ValueError, match="coefficients are not all finite"):
        model.reconstruct([[np.nan]] * 3)


def test_fit_refuses():
    with pytest.raises(ValueError, match="gaussians is 1025; a basis of 32x32 takes 1 to 1024"):
        eg.EigenGS.fit(small_basis(), 1025)
