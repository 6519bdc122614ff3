"""Types of pixels: integers in metrics, files under another suffix."""

import numpy as np
import pytest

import eigengs_dr as eg
from eigengs_dr.image.io import read_file

LIGHT = np.linspace(0.1, 0.9, 16 * 16 * 3, dtype=np.float32).reshape(16, 16, 3)


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("a.png", "b.jpg"),
        ("a.hdr", "b.png"),
        ("a.exr", "b.hdr"),
        ("a.tif", "b.jpg"),
        ("a.jpg", "b.png"),
    ],
)
def test_a_file_is_decoded_by_its_content(tmp_path, name, other):
    if name != "a.jpg":
        pytest.importorskip("OpenImageIO")
    bits = 16 if name in ("a.png", "a.tif") else None
    eg.save_image(tmp_path / name, 3 * LIGHT if name == "a.hdr" else LIGHT, bits=bits)
    expected = read_file(tmp_path / name)
    (tmp_path / name).rename(tmp_path / other)
    found = read_file(tmp_path / other)
    assert found.encoding == expected.encoding
    np.testing.assert_array_equal(found.pixels, expected.pixels)


def test_sets_compare_by_identity():
    a, b = (
        eg.Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], [[1, 1, 1]], size=(8, 8)) for _ in range(2)
    )
    assert a == a and a != b


def test_a_tiff_that_claims_too_many_pixels_is_refused_before_it_is_decoded(tmp_path):
    eg.save_image(tmp_path / "a.tif", LIGHT, bits=16)
    content = bytearray((tmp_path / "a.tif").read_bytes())
    tifffile = pytest.importorskip("tifffile")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        tags = [file.pages[0].tags[name] for name in ("ImageWidth", "ImageLength")]
        order = file.byteorder
        for tag in tags:
            size = 4 if tag.dtype == 4 else 2
            start = tag.valueoffset
            content[start : start + size] = (60_000).to_bytes(
                size, "little" if order == "<" else "big"
            )
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(eg.ImageError, match="more than 536,870,912 pixels"):
        eg.load_image(tmp_path / "a.tif")


def test_floats_from_0_to_255_are_not_written_as_white(tmp_path):
    with pytest.raises(eg.ImageError, match="divide by 255"):
        eg.save_image(tmp_path / "a.png", 255 * LIGHT)


def test_a_set_is_not_written_under_the_name_of_an_image(tmp_path):
    one = eg.Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], [[1, 1, 1]], size=(8, 8))
    with pytest.raises(ValueError, match="a set is no image"):
        one.save(tmp_path / "a.png")
