"""Files of arrays, with a format and a version."""

import numpy as np
import pytest

from eigengs_dr.storage import npz as archive


def test_archive_reads_what_it_wrote(tmp_path):
    layout = {"a": archive.Field("f4", 3), "b": archive.Field("i8", 0), "c": archive.Field("U", 0)}
    arrays = {
        "a": np.arange(24, dtype="f4").reshape(2, 3, 4),
        "b": np.array(-5),
        "c": np.array("été"),
    }
    archive.write(tmp_path / "x", "some.format", 3, arrays)
    for version in (3, 4):
        found = archive.read(tmp_path / "x", "some.format", version, layout)
        for key, value in arrays.items():
            np.testing.assert_array_equal(found[key], value)
    with pytest.raises(ValueError, match="version is 3, this package reads up to 2"):
        archive.read(tmp_path / "x", "some.format", 2, layout)
