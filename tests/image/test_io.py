"""Reading and writing images: every kind of file and damage, and the checks of arrays."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

import eigengs_dr as eg
from _helpers.errors import one_line, refused
from _helpers.files import BYTES, png
from _helpers.image_kinds import NEEDS_PILLOW_13
from eigengs_dr.image.formats import PICTURE_SUFFIXES
from eigengs_dr.image.io import (
    SAMPLES,
    ImageError,
    check_image,
    load_image,
    sample,
    save_image,
    to_8bit,
)

YCBCR = pytest.param("YCbCr", marks=NEEDS_PILLOW_13)


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "CMYK", YCBCR, "I;16", "F"])
def test_every_mode_of_an_opaque_file(tmp_path, mode):
    grey = np.array([[0, 255, 0], [255, 255, 0]], np.uint8)
    image = {
        "I;16": lambda: Image.fromarray(grey.astype(np.uint16) * 257),
        "F": lambda: Image.fromarray(grey.astype(np.float32) / 255),
    }.get(mode, lambda: Image.fromarray(grey).convert(mode))()
    path = tmp_path / "a.tif"
    image.save(path)
    assert Image.open(path).mode == mode
    result = load_image(path)
    assert result.shape == (2, 3, 3)
    expected = np.repeat(grey[..., None], 3, axis=2) / 255
    np.testing.assert_allclose(result, expected, atol=0.005 if mode == "YCbCr" else 0)
    kept = load_image(path, keep_grey=True)
    channels = 1 if mode in ("1", "L", "I;16", "F") else 3
    np.testing.assert_array_equal(kept, result[..., :channels])


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_16_bit_grey_keeps_its_precision(tmp_path, suffix):
    values = np.array([[0, 1, 257], [65535, 32768, 12345]], np.uint16)
    Image.fromarray(values).save(tmp_path / f"a{suffix}")
    image = load_image(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(np.rint(image[..., 1] * 65535), values)


@pytest.mark.parametrize(("kind", "channels"), [(2, 3), (4, 2), (6, 4)])
def test_16_bit_colour_keeps_its_precision(tmp_path, kind, channels):
    rows = (np.arange(2 * 3 * channels) * 3000 + 77).astype(">u2").reshape(2, 3, channels)
    alpha = channels % 2 == 0
    if alpha:
        rows[..., -1] = 65535
    (tmp_path / "a.png").write_bytes(png(3, 2, 16, kind, rows))
    colors = np.broadcast_to(rows[..., : channels - alpha], (2, 3, 3))
    np.testing.assert_allclose(load_image(tmp_path / "a.png"), colors / 65535, atol=1e-7)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_is_composited_over_white(tmp_path, mode):
    image = Image.new("LA", (2, 1), (51, 255))
    image.putpixel((1, 0), (51, 102))
    image.convert(mode).save(tmp_path / "a.png")
    with pytest.warns(UserWarning, match="over white") as caught:
        result = load_image(tmp_path / "a.png")
    assert len(caught) == 1 and "\n" not in str(caught[0].message)
    np.testing.assert_allclose(result[0, :, 0], [0.2, 0.4 * 0.2 + 0.6], atol=1e-6)
    Image.fromarray(BYTES).convert("RGBA").save(tmp_path / "a.png")  # opaque: no news
    np.testing.assert_allclose(load_image(tmp_path / "a.png"), BYTES / 255, atol=1e-7)


def test_palette_with_a_transparent_entry(tmp_path):
    image = Image.fromarray(np.array([[0, 1]], np.uint8), "P")
    image.putpalette([255, 0, 0, 0, 0, 255])
    image.save(tmp_path / "a.png", transparency=1)
    with pytest.warns(UserWarning, match="over white"):
        result = load_image(tmp_path / "a.png")
    np.testing.assert_array_equal(result, [[[1, 0, 0], [1, 1, 1]]])


@pytest.mark.parametrize("suffix", [".gif", ".png", ".tif"])
def test_first_frame_of_an_animation(tmp_path, suffix):
    frames = [Image.new("RGB", (3, 2), color) for color in ("red", "blue", "lime")]
    path = tmp_path / f"a{suffix}"
    frames[0].save(path, save_all=True, append_images=frames[1:])
    with pytest.warns(UserWarning, match="holds 3 frames, the first is used"):
        result = load_image(path)
    np.testing.assert_array_equal(result, np.broadcast_to([1.0, 0, 0], (2, 3, 3)))


def test_exif_orientation(tmp_path):
    pixels = np.zeros((8, 16, 3), np.uint8)
    pixels[:, :8] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying on its left side: left becomes top
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    result = load_image(tmp_path / "a.png")
    assert result.shape == (16, 8, 3)
    assert result[:8].min() == 1 and result[8:].max() == 0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        (b"", "empty"),
        (b"some text\n", "not an image"),
        (b"hi\n", "not an image"),  # shorter than what some decoders unpack to recognise a file
        ("/", "is a folder"),
    ],
)
def test_files_that_are_no_images(tmp_path, content, words):
    path = tmp_path if content == "/" else tmp_path / "a.png"
    if isinstance(content, bytes):
        path.write_bytes(content)
    with pytest.raises(ImageError, match=words) as error:
        load_image(path)
    assert str(path) in one_line(error)


def test_decompression_bomb(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png(9000, 9000, 8, 2, []))
    with refused(ImageError, "takes 972 MB in memory, the limit is"):
        load_image(path)


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=40, deadline=None)
@given(st.data())
def test_damaged_files_load_or_say_so(tmp_path_factory, data):
    file = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    Image.fromarray(noise).save(file, data.draw(st.sampled_from(["PNG", "JPEG", "GIF", "TIFF"])))
    content = bytearray(file.getvalue())
    for place in data.draw(st.lists(st.integers(0, min(200, len(content) - 1)), max_size=4)):
        content[place] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "a.png"
    path.write_bytes(content)
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Image, "MAX_IMAGE_PIXELS", 10_000)
            image = load_image(path)
    except ImageError as error:
        assert "\n" not in str(error)
    else:
        assert image.dtype == np.float32 and image.shape[2] == 3


# --- Arrays, and the photos of scikit-image ---


@pytest.mark.parametrize(
    ("pixel", "expected"),
    [
        (np.uint8(51), 0.2),
        (np.uint16(13107), 0.2),
        (np.dtype(">u2").type(13107), 0.2),
        (np.bool_(True), 1),
        (np.float16(0.5), 0.5),
        (np.float32(0.2), 0.2),
        (np.float64(-0.4), -0.4),
    ],
)
@pytest.mark.parametrize("shape", [(2, 5), (2, 5, 1), (2, 5, 3), (1, 1), (1, 9)])
def test_check_image_scales_and_replicates(pixel, expected, shape):
    image = np.full(shape, pixel)
    result = check_image(image)
    assert result.dtype == np.float32 and result.flags.c_contiguous
    assert result.shape == (*shape[:2], 3)
    np.testing.assert_allclose(result, expected, rtol=1e-6)
    assert not np.shares_memory(result, image)


def test_check_image_keeps_rows_columns_and_channels():
    image = np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)
    for view in (image, np.asfortranarray(image), image[::-1][::-1], image.tolist()):
        np.testing.assert_array_equal(check_image(view), image)


@pytest.mark.parametrize(
    ("image", "complaint"),
    [
        (np.zeros(5), r"shape \(5,\), expected"),
        (np.float32(1), r"shape \(\), expected"),
        (np.zeros((4, 4, 2)), r"shape \(4, 4, 2\), expected"),
        (np.zeros((4, 4, 4)), r"drop alpha"),
        (np.zeros((1, 4, 4, 3)), r"shape \(1, 4, 4, 3\), expected .*; fit_many takes several"),
        (["a.png", "b.png"], r"shape \(2,\), expected .*; fit_many takes several images"),
        ([Path("a.png")], "fit_many takes several images"),
        ([np.zeros((2, 3)), np.zeros((4, 5))], "fit_many takes several images"),
        (np.ma.masked_less(np.eye(4), 1), r"12 values are masked; fill them, .*\.filled\(0\)"),
        (np.zeros((0, 4, 3)), "no pixels"),
        (np.zeros((4, 0)), "no pixels"),
        (np.zeros((4, 4), np.int64), "pixels are int64"),
        (np.full((4, 4), None), "pixels are object"),
        ([[1, 2], [3]], "not an array"),
        (
            np.full((2, 2), 255.0),
            "from 255 to 255, not 0 to 1; divide by 255 first, or pass encoding=",
        ),
        (np.full((2, 2), 1e300), "scale it first"),
        (np.array([[-1.0, 1.0]]), "from -1 to 1, not 0 to 1; scale it"),
    ],
)
def test_check_image_refuses(image, complaint):
    with refused(ImageError, complaint):
        check_image(image)


def test_masked_pixels_are_not_dropped_in_silence():
    masked = np.ma.masked_less(np.eye(64, dtype=np.float32), 1)
    for call in (eg.fit, lambda a: eg.psnr(a, a), lambda a: eg.ssim(a, a), eg.fit_large):
        with refused(ImageError, r"4032 values are masked; fill them"):
            call(masked)
    np.testing.assert_array_equal(check_image(np.ma.array(np.eye(4))), check_image(np.eye(4)))


def test_non_finite_pixels_are_counted_and_placed():
    image = np.zeros((3, 4, 3))
    image[1, 2] = np.nan
    image[2, 0, 1] = np.inf
    with refused(ImageError, r"2 of 12 pixels .* first at \[1, 2\]"):
        check_image(image)


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_need_no_download(name):
    image = sample(name)
    assert image.dtype == np.float32 and image.shape[2] == 3
    assert min(image.shape[:2]) >= 300
    assert image.min() >= 0 and image.max() <= 1 and np.ptp(image) > 0.4


def test_unknown_sample():
    with refused(ImageError, "use one of astronaut, "):
        sample("lena")


# --- Writing: what is written comes back, or nothing is written ---


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
    with Image.open(path) as file:
        assert file.mode == ("L" if image.shape[2] == 1 else "RGB")
    np.testing.assert_array_equal(load_image(path), check_image(image))
    kept = load_image(path, keep_grey=True)
    np.testing.assert_array_equal(kept, check_image(image, keep_grey=True))
    save_image(path, load_image(path))
    np.testing.assert_array_equal(load_image(path), check_image(image))


@pytest.mark.parametrize("suffix", PICTURE_SUFFIXES)
def test_every_suffix_is_written_in_its_format(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    image = np.full((8, 8, 3), (0.2, 0.4, 0.6))
    save_image(path, image)
    np.testing.assert_allclose(load_image(path), image, atol=0.02)
    kind = {".jpg": "JPEG", ".tif": "TIFF"}.get(suffix, suffix[1:].upper())
    assert Image.open(path).format == kind


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


@pytest.mark.skipif(sys.platform == "win32", reason="has no such limit")
@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".png", ".tif", ".pfm"])
def test_a_full_disk_is_said(tmp_path, suffix):
    """OpenImageIO does not tell why it fails, and takes a PNG file that is cut for written."""
    import resource

    pixels = np.random.default_rng(0).random((100, 100, 3), np.float32)
    path, bits = tmp_path / f"a{suffix}", 16 if suffix in (".png", ".tif") else None
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16384, before[1]))
    try:
        with pytest.raises(ImageError, match=r"cannot be written \(File too large\)"):
            save_image(path, pixels, bits=bits)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_bad_pixels_touch_no_file(tmp_path):
    for image, words in (
        (np.full((2, 2), np.nan), "not finite"),
        (np.linspace(0, 255, 12).reshape(2, 2, 3), "divide by 255"),
    ):
        with pytest.raises(ImageError, match=words):
            save_image(tmp_path / "a.png", image)
    one = eg.Gaussians.from_arrays([[1, 1]], [[1, 0, 1]], [[1, 1, 1]], size=(8, 8))
    with pytest.raises(ValueError, match="a set is not an image"):
        one.save(tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
