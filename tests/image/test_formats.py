"""Files of floats and of 16 bits: EXR, HDR, PFM, TIFF and PNG."""

import os
import sys
import warnings

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image

from _helpers.errors import one_line, refused
from eigengs_dr.image.color import to_coded
from eigengs_dr.image.io import ImageError, check_image, load_image, read_file, save_image

LIGHT = (np.random.default_rng(0).random((5, 7, 3)) ** 8 * 5000).astype(np.float32)
FLOATS = [".exr", ".hdr", ".pfm", ".tif"]


def write_exr(path, names, pixels=None, **attributes):
    """Write an EXR file of the given channels."""
    pixels = np.full((2, 3, len(names)), 0.5, np.float32) if pixels is None else pixels
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], len(names), "float")
    spec.channelnames = names
    for name, value in attributes.items():
        spec.attribute(name, value)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(pixels) and file.close()


@pytest.mark.parametrize("suffix", FLOATS)
@pytest.mark.parametrize("channels", [1, 3])
def test_floats_come_back(tmp_path, suffix, channels):
    path, light = tmp_path / f"a{suffix}", LIGHT[..., :channels]
    save_image(path, light, bits=32)
    found = load_image(path, keep_grey=True)
    assert read_file(path, keep_grey=True).encoding == "linear" and found.dtype == np.float32
    if suffix == ".hdr":  # 8 bits, and one exponent for three channels
        assert (np.abs(found - light) <= light.max(axis=2, keepdims=True) / 128).all()
    else:
        np.testing.assert_array_equal(found, light)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_16_bits_come_back(tmp_path, suffix, channels):
    values = np.random.default_rng(1).integers(0, 65536, (5, 7, channels), np.uint16)
    save_image(tmp_path / f"a{suffix}", values, bits=16)
    found = load_image(tmp_path / f"a{suffix}", keep_grey=True)
    assert read_file(tmp_path / f"a{suffix}", keep_grey=True).encoding == "srgb"
    np.testing.assert_array_equal(np.rint(found * 65535), values)


def test_half_floats_are_clamped(tmp_path):
    light = np.concatenate([LIGHT, np.full((1, 7, 3), 1e6, np.float32)])
    save_image(tmp_path / "a.exr", light, bits=16)
    halves = np.minimum(light, 65504).astype(np.float16)
    np.testing.assert_array_equal(load_image(tmp_path / "a.exr"), halves)


def test_big_endian_pfm(tmp_path):
    (tmp_path / "a.pfm").write_bytes(b"PF\n7 5\n1.0\n" + LIGHT[::-1].astype(">f4").tobytes())
    np.testing.assert_array_equal(load_image(tmp_path / "a.pfm"), LIGHT)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_deep_tiff_is_turned_as_pillow_turns(tmp_path, orientation):
    values = (np.arange(5 * 7 * 3) % 256).reshape(5, 7, 3)
    tags = [(274, "H", 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", values.astype(np.uint8), extratags=tags)
    deep = (values * 257).astype(np.uint16)
    tifffile.imwrite(tmp_path / "b.tif", deep, extratags=tags, photometric="rgb")
    np.testing.assert_allclose(load_image(tmp_path / "b.tif"), load_image(tmp_path / "a.tif"))


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
    bits = 16 if name in ("a.png", "a.tif") else None
    save_image(tmp_path / name, LIGHT / 5000, bits=bits, encoding="srgb")
    expected = read_file(tmp_path / name)
    (tmp_path / name).rename(tmp_path / other)
    found = read_file(tmp_path / other)
    assert found.encoding == expected.encoding
    np.testing.assert_array_equal(found.pixels, expected.pixels)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("Z",), "holds one channel, not R, G and B"),
        (("R", "G", "B", "glow.R", "glow.G", "glow.B"), r"holds the channels R, G, B, glow\.R"),
    ],
)
def test_exr_of_other_channels(tmp_path, names, words):
    write_exr(tmp_path / "a.exr", names)
    with pytest.raises(ImageError, match=words) as error:
        load_image(tmp_path / "a.exr")
    assert "a.exr" in one_line(error)
    if len(names) == 1:
        assert load_image(tmp_path / "a.exr", keep_grey=True).shape == (2, 3, 1)


def test_exr_of_parts(tmp_path):
    path = str(tmp_path / "a.exr")
    specs = [oiio.ImageSpec(3, 2, 3, "float") for _ in range(2)]
    for number, spec in enumerate(specs):
        spec.attribute("oiio:subimagename", f"part{number}")
    file = oiio.ImageOutput.create(path)
    assert file.open(path, specs)
    for number, spec in enumerate(specs):
        assert number == 0 or file.open(path, spec, "AppendSubimage")
        assert file.write_image(np.zeros((2, 3, 3), np.float32))
    assert file.close()
    with refused(ImageError, "holds several parts"):
        load_image(path)


def test_transparent_exr_is_over_black(tmp_path):
    pixels = np.full((2, 3, 4), 0.5, np.float32)
    write_exr(tmp_path / "a.exr", ("R", "G", "B", "A"), pixels)
    with pytest.warns(UserWarning, match="over black"):
        np.testing.assert_array_equal(load_image(tmp_path / "a.exr"), pixels[..., :3])
    pixels[..., 3] = 1
    write_exr(tmp_path / "a.exr", ("R", "G", "B", "A"), pixels)
    np.testing.assert_array_equal(load_image(tmp_path / "a.exr"), pixels[..., :3])


