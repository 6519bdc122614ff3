"""PSNR against closed forms and scikit-image, by space, with and without weights."""

import math

import numpy as np
import pytest
from PIL import Image
from skimage import color, metrics

import eigengs_dr as eg
from _helpers.light import to_coded, to_linear


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def pu21(light):
    """Codes of the authors' program, where white has 100 cd/m^2, divided by that of white."""

    def code(luminance):
        power = np.clip(luminance, 0.005, 1e4) ** 0.9062562627
        curve = (0.353487901 + 0.3734658629 * power) / (1 + 8.277049286e-05 * power)
        return curve**0.09150303166 - 0.9099517204

    return code(100 * light) / code(100.0)


SPACES = {
    "rgb": lambda image: np.rint(np.clip(image, 0, 1) * 255) / 255,
    "ycbcr": lambda image: color.rgb2ycbcr(image) / 255,
    "data": lambda image: image,
    "pu21": lambda image: pu21(to_linear(image)),
}
"""What `psnr` compares, by the space."""


@pytest.mark.parametrize("layers", [None, 0, 1, 3])
@pytest.mark.parametrize("space", SPACES)
def test_squared_errors_are_weighed_in_a_space(rng, space, layers):
    """The picture has so many rows that it is compared in parts."""
    a, b = rng.random((2, 800, 700, 3))
    weight = None
    if layers is not None:
        weight = rng.uniform(0, 7, (800, 700, layers) if layers else (800, 700))
        weight[300:] = 0
    squares = np.square(SPACES[space](a) - SPACES[space](b))
    factors = None if weight is None else np.broadcast_to(np.atleast_3d(weight), squares.shape)
    expected = -10 * math.log10(np.average(squares, weights=factors))
    assert eg.psnr(a, b, space, weight) == pytest.approx(expected, abs=1e-5)
    if weight is not None:
        a[350:] = np.nan
        assert eg.psnr(a, b, space, weight) == pytest.approx(expected, abs=1e-5)


def test_values_are_those_of_scikit_image(rng):
    a, b = rng.random((9, 7, 3)), rng.random((9, 7, 3))
    bytes_a, bytes_b = (np.rint(255 * image).astype(np.uint8) for image in (a, b))
    assert eg.psnr(a, b) == pytest.approx(metrics.peak_signal_noise_ratio(bytes_a, bytes_b))
    beyond = rng.normal(size=(2, 9, 7, 1))  # of data nothing is clamped or rounded
    expected = metrics.peak_signal_noise_ratio(*beyond, data_range=1)
    assert eg.psnr(*beyond, "data") == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("space", SPACES)
def test_equal_images_and_nan(rng, space):
    image = rng.random((2, 2, 3))
    assert eg.psnr(image, image, space=space) == math.inf
    assert eg.psnr(image, image, space, np.ones((2, 2))) == math.inf
    assert math.isnan(eg.psnr(image, np.where(np.eye(2)[..., None], np.nan, image), space))


def test_rgb_sees_eight_bits_only():
    black = np.zeros((2, 2, 3))
    assert eg.psnr(black, black - 5) == math.inf
    assert eg.psnr(black, black + 0.49 / 255) == math.inf
    assert eg.psnr(black, black + 0.51 / 255) == pytest.approx(20 * math.log10(255))
    assert math.isfinite(eg.psnr(black, black - 5, space="ycbcr"))


def test_pu21_sees_light_above_white():
    light = np.full((4, 5, 3), 8.0)
    codes, brighter = to_coded(light), to_coded(1.1 * light)
    assert eg.psnr(codes, brighter, space="rgb") == np.inf  # both are white
    expected = -20 * np.log10(pu21(1.1 * light) - pu21(light))[0, 0, 0]
    assert eg.psnr(codes, brighter, space="pu21") == pytest.approx(expected)


def test_weights_of_grey_images_also_of_pillow(rng):
    a, b = rng.integers(0, 256, (2, 9, 7, 1), np.uint8)
    chosen = rng.random((9, 7, 1)) > 0.5
    squares = np.square(a / 255 - b / 255)[chosen]
    expected = -10 * math.log10(squares.mean())
    assert eg.psnr(a, b, "data", chosen) == pytest.approx(expected, abs=1e-6)
    images = [Image.fromarray(image[..., 0]) for image in (a, b)]
    assert eg.psnr(*images, "data", chosen) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_have_the_range_of_their_type(rng, dtype):
    peak = np.iinfo(dtype).max
    a, b = (rng.integers(0, peak, (40, 40, 3), dtype=dtype, endpoint=True) for _ in range(2))
    expected = metrics.peak_signal_noise_ratio(a, b, data_range=peak)
    assert eg.psnr(a, b, space="data") == pytest.approx(expected, abs=1e-6)
    for metric in (eg.psnr, eg.ssim, eg.ms_ssim):
        assert metric(a, b) == pytest.approx(metric(a / peak, b / peak), abs=1e-6)
        assert metric(a, b / peak) == pytest.approx(metric(a, b), abs=1e-6)
    assert eg.psnr(np.full((9, 9, 3), 10, dtype), np.full((9, 9, 3), peak, dtype)) < 1


# --- What is refused, also by the other metrics ---


@pytest.mark.parametrize("metric", [eg.psnr, eg.ssim, eg.ms_ssim])
def test_images_that_do_not_fit(metric):
    image = np.zeros((4, 4, 3))
    with pytest.raises(ValueError, match=r"shapes \(4, 4, 3\) and \(4, 5, 3\)"):
        metric(image, np.zeros((4, 5, 3)))
    for shape in ((4, 4), (4, 4, 2), (0, 4, 3)):
        with pytest.raises(ValueError, match="expected"):
            metric(np.zeros(shape), np.zeros(shape))
    for dtype in (np.int64, np.uint32, complex):
        with pytest.raises(ValueError, match="expected uint8, uint16 or floats"):
            metric(np.ones((12, 12, 3), dtype), np.ones((12, 12, 3), dtype))


def test_unknown_spaces():
    pair = np.zeros((2, 1, 1, 3))
    with pytest.raises(ValueError, match="use one of rgb, ycbcr, data, pu21"):
        eg.psnr(*pair, space="lab")
    with pytest.raises(ValueError, match="use 'ycbcr' or 'data'"):
        eg.ms_ssim(*pair, space="rgb")


@pytest.mark.parametrize("metric", [eg.psnr, eg.ssim])
@pytest.mark.parametrize(
    ("weight", "words"),
    [
        (np.zeros((20, 22)), "weight is 0 for all pixels; at least one must count"),
        (-np.eye(20, 22), "finite and at least 0"),
        (np.full((20, 22), np.nan), "finite and at least 0"),
        (np.ones(20), r"weight has shape \(20,\); expected"),
        (np.ones((22, 20)), r"weight has shape \(22, 20\), but the images have 22x20 pixels"),
        (np.ones((20, 22, 2)), r"have 3 channels; give \(H, W\), or \(H, W, 3\)"),
    ],
)
def test_weights_that_are_refused(rng, metric, weight, words):
    with pytest.raises(ValueError, match=words) as error:
        metric(*rng.random((2, 20, 22, 3)), weight=weight)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("metric", [eg.psnr, eg.ssim, eg.ms_ssim])
def test_a_path_is_refused(metric):
    with pytest.raises(TypeError, match=r"^a\.png: is a path; compare the pixels"):
        metric("a.png", np.zeros((200, 200, 3)))
