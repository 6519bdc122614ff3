"""What `save_image` writes comes back from `load_image`, or nothing is written."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

import eigengs_dr as eg
from _helpers.errors import refused

LIGHT = (np.random.default_rng(0).random((5, 7, 3)) ** 8 * 5000).astype(np.float32)
BYTES = np.array([[[0, 51, 102], [255, 204, 153]]], np.uint8)
FLOATS = [".exr", ".hdr", ".pfm", ".tif"]

byte_images = hnp.arrays(
    np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 3]))
)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff", ".bmp", ".ppm", ".PNG"])
@settings(max_examples=10)
@given(image=byte_images)
def test_bytes_come_back(tmp_path_factory, suffix, image):
    path = tmp_path_factory.mktemp("round") / f"a{suffix}"
    eg.save_image(path, image)
    with Image.open(path) as file:
        assert file.mode == ("L" if image.shape[2] == 1 else "RGB")
    shown = np.broadcast_to(image / np.float32(255), (*image.shape[:2], 3))
    np.testing.assert_array_equal(eg.load_image(path), shown)
    assert eg.load_image(path, keep_grey=True).shape == image.shape
    eg.save_image(path, eg.load_image(path))
    np.testing.assert_array_equal(eg.load_image(path), shown)


@pytest.mark.parametrize("kind", ["JPEG", "WEBP"])
def test_lossy_formats_come_close(tmp_path, kind):
    path, image = tmp_path / f"a.{kind.lower()}", np.full((8, 8, 3), (0.2, 0.4, 0.6))
    eg.save_image(path, image)
    np.testing.assert_allclose(eg.load_image(path), image, atol=0.02)
    assert Image.open(path).format == kind


@pytest.mark.parametrize("suffix", FLOATS)
@pytest.mark.parametrize("channels", [1, 3])
def test_floats_come_back(tmp_path, suffix, channels):
    path, light = tmp_path / f"a{suffix}", LIGHT[..., :channels]
    eg.save_image(path, light, bits=32)
    found = eg.load_image(path, keep_grey=True)
    if suffix == ".hdr":  # 8 bits, and one exponent for three channels
        assert (np.abs(found - light) <= light.max(axis=2, keepdims=True) / 128).all()
    else:
        np.testing.assert_array_equal(found, light)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_16_bits_come_back(tmp_path, suffix, channels):
    values = np.random.default_rng(1).integers(0, 65536, (5, 7, channels), np.uint16)
    eg.save_image(tmp_path / f"a{suffix}", values, bits=16)
    found = eg.load_image(tmp_path / f"a{suffix}", keep_grey=True)
    np.testing.assert_array_equal(np.rint(found * 65535), values)


def test_half_floats_are_clamped(tmp_path):
    light = np.concatenate([LIGHT, np.full((1, 7, 3), 1e6, np.float32)])
    eg.save_image(tmp_path / "a.exr", light, bits=16)
    halves = np.minimum(light, 65504).astype(np.float16)
    np.testing.assert_array_equal(eg.load_image(tmp_path / "a.exr"), halves)


def test_bytes_are_clamped_and_rounded(tmp_path):
    values = np.array([[-3, 0.49 / 255, 0.51 / 255, 0.9999, 7, 1e300]])
    eg.save_image(tmp_path / "a.png", values)
    levels = np.rint(eg.load_image(tmp_path / "a.png") * 255)[0, :, 0]
    np.testing.assert_array_equal(levels, [0, 0, 1, 255, 255, 255])


@pytest.mark.parametrize(
    ("name", "given", "encoding", "expected"),
    [
        ("a.png", 0.214041, "linear", 0.5),
        ("a.png", 0.214041, None, 0.214041),
        ("a.png", 5000, "linear", 1),
        ("a.exr", 0.5, "srgb", 0.214041),
    ],
)
def test_files_hold_codes_or_light(tmp_path, name, given, encoding, expected):
    eg.save_image(tmp_path / name, np.full((2, 3, 3), float(given)), encoding=encoding)
    tolerance = {"rtol": 1e-5} if name == "a.exr" else {"atol": 0.5 / 255}
    np.testing.assert_allclose(eg.load_image(tmp_path / name), expected, **tolerance)


def test_a_tensor_of_colours_shall_say_what_it_is(tmp_path):
    from drjit.llvm.ad import TensorXf

    tensor = TensorXf(LIGHT[:2, :2] / 5000)
    with pytest.warns(UserWarning, match="encoding='linear' for light"):
        eg.save_image(tmp_path / "a.png", tensor)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.save_image(tmp_path / "a.png", tensor, encoding="linear")


@pytest.mark.mitsuba
@pytest.mark.parametrize("gamma", [False, True])
def test_a_bitmap_tells_what_it_is(tmp_path, gamma):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    bitmap = mi.Bitmap(np.full((2, 3, 3), 0.214041, np.float32))
    if gamma:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)
    eg.save_image(tmp_path / "a.png", bitmap)
    np.testing.assert_allclose(eg.load_image(tmp_path / "a.png"), 0.5, atol=0.5 / 255)


# --- What is not written ---


@pytest.mark.parametrize("name", ["a.gif", "a.exrs", "a", "a.npz", ".png"])
def test_an_unknown_suffix(tmp_path, name):
    with refused(eg.ImageError, r"is unknown; use one of \.png"):
        eg.save_image(tmp_path / name, BYTES)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "bits"), [("a.jpg", 16), ("a.hdr", 16), ("a.png", 32)])
def test_bits_that_a_format_has_not(tmp_path, name, bits):
    with refused(eg.ImageError, f"bits is {bits}; a"):
        eg.save_image(tmp_path / name, LIGHT, bits=bits)
    assert not list(tmp_path.iterdir())


def test_bad_pixels_touch_no_file(tmp_path):
    for image, words in (
        (np.full((2, 2), np.nan), "not finite"),
        (np.linspace(0, 255, 12).reshape(2, 2, 3), "divide by 255"),
    ):
        with pytest.raises(eg.ImageError, match=words):
            eg.save_image(tmp_path / "a.png", image)
    one = eg.Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], [[1, 1, 1]], size=(8, 8))
    with pytest.raises(ValueError, match="Gaussians are not an image"):
        one.save(tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
