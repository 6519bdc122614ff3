"""Files of bases and models: what is saved comes back, and whatever else is there is refused."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import said
from _helpers.errors import file_refused
from _helpers.families import family, fidelity, rendered, small_basis, small_model, splits
from _helpers.files import rewrite
from _helpers.low_rank import HEIGHT, WIDTH, assert_same, basis_of
from _helpers.sets import check_equal


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.npz"


# --- Bases ---


def test_bases_come_back(path):
    for basis in (
        basis_of("ycbcr").truncated((4, 3, 0)),
        basis_of("rgb"),
        basis_of("rgb").truncated(0),
    ):
        basis.save(path)
        loaded = eg.Eigenbasis.load(str(path))
        assert_same(loaded, basis)
        assert type(loaded.count) is int and type(loaded.space) is str


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"mean": None}, "key 'mean' is missing"),
        ({"mean": np.zeros((2, HEIGHT, WIDTH), "f4")}, "mean has shape (2, 11, 14)"),
        ({"mean": np.zeros((3, 4, 4), "f4")}, "key 'components0' claims shape"),
        ({"mean": np.zeros((3, HEIGHT, WIDTH))}, "key 'mean' is 3-dimensional float64"),
        ({"mean": np.full((3, HEIGHT, WIDTH), np.nan, "f4")}, "mean holds values that are"),
        ({"variance": np.ones(2)}, "variance has shape (2,)"),
        ({"variance": np.zeros(3)}, "eigenvalues0 add up to more than variance 0"),
        ({"eigenvalues2": np.arange(5.0)}, "eigenvalues2 must descend"),
        ({"eigenvalues2": -np.arange(5.0)}, "eigenvalues2 must descend and not be negative"),
        ({"eigenvalues2": np.zeros(1 << 20)}, "eigenvalues2 has 1048576 values, more than pixels"),
        ({"eigenvalues2": np.zeros(0)}, "key 'components2' claims shape"),
        ({"components0": np.zeros((12, 14, 11), "f4")}, "components0 has shape"),
        (
            {"components0": np.full((12, HEIGHT, WIDTH), np.inf, "f4")},
            "components0 holds values that are not finite",
        ),
        ({"count": np.array(0)}, "count is 0, expected at least 1"),
        ({"space": np.array("linear")}, "space is 'linear', expected one of ycbcr, rgb"),
        ({"format": np.array("eigengs_dr.gaussians")}, "format is"),
    ],
)
def test_bases_that_do_not_fit_together(path, changed, complaint):
    basis_of("rgb").save(path)
    rewrite(path, **changed)
    with file_refused(path, complaint):
        eg.Eigenbasis.load(path)


# --- Models ---


@splits
def test_models_come_back(backend, split, path):
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


def test_models_keep_how_the_error_falls(path):
    model, basis = small_model("llvm"), small_basis()
    model.save(path)
    loaded = eg.EigenGS.load(path)
    np.testing.assert_array_equal(loaded.truncation_curve().psnr, basis.truncation_curve().psnr)
    rewrite(path, variance=np.zeros(0), held_out=np.zeros(0))
    loaded = eg.EigenGS.load(path)
    assert loaded.truncation_curve() is None
    assert "held out" not in said("info", path)  # the head of its table
    loaded.save(path)
    assert eg.EigenGS.load(path).truncation_curve() is None


def check_refused(path, words=""):
    with file_refused(path, words):
        eg.EigenGS.load(path)


def members(path):
    """The arrays of a model that knows how the error falls."""
    small_model("llvm").save(path)
    rewrite(path, held_out=np.linspace(9, 30, 25))
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite(path, value):
    arrays = members(path)
    floats = [key for key, array in arrays.items() if array.dtype.kind == "f"]
    assert len(floats) > 12
    for key in floats:
        bad = arrays[key].copy()
        bad.flat[-1] = value
        rewrite(path, **{**arrays, key: bad})
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
        ("split", lambda a: np.array([101, 3]), "split is 101, 3"),
        ("split", lambda a: np.array([6, -1]), "split is 6, -1"),
        ("space", lambda a: np.array("data"), "space is 'data'"),
        ("variance", lambda a: a[:2], "variance has shape"),
        ("variance", lambda a: -a, "more than variance 0"),
        ("held_out", lambda a: a[:-1], "held_out has shape"),
        ("held_out", lambda a: a[::-1], "held_out must ascend"),
        ("held_out", lambda a: a - 1e6, "held_out must ascend"),
        ("scale0", lambda a: a * 0 + 3e38, "exceeds"),
        ("version", lambda a: a + 1, "upgrade"),
        ("version", lambda a: a - 1, "make the file again"),
        ("format", lambda a: np.array("eigengs_dr.gaussians"), "format is 'eigengs_dr.gaussians'"),
    ],
)
def test_models_that_do_not_fit_together(path, key, change, words):
    rewrite(path, **{key: change(members(path)[key])})
    check_refused(path, words)


def test_models_cut_off_and_other_archives(path):
    members(path)
    content = path.read_bytes()
    for share in (0, 1e-3, 0.3, 0.7, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        check_refused(path)
    np.savez(path, a=np.zeros(3))
    check_refused(path, "key 'format' is missing")
