"""Strips of rows, their borders, and threads."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from eigengs_dr.fitting.placement.adaptive import place_adaptive
from eigengs_dr.image import strips as module
from eigengs_dr.image.metrics import blur, gaussian_taps, psnr
from eigengs_dr.image.strips import map_threads, strips, with_border


def test_strips_cover_an_image_once():
    for height, width in ((1, 1), (1000, 3000), (3, 1 << 20)):
        rows = np.concatenate([np.arange(s.start, s.stop) for s in strips(height, width)])
        np.testing.assert_array_equal(rows, np.arange(height))


def test_threads_keep_the_order_and_raise_the_first_error():
    assert map_threads(lambda x: x * x, range(20)) == [x * x for x in range(20)]
    with pytest.raises(ZeroDivisionError):
        map_threads(lambda x: 1 // x, [1, 0, 2])


@pytest.mark.parametrize("mode", ["symmetric", "constant"])
@pytest.mark.parametrize("height", [2, 9, 40])
def test_blur_in_strips_is_that_of_scipy(mode, height):
    """Also with a border wider than the image."""
    image = np.random.default_rng(0).random((height, 30)).astype(np.float32)
    taps = gaussian_taps(1.7)
    parts = [
        blur(
            with_border(lambda rows: image[rows], slice(y, min(y + 4, height)), height, 7, mode),
            taps,
        )
        for y in range(0, height, 4)
    ]
    expected = gaussian_filter(image, 1.7, mode={"symmetric": "reflect"}.get(mode, mode))
    np.testing.assert_allclose(np.concatenate(parts), expected, atol=1e-6)


def test_results_do_not_depend_on_strips_or_threads(monkeypatch):
    image = np.random.default_rng(1).random((70, 90, 3)).astype(np.float32)
    expected = place_adaptive(image, 500)
    figure = psnr(image, image[::-1], "ycbcr")
    monkeypatch.setattr(module, "STRIP_PIXELS", 900)
    found = []
    for cores in (1, 3):
        monkeypatch.setattr(module, "available_cores", lambda cores=cores: cores)
        found.append(place_adaptive(image, 500))
        assert psnr(image, image[::-1], "ycbcr") == pytest.approx(figure, abs=1e-9)
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])
    # Only the order of sums changes with the strips.
    np.testing.assert_allclose(found[0][0], expected[0], atol=1e-3)
    np.testing.assert_allclose(found[0][1], expected[1], rtol=1e-3, atol=1e-6)
