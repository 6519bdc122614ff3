"""Windows of large images."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from _helpers.files import png
from _helpers.mosaics import Sliced, mosaic
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.io import ImageError, load_image, save_image
from eigengs_dr.image.read import has_windows, read_header
from eigengs_dr.many.windows import image_size, open_source, write_tiles

PART = slice(37, 90), slice(50, 131)


@pytest.fixture
def pixels():
    return mosaic(150)


def assert_same(source, pixels, part=PART):
    found = source.window(*part).read()
    assert (source.height, source.width) == pixels.shape[:2]
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, pixels[part] / np.float32(255))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"tile": (32, 48)},
        {"tile": (64, 64), "compression": "zlib"},
        {"rowsperstrip": 40, "compression": "zlib"},
        {"rowsperstrip": 7},
        {"byteorder": ">"},
        {"bigtiff": True, "tile": (16, 16)},
    ],
)
def test_tiff_is_read_by_windows(tmp_path, pixels, options):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pixels, photometric="rgb", **options)
    assert has_windows(path, read_header(path)) and image_size(path) == (150, 150, 3)
    assert_same(open_source(path), pixels)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_tiff_of_more_bits(tmp_path, pixels, dtype):
    scale = 257 if dtype == np.uint16 else 1 / 255
    values = (pixels * np.float64(scale)).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", tile=(32, 32))
    found = open_source(tmp_path / "a.tif", encoding="srgb").window(*PART).read()
    np.testing.assert_allclose(found, pixels[PART] / 255, atol=1e-6)


@pytest.mark.parametrize("suffix", [".tif", ".pfm"])
def test_floats_are_light(tmp_path, suffix):
    light = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32) * 20
    save_image(tmp_path / f"a{suffix}", light, bits=32)
    found = open_source(tmp_path / f"a{suffix}").window(slice(3, 30), slice(5, 45)).read()
    np.testing.assert_array_equal(found, to_coded(light[3:30, 5:45]))
    as_data = open_source(tmp_path / f"a{suffix}", keep_grey=True)
    found = as_data.window(slice(3, 30), slice(5, 45)).read()
    np.testing.assert_array_equal(found, light[3:30, 5:45])


def test_grey_tiff(tmp_path, pixels):
    tifffile.imwrite(tmp_path / "a.tif", pixels[..., 0], tile=(32, 32))
    source = open_source(tmp_path / "a.tif", keep_grey=True)
    assert source.channels == 1
    assert_same(source, pixels[..., :1])
    assert open_source(tmp_path / "a.tif").channels == 3


def test_tiff_that_has_no_windows_is_decoded(tmp_path, pixels):
    path = tmp_path / "a.tif"
    Image.fromarray(pixels).save(path, compression="tiff_lzw")  # unknown without imagecodecs
    assert_same(open_source(path), pixels)


@pytest.mark.parametrize("name", ["a.png", "a.bmp"])
def test_pictures_are_decoded_once(tmp_path, pixels, name):
    Image.fromarray(pixels).save(tmp_path / name)
    source = open_source(tmp_path / name)
    assert_same(source, pixels)
    (tmp_path / name).unlink()
    assert_same(source, pixels)


def test_transparent_picture_is_shown_over_white(tmp_path, pixels):
    alpha = np.full((150, 150, 1), 128, np.uint8)
    Image.fromarray(np.concatenate([pixels, alpha], axis=2)).save(tmp_path / "a.png")
    with pytest.warns(UserWarning, match="over white"):
        found = open_source(tmp_path / "a.png").window(*PART).read()
    with pytest.warns(UserWarning, match="over white"):
        np.testing.assert_array_equal(found, load_image(tmp_path / "a.png")[PART])


def test_larger_than_pillow_allows(tmp_path, pixels, monkeypatch):
    Image.fromarray(pixels).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    assert_same(open_source(tmp_path / "a.png"), pixels)
    assert Image.MAX_IMAGE_PIXELS == 1000


def test_a_header_that_claims_too_much_is_refused_before_anything_is_decoded(tmp_path):
    (tmp_path / "a.png").write_bytes(png(100_000, 1000, 8, 2, []))
    with pytest.raises(ImageError, match="100000x1000 pixels; sides must be from 1 to 65,536"):
        open_source(tmp_path / "a.png")
    with pytest.raises(ImageError, match="MB in memory, the limit is"):
        load_image(tmp_path / "a.png")


def test_arrays(tmp_path, pixels):
    np.save(tmp_path / "a.npy", pixels)
    sliced = Sliced(pixels)
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    for source in (pixels, mapped, sliced, tmp_path / "a.npy"):
        assert_same(open_source(source), pixels)
    assert sliced.largest == pixels[PART].size
    assert_same(open_source(pixels[..., 0], keep_grey=True), pixels[..., :1])


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        (np.zeros((4, 4, 4), np.uint8), r"shape \(4, 4, 4\)"),
        (np.zeros(4, np.uint8), r"shape \(4,\)"),
        (np.zeros((0, 4), np.uint8), "4x0 pixels"),
        (np.broadcast_to(np.uint8(0), (2, 70000)), "sides must be from 1 to 65,536"),
        ([[1, 2], [3, 4]], "is a list"),
    ],
)
def test_what_is_no_image(source, reason):
    with pytest.raises(ImageError, match=reason):
        open_source(source)


def test_bad_files(tmp_path):
    with pytest.raises(ImageError, match="is a folder; give an image file in it"):
        open_source(tmp_path)
    with pytest.raises(ImageError, match=r"a\.tif: No such file"):
        open_source(tmp_path / "a.tif")
    (tmp_path / "b.npy").write_bytes(b"text")
    with pytest.raises(ImageError, match=r"not a readable \.npy file"):
        open_source(tmp_path / "b.npy")
    (tmp_path / "c.tif").write_bytes(b"II*\0 no tiff")
    with pytest.raises(ImageError, match=r"c\.tif"):
        open_source(tmp_path / "c.tif")


def test_bad_pixels_are_named():
    pixels = np.zeros((100, 100, 3), np.float32)
    pixels[60, 70] = np.nan
    with pytest.raises(ImageError, match="image, rows 50 to 80, columns 60 to 90: 1 of 900 pixels"):
        open_source(pixels).window(slice(50, 80), slice(60, 90)).read()


def test_damaged_tiff(tmp_path, pixels):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pixels, photometric="rgb", tile=(32, 32), compression="zlib")
    source = open_source(path)
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(ImageError, match="damaged or unreadable"):
        source.window(*PART).read()


@pytest.mark.parametrize("channels", [1, 3])
def test_tiles_are_written(tmp_path, channels):
    pixels = np.random.default_rng(0).integers(0, 256, (700, 300, channels), np.uint8)
    write_tiles(tmp_path / "a.tif", pixels.shape, iter([pixels[:512], pixels[512:]]))
    found = np.asarray(Image.open(tmp_path / "a.tif"))
    np.testing.assert_array_equal(found.reshape(pixels.shape), pixels)
    assert has_windows(tmp_path / "a.tif", read_header(tmp_path / "a.tif"))
    assert image_size(tmp_path / "a.tif") == pixels.shape
