"""Files of sets come back as they were; images too large for 32-bit indices are refused."""

import os
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import eigengs_dr as eg
from _helpers.errors import file_refused
from _helpers.sets import SIZE, arrays_of, check_equal, few, random_scene
from eigengs_dr.backend.selection import select
from eigengs_dr.gaussian.file import check_index_range
from eigengs_dr.gaussian.gaussians import Gaussians
from eigengs_dr.raster.render import render


@pytest.mark.parametrize("space", ["ycbcr", "rgb", "linear", "data"])
def test_files_come_back_bit_equal(backend, tmp_path, space):
    scene = random_scene()
    scene.on(backend, space=space).save(tmp_path / "x.npz")
    found = Gaussians.load(str(tmp_path / "x.npz"), backend)
    check_equal(found, arrays_of(scene))
    assert (found.width, found.height, found.space) == (*SIZE, space)
    assert os.listdir(tmp_path) == ["x.npz"]


@few
@given(
    values=hnp.arrays(
        np.float32, (3, 8), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)
    ),
    size=st.tuples(st.integers(1, 1 << 16), st.integers(1, 1 << 16)),
)
def test_any_numbers_come_back(tmp_path_factory, values, size):
    path = tmp_path_factory.mktemp("any") / "x.bin"  # any suffix will do
    factor = np.abs(values[:, 2:5]) + np.float32(1e-30)
    arrays = {"mean": values[:, :2], "factor": factor, "color": np.clip(values[:, 5:], -1e17, 1e17)}
    Gaussians.from_arrays(**arrays, size=size, space="data").save(path)
    found = Gaussians.load(path)
    check_equal(found, {**arrays, "background": np.zeros(3)})
    assert (found.width, found.height) == size


def test_files_of_attached_and_of_shared_values(backend, tmp_path):
    gaussians = replace(random_scene().on(backend), factor=select(backend).Array3f(0.5, 0, 0.75))
    dr.enable_grad(gaussians.mean)
    gaussians.save(tmp_path / "x.npz")
    check_equal(Gaussians.load(tmp_path / "x.npz"), gaussians.to_arrays())


@pytest.mark.parametrize("cutoff", [2.0, 3.0, 4.5])
def test_the_cutoff_is_kept(path, cutoff):
    """It decides the rendering, and travels with the set."""
    gaussians = replace(random_scene().on("llvm"), cutoff=cutoff)
    gaussians.save(path)
    found = Gaussians.load(path)
    assert found.cutoff == cutoff
    np.testing.assert_array_equal(render(found).numpy(), render(gaussians).numpy())
    assert np.array_equal(render(found).numpy(), render(found, cutoff=3).numpy()) == (cutoff == 3)


def test_sizes_within_the_limit_pass():
    for size in ((37837, 37837, 3), (8191, 8192, 64), (65536, 65535, 1), (8189, 8192, 64)):
        check_index_range(*size)


@pytest.mark.parametrize("size", [(37838, 37838, 3), (8192, 8192, 64), (65536, 65536, 1)])
def test_larger_sizes_are_refused_in_one_line(size):
    with pytest.raises(ValueError, match=r"has [\d,]+ values, the limit is 4,294,967,295") as found:
        check_index_range(*size)
    message = str(found.value)
    assert f"{size[0]}x{size[1]} pixels and {size[2]} channels" in message
    assert "scale it down" in message and "\n" not in message
    with pytest.raises(ValueError, match="has 4,294,967,296 values"):  # in whole tiles
        check_index_range(8189, 8192, 64, tile=(4, 4))


def test_what_cannot_be_loaded_is_not_saved(path):
    """One check decides for reading and for writing."""
    with pytest.raises(ValueError, match=r"sides from 1 to 65536"):
        eg.fit(np.zeros((1, 70_000, 3), np.float32), 10, backend="llvm")
    good = random_scene().on("llvm")
    wide = good.scaled(70_000, 1)
    diverged = replace(good, mean=good.mean * np.nan)
    bright = replace(good, color=good.color * 1e38)
    for bad, words in ((wide, "size is"), (diverged, "not finite"), (bright, "color")):
        with file_refused(path, words):
            bad.save(path)
    assert not path.exists()
