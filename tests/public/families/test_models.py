"""EigenGS: Gaussians that a family shares, and images encoded at once or in series."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from skimage.color import rgb2ycbcr

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
from _helpers.sets import check_equal

OTHERS = family(8, seed=1)
"""Images of the family of `small_basis` that it was not made of."""


def ycbcr(image):
    return rgb2ycbcr(np.asarray(image, np.float64)) / 255


# --- Components ---


@splits
def test_components_are_rendered(backend, split):
    """Every component is what its weights make of the splats, the mean image too."""
    model, basis = small_model(backend, split), small_basis()
    assert model.components == (12, 6, 6)
    assert len(model.gaussians) == SPLATS
    mean = eg.render(model.gaussians).numpy()
    none = [np.zeros(k, np.float32) for k in model.components]
    assert eg.psnr(mean, basis.reconstruct(none), "ycbcr") > 50
    # A tenth of 100 splats is few for the first components.
    assert model.figures["psnr_components"] > (30 if split else 40)
    for channel, j in ((0, 0), (0, 11), (2, 3)):
        only = [w.copy() for w in none]
        only[channel][j] = 1
        shown = eg.render(model.reconstruct(tuple(only))).numpy() - mean
        wanted = basis.reconstruct(only) - basis.reconstruct(none)
        share = 0.2 if split and j < model.low_components else 0.03
        assert np.square(shown - wanted).sum() < share * np.square(wanted).sum()


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
    assert eg.EigenGS.fit(small_basis(), 17, True, backend=backend).low == 2
    assert eg.EigenGS.fit(small_basis(), 1, True, backend=backend).low == 0


@pytest.mark.parametrize(("width", "low"), [(511, 0), (512, 3)])
def test_auto_splits_large_images_alone(backend, width, low):
    images = np.random.default_rng(0).random((4, 8, width, 3))
    basis = eg.Eigenbasis.from_images(images, (width, 8), 3)
    assert eg.EigenGS.fit(basis, 30, backend=backend).low == low


def test_the_training_of_the_paper(backend):
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
        small_basis(), SPLATS, True, preset="eigengs", iterations=1, backend=backend
    )
    assert split.low == 10
    assert not split.weights[0][6:, :10].any()
    mean = split.gaussians.to_arrays()["mean"]
    assert np.abs(mean[:10] - mean[10:20]).max() > 1  # each side draws a start of its own


def test_one_seed_one_model_which_travels_as_arrays(backend):
    """A worker of a cluster gets the same bits."""
    model = small_model(backend)
    again = eg.EigenGS.fit(small_basis(), SPLATS, frequency_aware=False, backend=backend)
    model.encode(OTHERS[0])
    for other in (again, pickle.loads(pickle.dumps(model))):
        check_equal(other.gaussians, model.gaussians.to_arrays())
        for one, two in zip(other.weights, model.weights, strict=True):
            np.testing.assert_array_equal(one, two)


def test_oblong_family(backend):
    """Width and height are not exchanged anywhere."""
    images = family(20, 48)[:, 10:30]
    basis = eg.Eigenbasis.from_images(images, (48, 20), 8)
    model = eg.EigenGS.fit(basis, SPLATS, False, backend=backend)
    pca = fidelity([basis.reconstruct(basis.project(image)) for image in images], images)
    assert fidelity(rendered(model, images, "projected"), images) > pca - 0.5
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
        assert np.isfinite(eg.render(model.encode(images[0], *options)).numpy()).all()
    assert fidelity(rendered(model, images[:1], "projected"), images[:1]) > 28


# --- Encode ---


@splits
def test_projection_is_that_of_pca(backend, split):
    model, basis = small_model(backend, split), small_basis()
    pca = fidelity([basis.reconstruct(basis.project(image)) for image in OTHERS], OTHERS)
    assert fidelity(rendered(model, OTHERS, "projected"), OTHERS) > pca - 0.1
    if split:  # few large splats render the first components with an error that others see
        return
    for found, expected in zip(model.project(OTHERS[0]), basis.project(OTHERS[0]), strict=True):
        np.testing.assert_allclose(found[:3], expected[:3], atol=0.1 * np.abs(expected).max())


def test_projection_is_the_closest_point(backend):
    model = small_model(backend)
    best = model.project(OTHERS[0])

    def distance(coefficients):
        shown = eg.render(model.reconstruct(coefficients)).numpy()
        return np.square(ycbcr(shown) - ycbcr(OTHERS[0])).sum()

    least = distance(best)
    for channel, j in ((0, 0), (0, 7), (1, 2), (2, 5)):
        for step in (-0.05, 0.05):
            moved = [w.copy() for w in best]
            moved[channel][j] += step
            assert distance(moved) > least


@splits
def test_exact_colours_are_those_of_a_fit_of_colours(backend, split):
    model, image = small_model(backend, split), OTHERS[0]
    encoded = model.encode(image)
    fitted = eg.fit(image, start=encoded, iterations=0, backend=backend)
    exact, slow = (eg.psnr(eg.render(g), image, "ycbcr") for g in (encoded, fitted))
    # With the split, small splats fit what large ones leave: on so smooth an image, that costs.
    assert slow - (3 if split else 0.02) < exact < slow + 0.1
    projected = fidelity(rendered(model, OTHERS, "projected"), OTHERS)
    assert fidelity(rendered(model, OTHERS), OTHERS) > projected


@pytest.mark.parametrize("colors", ["exact", "projected"])
def test_dense_mean(backend, colors):
    """The paper's form: Gaussians plus the mean image as pixels."""
    model = small_model(backend)
    whole, left = (
        ycbcr(eg.render(model.encode(OTHERS[0], colors, mean)).numpy())
        for mean in ("gaussians", "dense")
    )
    np.testing.assert_allclose(whole, left + model.dense_mean(SIDE, SIDE), atol=0.02)


