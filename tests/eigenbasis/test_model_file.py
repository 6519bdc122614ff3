"""Files of models: what is saved comes back, and whatever else is there is refused in one line."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import said
from _helpers.errors import file_refused
from _helpers.families import family, fidelity, rendered, small_basis, small_model, splits
from _helpers.sets import check_equal
from eigengs_dr.eigenbasis.files import (
    MODEL_FORMAT,
    MODEL_LAYOUT,
    MODEL_VERSION,
    model_arrays,
)
from eigengs_dr.storage import npz as archive

FLOATS = [key for key, field in MODEL_LAYOUT.items() if field.kind[0] == "f"]


@pytest.fixture(scope="module")
def model(trained):
    return trained[1].model


@pytest.fixture(scope="module")
def members(model):
    return model_arrays(vars(model))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.npz"


def check_refused(path, words=""):
    with file_refused(path, words):
        eg.EigenGS.load(path)


def write(path, members, version=MODEL_VERSION, name=MODEL_FORMAT):
    archive.write(path, name, version, members)


# --- What is saved ------------------------------------------------------------------------------


@splits
def test_save_and_load(backend, split, path):
    """Half precision of the weights and the mean image costs nothing that can be seen."""
    model = small_model(backend, split)
    model.save(path)
    again = eg.EigenGS.load(path, backend=backend)
    for name in ("low", "low_components", "components"):
        assert getattr(again, name) == getattr(model, name)
    assert again.gaussians.space == model.gaussians.space
    check_equal(again.gaussians, model.gaussians.to_arrays())
    for one, two in zip(again.weights, model.weights, strict=True):
        largest = np.abs(two).max(axis=1, keepdims=True)
        assert (np.abs(one - two) <= largest * 2**-11).all()
    for one, two in zip(again.eigenvalues, model.eigenvalues, strict=True):
        np.testing.assert_array_equal(one, two)
    np.testing.assert_allclose(again.mean_image, model.mean_image, rtol=2**-11)
    others = family(8, seed=1)
    for colors in ("exact", "projected"):
        first, second = (fidelity(rendered(m, others, colors), others) for m in (model, again))
        assert second == pytest.approx(first, abs=0.01)


def test_half_precision_of_extreme_weights(backend, path):
    """Scaled by component: neither tiny nor huge ones are lost."""
    basis, model = small_basis(), small_model(backend)
    weights = tuple(w * s for w, s in zip(model.weights, (1e-9, 1e3, 0), strict=True))
    eg.EigenGS(model.gaussians, weights, basis.eigenvalues, basis.mean).save(path)
    for one, two in zip(eg.EigenGS.load(path).weights, weights, strict=True):
        np.testing.assert_allclose(one, two, atol=6e-4 * np.abs(two).max())


def test_models_keep_how_the_error_falls(trained):
    folder, result = trained
    loaded = eg.EigenGS.load(folder / "model.npz")
    np.testing.assert_array_equal(
        loaded.truncation_curve().psnr, result.basis.truncation_curve().psnr
    )
    np.testing.assert_array_equal(loaded.held_out, result.model.held_out)
    assert len(loaded.held_out) == 19
    assert loaded.held_out[-1] == pytest.approx(result.figures["psnr_pca"], abs=1e-3)


def test_a_model_without_a_variance(members, path):
    write(path, members | {"variance": np.zeros(0), "held_out": np.zeros(0)})
    loaded = eg.EigenGS.load(path)
    assert loaded.truncation_curve() is None
    assert len(loaded.held_out) == 0
    assert "held out" not in said("info", path)  # the head of its table
    loaded.save(path)
    assert eg.EigenGS.load(path).truncation_curve() is None


# --- What is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize("key", FLOATS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(members, path, key, value):
    array = members[key].copy()
    array.flat[-1] = value
    write(path, {**members, key: array})
    check_refused(path, f"{key} holds values that are not finite")


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("weights1", lambda a: a[None], "key 'weights1' is "),
        ("weights1", lambda a: a.astype(int), "key 'weights1' is "),
        ("weights1", lambda a: a[:, :-1], "weights1 has shape"),
        ("weights1", lambda a: a[:, :0], "weights1 has shape"),
        ("scale2", lambda a: a[:-1], "scale2 has shape"),
        ("eigenvalues0", lambda a: a[:-1], "eigenvalues0 has shape"),
        ("mean_image", lambda a: a[:, :-1], "mean_image has shape"),
        ("mean", lambda a: a[:-1], "has shape"),
        ("factor", lambda a: -a, "factor"),
        ("color", lambda a: a[:, :1], "color has shape"),
        ("background", lambda a: a[:2], "background"),
        ("size", lambda a: -a, "has shape"),
        ("size", lambda a: a + (1 << 40), "has shape"),
        ("size", lambda a: np.append(a, 1), "size has shape"),
        ("split", lambda a: np.append(a, 1), "split has shape"),
        ("split", lambda a: np.array([60, 3]), "split is 60, 3"),
        ("split", lambda a: np.array([6, -1]), "split is 6, -1"),
        ("space", lambda a: np.array("data"), "space is 'data'"),
        ("variance", lambda a: a[:2], "variance has shape"),
        ("variance", lambda a: -a, "more than variance 0"),
        ("held_out", lambda a: a[:-1], "held_out has shape"),
        ("held_out", lambda a: a[::-1], "held_out must ascend"),
        ("held_out", lambda a: a - 1e6, "held_out must ascend"),
        ("scale0", lambda a: a * 0 + 3e38, "exceeds"),
    ],
)
def test_arrays_that_do_not_fit(members, path, key, change, words):
    write(path, {**members, key: change(members[key])})
    check_refused(path, words)


def test_truncated_and_other_files(model, members, path):
    model.save(path)
    content = path.read_bytes()
    for share in (0, 1e-3, 0.3, 0.7, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        check_refused(path)
    write(path, members, version=MODEL_VERSION + 1)
    check_refused(path, "upgrade")
    write(path, members, version=MODEL_VERSION - 1)
    check_refused(path, "make the file again")
    model.gaussians.save(path)
    check_refused(path, "format is 'eigengs_dr.gaussians'")
    np.savez(path, a=np.zeros(3))
    check_refused(path, "key 'format' is missing")
