"""What arrays of pixels mean, and what is no image."""

from pathlib import Path

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import refused


def pixels_of(image, tmp_path, **options):
    """The floats that the package makes of an image: those that it stores."""
    eg.save_image(tmp_path / "a.tif", image, bits=32, **options)
    return eg.load_image(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("pixel", "expected"),
    [
        (np.uint8(51), 0.2),
        (np.uint16(13107), 0.2),
        (np.dtype(">u2").type(13107), 0.2),
        (np.bool_(True), 1),
    ],
)
@pytest.mark.parametrize("shape", [(2, 5), (2, 5, 1), (2, 5, 3), (1, 1), (1, 9)])
def test_integers_are_parts_of_white_and_grey_is_replicated(pixel, expected, shape, tmp_path):
    eg.save_image(tmp_path / "a.png", np.full(shape, pixel))
    image = eg.load_image(tmp_path / "a.png")
    assert image.shape == (*shape[:2], 3)
    np.testing.assert_allclose(image, expected, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floats_keep_rows_columns_and_channels(dtype, tmp_path):
    image = np.random.default_rng(0).random((3, 4, 3)).astype(dtype)
    for view in (image, np.asfortranarray(image), image[::-1][::-1], image.tolist()):
        found = pixels_of(view, tmp_path, encoding="linear")
        np.testing.assert_array_equal(found, image.astype(np.float32))


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
        (np.where(np.eye(4), np.nan, 1), r"4 of 16 pixels .* first at \[0, 0\]"),
    ],
)
def test_what_is_no_image(image, complaint):
    with refused(eg.ImageError, complaint):
        eg.fit(image, 4, iterations=0)


def test_masked_pixels_are_not_dropped_in_silence():
    masked = np.ma.masked_less(np.eye(64, dtype=np.float32), 1)
    for call in (lambda a: eg.psnr(a, a), lambda a: eg.ssim(a, a), eg.fit_large):
        with refused(eg.ImageError, r"4032 values are masked; fill them"):
            call(masked)
    unmasked = np.ma.array(np.eye(64)[..., None])
    assert eg.psnr(unmasked, np.eye(64)[..., None]) == np.inf
