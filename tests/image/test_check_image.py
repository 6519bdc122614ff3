"""The checks of an image: which arrays are one, and what is said of others."""

import numpy as np
import pytest

from _helpers.errors import one_line
from eigengs_dr.image.io import (
    ImageError,
    check_image,
)


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
        (np.zeros((1, 4, 4, 3)), r"shape \(1, 4, 4, 3\), expected"),
        (np.zeros((0, 4, 3)), "no pixels"),
        (np.zeros((4, 0)), "no pixels"),
        (np.zeros((4, 4), np.int64), "pixels are int64"),
        (np.zeros((4, 4), complex), "pixels are complex128"),
        (np.full((4, 4), None), "pixels are object"),
        (np.full((4, 4), "a"), "pixels are <U1"),
        ([[1, 2], [3]], "not an array"),
        (
            np.full((2, 2), 255.0),
            "from 255 to 255, not 0 to 1; divide by 255 first, or say encoding=",
        ),
        (np.full((2, 2), 1e300), "scale it first"),
        (np.array([[-1.0, 1.0]]), "from -1 to 1, not 0 to 1; scale it"),
    ],
)
def test_check_image_refuses(image, complaint):
    with pytest.raises(ImageError, match=complaint) as error:
        check_image(image)
    one_line(error)


def test_non_finite_pixels_are_counted_and_placed():
    image = np.zeros((3, 4, 3))
    image[1, 2] = np.nan
    image[2, 0, 1] = np.inf
    with pytest.raises(ImageError, match=r"2 of 12 pixels .* first at \[1, 2\]") as error:
        check_image(image)
    one_line(error)
