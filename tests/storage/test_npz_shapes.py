"""Shapes of arrays, read from headers alone."""

import numpy as np
import pytest

from eigengs_dr.storage import npz


def test_shapes(tmp_path):
    arrays = {"a": np.zeros((3, 5), np.float32), "b": np.zeros(7, np.int64)}
    npz.write(tmp_path / "x.npz", "test", 1, arrays)
    layout = {"a": npz.Field("f4", 2), "b": npz.Field("i8", 1)}
    assert npz.read_shapes(tmp_path / "x.npz", "test", 1, layout) == {"a": (3, 5), "b": (7,)}
    with pytest.raises(ValueError, match="key 'a' is 2-dimensional float32"):
        npz.read_shapes(tmp_path / "x.npz", "test", 1, {"a": npz.Field("f8", 1)})
    with pytest.raises(ValueError, match="key 'c' is missing"):
        npz.read_shapes(tmp_path / "x.npz", "test", 1, {"c": npz.Field("f8", 1)})
