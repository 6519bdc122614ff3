"""Files of bases, also damaged ones."""

import numpy as np
import pytest

from _helpers.files import members_of
from _helpers.low_rank import HEIGHT, WIDTH, assert_same, basis_of
from eigengs_dr.eigenbasis.pca import basis_file as basisfile
from eigengs_dr.eigenbasis.pca.basis import Eigenbasis
from eigengs_dr.storage import npz as archive


def test_saved_and_loaded_is_the_same(tmp_path):
    for basis in (
        basis_of("ycbcr").truncated((4, 3, 0)),
        basis_of("rgb"),
        basis_of("rgb").truncated(0),
    ):
        basis.save(tmp_path / "a.npz")
        loaded = Eigenbasis.load(str(tmp_path / "a.npz"))
        assert_same(loaded, basis)
        assert type(loaded.count) is int and type(loaded.space) is str


def test_files_of_version_1_are_read(tmp_path):
    """They have training images too."""
    basis_of("rgb").save(tmp_path / "a.npz")
    arrays = members_of(tmp_path / "a.npz") | {"examples": np.zeros((16, HEIGHT, WIDTH, 3), "f4")}
    archive.write(tmp_path / "a.npz", basisfile.FORMAT, 1, arrays)
    assert_same(Eigenbasis.load(tmp_path / "a.npz"), basis_of("rgb"))


def change(key, value):
    return lambda arrays: arrays.__setitem__(key, value)


@pytest.mark.parametrize(
    ("edit", "complaint"),
    [
        (lambda a: a.pop("mean"), "key 'mean' is missing"),
        (change("mean", np.zeros((2, HEIGHT, WIDTH), "f4")), r"mean has shape \(2, 11, 14\)"),
        (change("mean", np.zeros((3, 4, 4), "f4")), "key 'components0' claims shape"),
        (change("mean", np.zeros((3, HEIGHT, WIDTH))), "key 'mean' is 3-dimensional float64"),
        (change("mean", np.full((3, HEIGHT, WIDTH), np.nan, "f4")), "mean holds values that are"),
        (change("variance", np.ones(2)), r"variance has shape \(2,\)"),
        (change("variance", np.zeros(3)), "eigenvalues0 add up to more than variance 0"),
        (change("eigenvalues2", np.arange(5.0)), "eigenvalues2 must descend"),
        (change("eigenvalues2", -np.arange(5.0)), "eigenvalues2 must descend and not be negative"),
        (
            change("eigenvalues2", np.zeros(1 << 20)),
            "eigenvalues2 has 1048576 values, more than pixels",
        ),
        (change("eigenvalues2", np.zeros(0)), "key 'components2' claims shape"),
        (change("components0", np.zeros((12, 14, 11), "f4")), "components0 has shape"),
        (
            change("components0", np.full((12, HEIGHT, WIDTH), np.inf, "f4")),
            "components0 holds values that are not finite",
        ),
        (change("count", np.array(0)), "count is 0, expected at least 1"),
        (change("space", np.array("linear")), "space is 'linear', expected one of ycbcr, rgb"),
    ],
)
def test_files_that_do_not_fit_together(tmp_path, edit, complaint):
    path = tmp_path / "a.npz"
    basis_of("rgb").save(path)
    arrays = members_of(path)
    edit(arrays)
    archive.write(path, basisfile.FORMAT, basisfile.VERSION, arrays)
    with pytest.raises(ValueError, match=complaint) as error:
        Eigenbasis.load(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_files_that_are_something_else(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"something")
    with pytest.raises(ValueError, match=r"not a readable .* file"):
        Eigenbasis.load(path)
    archive.write(path, "eigengs_dr.gaussians", 1, {})
    with pytest.raises(ValueError, match="format is"):
        Eigenbasis.load(path)
    with pytest.raises(FileNotFoundError):
        Eigenbasis.load(tmp_path / "nowhere.npz")
