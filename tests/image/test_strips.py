"""Strips of rows, and threads."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from eigengs_dr.image import strips as module
from eigengs_dr.image.metrics import blur, gaussian_taps, psnr
from eigengs_dr.image.strips import map_threads, strips


def test_strips_cover_an_image_once():
    for height, width in ((1, 1), (1000, 3000), (3, 1 << 20)):
        rows = np.concatenate([np.arange(s.start, s.stop) for s in strips(height, width)])
        np.testing.assert_array_equal(rows, np.arange(height))


def test_threads_keep_the_order_and_raise_the_first_error():
    assert map_threads(lambda x: x * x, range(20)) == [x * x for x in range(20)]
    with pytest.raises(ZeroDivisionError):
        map_threads(lambda x: 1 // x, [1, 0, 2])


def test_blur_is_that_of_scipy():
    image = np.random.default_rng(0).random((40, 30)).astype(np.float32)
    expected = gaussian_filter(image, 1.7, mode="constant")[7:-7, 7:-7]
    np.testing.assert_allclose(blur(image, gaussian_taps(1.7)), expected, atol=1e-6)


def test_results_do_not_depend_on_strips_or_threads(monkeypatch):
    image = np.random.default_rng(1).random((70, 90, 3)).astype(np.float32)
    figure = psnr(image, image[::-1], "ycbcr")
    monkeypatch.setattr(module, "STRIP_PIXELS", 900)
    for cores in (1, 3):
        monkeypatch.setattr(module, "available_cores", lambda cores=cores: cores)
        assert psnr(image, image[::-1], "ycbcr") == pytest.approx(figure, abs=1e-9)
