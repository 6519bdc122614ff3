"""Files of bases, also damaged ones."""

import numpy as np
import pytest

from _helpers.errors import file_refused
from _helpers.files import members_of
from _helpers.low_rank import HEIGHT, WIDTH, assert_same, basis_of
from eigengs_dr.eigenbasis.basis import Eigenbasis
from eigengs_dr.eigenbasis.files import BASIS_FORMAT, BASIS_VERSION
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
        (
            {"eigenvalues2": np.zeros(1 << 20)},
            "eigenvalues2 has 1048576 values, more than pixels",
        ),
        ({"eigenvalues2": np.zeros(0)}, "key 'components2' claims shape"),
        ({"components0": np.zeros((12, 14, 11), "f4")}, "components0 has shape"),
        (
            {"components0": np.full((12, HEIGHT, WIDTH), np.inf, "f4")},
            "components0 holds values that are not finite",
        ),
        ({"count": np.array(0)}, "count is 0, expected at least 1"),
        ({"space": np.array("linear")}, "space is 'linear', expected one of ycbcr, rgb"),
    ],
)
def test_files_that_do_not_fit_together(tmp_path, changed, complaint):
    path = tmp_path / "a.npz"
    basis_of("rgb").save(path)
    arrays = {k: v for k, v in (members_of(path) | changed).items() if v is not None}
    archive.write(path, BASIS_FORMAT, BASIS_VERSION, arrays)
    with file_refused(path, complaint):
        Eigenbasis.load(path)


def test_files_of_another_format(tmp_path):
    archive.write(tmp_path / "a.npz", "eigengs_dr.gaussians", 1, {})
    with file_refused(tmp_path / "a.npz", "format is"):
        Eigenbasis.load(tmp_path / "a.npz")
