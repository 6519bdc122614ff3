"""Writing images: what is written comes back, or nothing is written."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import eigengs_dr as eg
from _helpers.errors import one_line, refused
from _helpers.files import BYTES, property_of
from eigengs_dr.image.formats import PICTURE_SUFFIXES
from eigengs_dr.image.io import (
    ImageError,
    check_image,
    load_image,
    save_image,
    to_8bit,
)

LOSSLESS = [".png", ".tif", ".tiff", ".bmp", ".ppm", ".PNG"]

byte_images = hnp.arrays(
    np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 3]))
)


@pytest.mark.parametrize("suffix", LOSSLESS)
@settings(max_examples=10, deadline=None)
@given(image=byte_images)
def test_lossless_round_trip(tmp_path_factory, suffix, image):
    path = tmp_path_factory.mktemp("round") / f"a{suffix}"
    save_image(path, image)
    np.testing.assert_array_equal(load_image(path), check_image(image))
    save_image(path, load_image(path))
    np.testing.assert_array_equal(load_image(path), check_image(image))


@pytest.mark.parametrize("suffix", PICTURE_SUFFIXES)
def test_every_suffix_is_written_in_its_format(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    image = np.full((8, 8, 3), (0.2, 0.4, 0.6))
    save_image(path, image)
    np.testing.assert_allclose(load_image(path), image, atol=0.02)
    kind = {".jpg": "JPEG", ".tif": "TIFF"}.get(suffix, suffix[1:].upper())
    assert property_of(path, "format") == kind


@pytest.mark.parametrize(("channels", "mode"), [(1, "L"), (3, "RGB")])
def test_grey_stays_grey(tmp_path, channels, mode):
    image = np.random.default_rng(0).integers(0, 256, (5, 4, channels), np.uint8)
    save_image(tmp_path / "a.png", image)
    assert property_of(tmp_path / "a.png", "mode") == mode
    kept = load_image(tmp_path / "a.png", keep_grey=True)
    np.testing.assert_array_equal(kept, check_image(image, keep_grey=True))
    assert kept.shape == image.shape and kept.flags.c_contiguous


def test_saving_clamps_and_rounds(tmp_path):
    values = np.array([[-3, 0.49 / 255, 0.51 / 255, 0.9999, 7, 1e300]])
    save_image(tmp_path / "a.png", values)
    levels = np.rint(load_image(tmp_path / "a.png") * 255)[0, :, 0]
    np.testing.assert_array_equal(levels, [0, 0, 1, 255, 255, 255])
    np.testing.assert_array_equal(to_8bit(values)[0], levels)


@pytest.mark.parametrize("name", ["a.gif", "a.exrs", "a", "a.npz", ".png"])
def test_unknown_suffix(tmp_path, name):
    with refused(ImageError, r"is unknown; use one of \.png"):
        save_image(tmp_path / name, BYTES)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_everything_as_it_was(tmp_path):
    resource = pytest.importorskip("resource")
    path = tmp_path / "a.png"
    save_image(path, BYTES)
    before, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, limits[1]))  # as a disk that is full
    try:
        with pytest.raises(ImageError, match="cannot be written") as error:
            save_image(path, 1 - BYTES / 255)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    one_line(error)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_targets(tmp_path):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").write_bytes(b"")
    for target in ("folder.png", "nowhere/a.png", "file/a.png"):
        with pytest.raises(ImageError, match=r"cannot be written|is a folder") as error:
            save_image(tmp_path / target, BYTES)
        assert one_line(error).count("choose another path") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.png"]


def test_bad_pixels_touch_no_file(tmp_path):
    for image, words in (
        (np.full((2, 2), np.nan), "not finite"),
        (np.zeros((2, 2, 5)), "shape"),
        (np.zeros((0, 0, 3)), "no pixels"),
        (np.linspace(0, 255, 12).reshape(2, 2, 3), "divide by 255"),
    ):
        with pytest.raises(ImageError, match=words):
            save_image(tmp_path / "a.png", image)
    one = eg.Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], [[1, 1, 1]], size=(8, 8))
    with pytest.raises(ValueError, match="a set is no image"):
        one.save(tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
