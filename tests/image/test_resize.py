"""Images at other sizes: means, constants and edges stay; and images beside each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eigengs_dr.image.resize import center_crop, resample
from eigengs_dr.image.sheet import join_pictures, text_line

sizes = st.tuples(st.integers(1, 40), st.integers(1, 40))


@settings(deadline=None)
@given(start=sizes, end=sizes, value=st.floats(-0.5, 1.5, width=32), channels=st.integers(1, 4))
def test_resampling_keeps_constants(start, end, value, channels):
    image = np.full((*start, channels), value, np.float32)
    for result in (resample(image, *end), center_crop(image, *end)):
        assert result.dtype == np.float32 and result.shape == (end[1], end[0], channels)
        np.testing.assert_allclose(result, image[0, 0, 0], atol=1e-6)


@given(size=sizes)
def test_the_same_size_is_an_exact_copy(size):
    image = np.random.default_rng(0).normal(size=(*size, 3)).astype(np.float32)
    for result in (resample(image, *size[::-1]), center_crop(image, *size[::-1])):
        np.testing.assert_array_equal(result, image)
        assert not np.shares_memory(result, image)


def test_resampling_knows_rows_from_columns_and_channels_apart():
    ramp = np.linspace(0, 1, 30, dtype=np.float32)
    image = np.stack(np.meshgrid(ramp, ramp[:20]), axis=2)
    result = resample(image, 60, 10)
    assert np.ptp(result[:, 20, 0]) < 1e-5 and np.ptp(result[5, :, 1]) < 1e-5
    assert (np.diff(result[5, :, 0]) > 0).all() and (np.diff(result[:, 5, 1]) > 0).all()


def test_cropping_takes_the_centre_undistorted():
    image = np.random.default_rng(0).random((20, 31, 2)).astype(np.float32)
    part = resample(image[:, 5:25], 10, 10)  # whose filters see nothing beyond its edges
    inside = center_crop(image[:, :30], 10, 10)[:, 2:-2]
    np.testing.assert_allclose(inside, part[:, 2:-2], atol=1e-6)
    turned = center_crop(image.transpose(1, 0, 2), 7, 9)
    np.testing.assert_allclose(center_crop(image, 9, 7).transpose(1, 0, 2), turned, atol=1e-6)
    # An odd rest is cut off in halves of a pixel: mirroring changes nothing.
    np.testing.assert_allclose(
        center_crop(image[:, ::-1], 10, 10)[:, ::-1], center_crop(image, 10, 10), atol=1e-5
    )


@pytest.mark.parametrize("resize", [resample, center_crop])
@pytest.mark.parametrize("size", [(0, 4), (4, -1)])
def test_sizes_without_pixels_are_refused(resize, size):
    with pytest.raises(ValueError, match=r"^size is [^\n]*; both sides must be at least 1 pixel$"):
        resize(np.zeros((4, 4, 3), np.float32), *size)


def test_pictures_are_joined_on_white():
    joint = join_pictures([np.zeros((2, 3, 3)), np.zeros((4, 1, 3))], 1, gap=2)
    assert joint.shape == (4, 3 + 2 + 1 + 2, 3)
    black = joint.sum(axis=2) == 0
    assert black[:2, :3].all() and black[:, 5].all() and black.sum() == 10
    assert (joint[~black] == 1).all()


def test_a_line_holds_its_text():
    written = text_line("Agjpq", 200, 16)
    assert written.shape == (20, 200, 3)
    ink = np.argwhere(written.min(axis=2) < 0.5)
    assert ink.min() > 0 and ink[:, 0].max() < 19  # nothing is cut off below
    assert (text_line("", 200, 16) == 1).all()