@pytest.mark.parametrize("suffix", [".exr", ".pfm", ".tif"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite(tmp_path, suffix, bad):
    light = LIGHT.copy()
    path = tmp_path / f"a{suffix}"
    save_image(path, light, bits=32)
    light[2, 4, 1] = bad
    if suffix == ".exr":
        write_exr(path, ("R", "G", "B"), light)
    elif suffix == ".tif":
        tifffile.imwrite(path, light, photometric="rgb")
    else:
        path.write_bytes(b"PF\n7 5\n-1\n" + light[::-1].tobytes())
    with pytest.raises(ImageError, match=r"1 of 35 pixels are not finite.*\[2, 4\]") as error:
        load_image(path)
    assert str(path) in one_line(error)


@pytest.mark.parametrize("suffix", [*FLOATS, ".png", ".jpg", ".gif", ".webp", ".bmp", ".ppm"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_truncated_files(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    if suffix in FLOATS:
        save_image(path, np.random.default_rng(0).random((64, 64, 3)), bits=32)
    else:
        noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
        Image.fromarray(noise).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: max(40, int(share * len(content)))])
    with pytest.raises(ImageError) as error:
        load_image(path)
    assert str(path) in one_line(error)


def test_a_tiff_that_claims_too_many_pixels_is_refused_before_it_is_decoded(tmp_path):
    save_image(tmp_path / "a.tif", LIGHT / 5000, bits=16)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+b") as file:
        for name in ("ImageWidth", "ImageLength"):
            file.pages[0].tags[name].overwrite(9000)
    with pytest.raises(ImageError, match="takes 972 MB in memory"):
        load_image(tmp_path / "a.tif")


@pytest.mark.parametrize(("name", "bits"), [("a.jpg", 16), ("a.hdr", 16), ("a.png", 32)])
def test_bits_that_a_format_has_not(tmp_path, name, bits):
    with refused(ImageError, f"bits is {bits}; a"):
        save_image(tmp_path / name, LIGHT, bits=bits)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- what pixels are


def test_encoding_of_a_file_can_be_said(tmp_path):
    codes = np.full((2, 3, 3), 0.5)
    save_image(tmp_path / "a.exr", codes)
    save_image(tmp_path / "a.png", codes)
    np.testing.assert_array_equal(check_image(tmp_path / "a.exr", encoding="srgb"), 0.5)
    light = check_image(tmp_path / "a.png", encoding="linear")
    np.testing.assert_allclose(light, to_coded(load_image(tmp_path / "a.png")), rtol=1e-6)
    with refused(ValueError, "encoding 'gamma' is unknown"):
        check_image(tmp_path / "a.png", encoding="gamma")


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
    save_image(tmp_path / name, np.full((2, 3, 3), float(given)), encoding=encoding)
    tolerance = {"rtol": 1e-5} if name == "a.exr" else {"atol": 0.5 / 255}
    np.testing.assert_allclose(load_image(tmp_path / name), expected, **tolerance)


def test_check_image_codes_light():
    assert check_image(LIGHT, encoding="linear").max() > 10
    np.testing.assert_allclose(
        check_image(np.full((1, 1, 3), 0.214041), encoding="linear"), 0.5, rtol=1e-6
    )
    with refused(ImageError, "pass encoding='linear' for light"):
        check_image(LIGHT)
    with pytest.raises(ImageError, match="scale it first"):
        check_image(np.full((2, 2), 1e10), encoding="linear")


@pytest.mark.mitsuba
@pytest.mark.parametrize("gamma", [False, True])
def test_a_bitmap_tells_what_it_is(tmp_path, gamma):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    bitmap = mi.Bitmap(np.full((2, 3, 3), 0.214041, np.float32))
    if gamma:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)
    np.testing.assert_allclose(check_image(bitmap), 0.5, atol=0.5 / 255)
    save_image(tmp_path / "a.png", bitmap)
    np.testing.assert_allclose(load_image(tmp_path / "a.png"), 0.5, atol=0.5 / 255)


def test_a_tensor_of_colours_shall_say_what_it_is(tmp_path):
    from drjit.llvm.ad import TensorXf

    tensor = TensorXf(LIGHT[:2, :2] / 5000)
    with pytest.warns(UserWarning, match="encoding='linear' for light"):
        save_image(tmp_path / "a.png", tensor)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_image(tmp_path / "a.png", tensor, encoding="linear")


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="has names of text alone")
def test_a_name_that_is_no_text(tmp_path):
    path = tmp_path / os.fsdecode(b"\xff.png")
    Image.fromarray(np.zeros((2, 3, 3), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(path)
    assert load_image(path).shape == (2, 3, 3)


def test_a_suffix_that_opens_no_file_is_refused(tmp_path):
    """OpenImageIO makes a picture of a file whose suffix is .null, whatever it holds."""
    save_image(tmp_path / "a.png", LIGHT / 5000)
    (tmp_path / "a.png").rename(tmp_path / "a.null")
    with refused(ImageError, r"a\.null: its suffix \.null is that of other files; rename it"):
        load_image(tmp_path / "a.null")


def test_a_jpeg_with_stray_bytes_is_read(tmp_path):
    pixels = np.full((16, 24, 3), 200, np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=100)
    content = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(content[:20] + b"\0\1\2" + content[20:])
    np.testing.assert_allclose(load_image(tmp_path / "a.jpg"), pixels / 255, atol=0.01)