def waves(width, height):
    """One smooth picture at any size."""
    x, y = (np.arange(width) + 0.5) / width, (np.arange(height)[:, None, None] + 0.5) / height
    return (0.5 + 0.2 * np.sin(3 * x[:, None] + [0, 1, 2]) * np.cos(2 * y)).astype(np.float32)


@pytest.mark.parametrize(
    "size", [(32, 32), (64, 64), pytest.param((48, 20), marks=pytest.mark.slow), (28, 90)]
)
def test_any_size_and_aspect(backend, size):
    """The splats are those of the image at the model's own size, scaled."""
    model, image = small_model(backend), waves(*size)
    encoded = model.encode(image)
    assert (encoded.width, encoded.height) == size
    assert eg.render(encoded).shape == image.shape
    color = model.encode(waves(SIDE, SIDE)).to_arrays()["color"]
    np.testing.assert_allclose(encoded.to_arrays()["color"], color, atol=1e-3)
    assert eg.psnr(eg.render(encoded), image, "ycbcr") > 25


def test_wrong_arguments(backend):
    model, image = small_model(backend), OTHERS[0]
    for coefficients in (model.project(image)[:2], [np.zeros(13)] * 3):
        with pytest.raises(ValueError, match="coefficients have shapes"):
            model.reconstruct(coefficients)
    with pytest.raises(ValueError, match="coefficients are not all finite"):
        model.reconstruct([[np.nan]] * 3)
    for call in (model.encode, model.encode_many):
        images = image if call == model.encode else [image]
        with pytest.raises(ValueError, match="colors 'best' is unknown; use one of exact"):
            call(images, colors="best")
    with pytest.raises(ValueError, match="target_psnr chooses components"):
        model.encode_many([image], target_psnr=30)
    with pytest.raises(ValueError, match="mean 'none' is unknown"):
        model.encode(image, mean="none")
    with pytest.raises(eg.ImageError):
        model.encode(np.zeros((4, 4, 5)))
    with pytest.raises(ValueError, match="gaussians is 1025; a basis of 32x32 takes 1 to 1024"):
        eg.EigenGS.fit(small_basis(), 1025)


# --- Encode many ---


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"colors": "projected", "mean": "dense"},
        {"colors": "projected", "target_psnr": 20},
    ],
)
def test_series_are_encoded_as_images_alone(backend, tmp_path, options):
    """Rows have the PSNRs of the pictures, also those of files; a set without the mean is none."""
    model = small_model(backend)
    images = [*OTHERS[:3], family(1, 40, seed=4)[0][:30]]
    rows = model.encode_many(images, **options)
    kept, again = (model.encode_many(images, tmp_path, **options) for _ in range(2))
    assert [row.status for row in rows] == ["done"] * 4
    for place, (row, image) in enumerate(zip(rows, images, strict=True)):
        alone, found = model.encode(image, **options), row.result
        assert (found.width, found.height) == (alone.width, alone.height)
        check_equal(found, alone.to_arrays())
        assert row.gaussians == len(alone) and row.seconds > 0
        for space in ("rgb", "ycbcr"):
            psnr = None if "mean" in options else eg.psnr(eg.render(found).numpy(), image, space)
            found_psnrs = [vars(some[place])[f"psnr_{space}"] for some in (rows, kept, again)]
            assert found_psnrs == [psnr] * 3


def test_files_a_bad_one_and_resuming(backend, tmp_path):
    model = small_model(backend)
    for number, image in enumerate(OTHERS[:3]):
        eg.save_image(tmp_path / f"{number}.pfm", image, encoding="srgb")
    (tmp_path / "1.pfm").write_text("no image")
    seen = []
    rows = model.encode_many(tmp_path, tmp_path / "sets", progress=lambda *row: seen.append(row))
    assert [row.status for row in rows] == ["done", "failed", "done"]
    assert [(done, total, row.name) for done, total, row in seen] == [
        (number + 1, 3, row.name) for number, row in enumerate(rows)
    ]
    assert len(seen[2][2].result) == rows[2].gaussians and rows[2].result is None
    loaded = eg.Gaussians.load(tmp_path / "sets" / "2.npz")
    color = model.encode(OTHERS[2]).to_arrays()["color"]
    np.testing.assert_allclose(loaded.to_arrays()["color"], color, atol=1e-4)
    again = model.encode_many(tmp_path, tmp_path / "sets")
    assert [row.status for row in again] == ["skipped", "failed", "skipped"]
    other = replace(model, weights=tuple(w * 2 for w in model.weights))
    with pytest.raises(ValueError, match="is a result of other options"):
        other.encode_many(tmp_path, tmp_path / "sets")


def test_the_model_that_is_shipped(backend):
    """It is small, and encodes a photo that it was not trained on."""
    model = eg.EigenGS.load("natural", backend)
    assert model is not eg.EigenGS.load("natural", backend)
    assert len(model.gaussians) == 5000
    image = eg.sample("coffee")
    projected, exact = (eg.render(model.encode(image, c)).numpy() for c in ("projected", "exact"))
    assert eg.psnr(projected, image, "ycbcr") > 22
    assert eg.psnr(exact, image, "ycbcr") > 27
