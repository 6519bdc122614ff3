"""Files of arrays, with a format and a version."""

import numpy as np
import pytest

from eigengs_dr.storage import npz
from eigengs_dr.storage.npz import Field

ARRAYS = {
    "a": np.arange(24, dtype="f4").reshape(2, 3, 4),
    "b": np.array(-5),
    "c": np.array("été"),
    "d": np.asfortranarray(np.arange(6).reshape(2, 3)),
}
LAYOUT = {"a": Field("f4", 3), "b": Field("i8", 0), "c": Field("U", 0), "d": Field("i8", 2)}


@pytest.fixture
def path(tmp_path):
    npz.write(tmp_path / "x", "some.format", 3, ARRAYS)
    return tmp_path / "x"


@pytest.mark.parametrize("compressed", [True, False])
def test_arrays_come_back(path, compressed):
    npz.write(path, "some.format", 3, ARRAYS, compressed)
    found = npz.read(path, "some.format", 3, LAYOUT)
    for key, value in ARRAYS.items():
        np.testing.assert_array_equal(found[key], value)
    assert npz.format_of(path) == "some.format"
    assert npz.sizes_of(path).keys() == {"format", "version", *ARRAYS}


def test_a_write_that_fails_leaves_the_old_file(path):
    before = path.read_bytes()
    with pytest.raises(TypeError, match="cannot pickle"):
        npz.write(path, "some.format", 4, {**ARRAYS, "e": np.array([iter, (_ for _ in ())])})
    assert path.read_bytes() == before and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "version", "layout", "message"),
    [
        ("other", 3, {}, "format is 'some.format', expected 'other'"),
        ("some.format", 2, {}, "version is 3, but this package reads 2; upgrade"),
        ("some.format", 4, {}, "version is 3, but this package reads 4; make the file again"),
        ("some.format", 3, {"z": Field("f4", 1)}, "key 'z' is missing"),
        ("some.format", 3, {"a": Field("f8", 3)}, "key 'a' is 3-dimensional float32, expected 3-d"),
        ("some.format", 3, {"b": Field("U", 0)}, "expected 0-dimensional text"),
        ("some.format", 3, {"a": Field("f4", 3, 23)}, r"key 'a' claims shape \(2, 3, 4\), more"),
    ],
)
def test_what_does_not_fit_is_refused(path, name, version, layout, message):
    for read in (npz.read, npz.read_shapes):
        with pytest.raises(ValueError, match=f"x: .*{message}"):
            read(path, name, version, layout)


def test_shapes_need_no_arrays(path):
    assert npz.read_shapes(path, "some.format", 3, LAYOUT) == {
        key: array.shape for key, array in ARRAYS.items()
    }
    content = bytearray(path.read_bytes())
    place = content.find(b"a.npy") + 100  # behind the header of the first array
    content[place : place + 8] = bytes(8)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"x: .*(not a readable|truncated)"):
        npz.read(path, "some.format", 3, LAYOUT)
