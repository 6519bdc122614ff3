"""Large images are read by windows: files of all layouts have the bits of their pixels."""

import numpy as np
import pytest
import tifffile
from PIL import Image

import eigengs_dr as eg
from _helpers.mosaics import Sliced, assert_same_bits, mosaic

FEW = {"gaussians": 60, "iterations": 2, "block": 32, "backend": "llvm"}
"""Settings of a fit of 32x144 pixels in five blocks."""

LAYOUTS = {
    "strips": {"rowsperstrip": 7},
    "tiles": {"tile": (32, 48)},
    "compressed": {"tile": (64, 64), "compression": "zlib"},
    "big endian": {"byteorder": ">"},
    "big": {"bigtiff": True, "tile": (16, 16)},
}


@pytest.fixture(scope="module")
def pixels():
    return mosaic(144)[:, :32]


@pytest.fixture(scope="module")
def expected(pixels):
    return eg.fit_large(pixels, **FEW)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_tiff(tmp_path, pixels, expected, layout):
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", **LAYOUTS[layout])
    assert_same_bits(expected, eg.fit_large(tmp_path / "a.tif", **FEW))


def test_files_that_are_decoded_as_a_whole(tmp_path, pixels, expected):
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(pixels).save(tmp_path / "a.tif", compression="tiff_lzw")
    for name in ("a.png", "a.tif"):
        assert_same_bits(expected, eg.fit_large(tmp_path / name, **FEW))


def test_arrays(tmp_path, pixels, expected):
    np.save(tmp_path / "a.npy", pixels)
    sliced = Sliced(pixels)
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    for source in (tmp_path / "a.npy", mapped, sliced):
        assert_same_bits(expected, eg.fit_large(source, **FEW))
    assert sliced.largest < pixels.size


def test_sixteen_bits(tmp_path, pixels, expected):
    deep = pixels * np.uint16(257)
    tifffile.imwrite(tmp_path / "a.tif", deep, photometric="rgb", tile=(32, 32))
    found = eg.fit_large(tmp_path / "a.tif", **FEW)
    assert found.psnr_rgb == pytest.approx(expected.psnr_rgb, abs=0.01)


@pytest.mark.parametrize("suffix", [".tif", ".npy"])
def test_floats_in_files_are_light(tmp_path, pixels, suffix):
    """In the code of sRGB, or as they are for data."""
    light = (pixels / np.float32(255)) ** 2
    path = tmp_path / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, light)
    else:
        eg.save_image(path, light, bits=32)
    expected = eg.fit_large(light, **FEW, encoding="linear")
    assert_same_bits(expected, eg.fit_large(path, **FEW))
    as_data = eg.fit_large(light, **FEW, space="data")
    assert_same_bits(as_data, eg.fit_large(path, **FEW, space="data"))


def test_grey_tiff(tmp_path, pixels):
    tifffile.imwrite(tmp_path / "a.tif", pixels[..., 0], tile=(32, 32))
    for space, channels in (("data", 1), ("ycbcr", 3)):
        found = eg.fit_large(tmp_path / "a.tif", **FEW, space=space)
        assert found.gaussians.channels == channels
        assert_same_bits(found, eg.fit_large(pixels[..., 0], **FEW, space=space))


def test_transparent_picture_is_shown_over_white(tmp_path, pixels):
    alpha = np.full((144, 32, 1), 128, np.uint8)
    Image.fromarray(np.concatenate([pixels, alpha], axis=2)).save(tmp_path / "a.png")
    with pytest.warns(UserWarning, match="over white"):
        found = eg.fit_large(tmp_path / "a.png", **FEW)
    with pytest.warns(UserWarning, match="over white"):
        shown = eg.load_image(tmp_path / "a.png")
    assert_same_bits(found, eg.fit_large(shown, **FEW))


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        (np.zeros((4, 4, 4), np.uint8), r"shape \(4, 4, 4\)"),
        (np.zeros((0, 4), np.uint8), "4x0 pixels"),
        (np.broadcast_to(np.uint8(0), (2, 70000)), "sides must be from 1 to 65,536"),
        ([[1, 2], [3, 4]], "is a list"),
    ],
)
def test_what_is_no_image(source, reason):
    with pytest.raises(eg.ImageError, match=reason):
        eg.fit_large(source, **FEW)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.tif", None, r"a\.tif: No such file"),
        ("b.npy", b"text", r"not a readable \.npy file"),
        ("c.tif", b"II*\0 no tiff", r"c\.tif"),
        ("", None, "is a folder; give an image file in it"),
    ],
)
def test_bad_files(tmp_path, name, content, reason):
    if content:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(eg.ImageError, match=reason):
        eg.fit_large(tmp_path / name, **FEW)


def test_damaged_tiff(tmp_path, pixels):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pixels, photometric="rgb", tile=(32, 32), compression="zlib")
    content = bytearray(path.read_bytes())
    content[-3000:-1000] = bytes(2000)
    path.write_bytes(content)
    with pytest.raises(eg.ImageError, match="damaged or unreadable"):
        eg.fit_large(path, **FEW)
