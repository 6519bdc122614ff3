"""Metrics against closed forms, scikit-image and slow computations written another way."""

import math

import numpy as np
import pytest
from PIL import Image
from scipy.signal import correlate2d
from skimage import color, metrics

from eigengs_dr.image.color import to_coded, to_linear, to_pu21
from eigengs_dr.image.metrics import ms_ssim, psnr, ssim

SIZES = [(1, 1), (1, 9), (2, 3), (10, 11), (12, 40), (23, 22), (45, 50)]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def picture(rng, height=48, width=48):
    """Make a smooth random picture, whose contrast survives averaging."""
    y, x = np.mgrid[:height, :width][..., None] / 9
    waves = 2 * np.pi * rng.random((3, 3))
    return 0.5 + 0.3 * np.sin(x * waves[0] + y * waves[1] + waves[2])


def noisy(rng, image, sigma):
    return image + sigma * rng.standard_normal(image.shape)


@pytest.mark.parametrize("space", ["rgb", "ycbcr"])
def test_psnr_of_equal_images_and_of_nan(rng, space):
    image = rng.random((2, 2, 3))
    assert psnr(image, image, space=space) == math.inf
    assert math.isnan(psnr(image, np.where(np.eye(2)[..., None] > 0, np.nan, image), space))


SPACES = {
    "rgb": lambda image: np.rint(np.clip(image, 0, 1) * 255) / 255,
    "ycbcr": lambda image: color.rgb2ycbcr(image) / 255,
    "data": lambda image: image,
    "pu21": lambda image: to_pu21(to_linear(image)),
}
"""What `psnr` compares, by the space."""


@pytest.fixture
def small_strips(monkeypatch):
    """70 rows of 90 pixels make two strips."""
    monkeypatch.setattr("eigengs_dr.image.strips.STRIP_PIXELS", 1 << 12)


@pytest.mark.parametrize("layers", [0, 1, 3])
@pytest.mark.parametrize("space", SPACES)
def test_psnr_weighs_squared_errors_in_its_space(rng, small_strips, space, layers):
    a, b = rng.random((2, 70, 90, 3))
    weight = rng.uniform(0, 7, (70, 90, layers) if layers else (70, 90))
    weight[20:] *= rng.random(50)[(slice(None),) + (None,) * (weight.ndim - 1)] > 0.5
    squares = np.square(SPACES[space](a) - SPACES[space](b))
    factors = np.broadcast_to(np.atleast_3d(weight), squares.shape)
    expected = -10 * math.log10(np.average(squares, weights=factors))
    assert psnr(a, b, space, weight) == pytest.approx(expected, abs=1e-5)
    a[~weight.reshape(70, 90, -1).any(axis=2)] = np.nan
    assert psnr(a, b, space, weight) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("space", SPACES)
def test_equal_weights_are_no_weights(rng, space):
    a, b = rng.random((2, 30, 20, 3))
    assert psnr(a, b, space, np.full((30, 20), 3)) == pytest.approx(psnr(a, b, space), abs=1e-6)
    assert ssim(a, b, np.full((30, 20), 3)) == pytest.approx(ssim(a, b), abs=1e-7)
    assert psnr(a, a, space, weight=np.ones((30, 20))) == math.inf


def test_weights_of_pillow_images_are_those_of_their_pixels(rng):
    a, b = rng.integers(0, 256, (2, 30, 20, 4), np.uint8)
    weight = rng.random((30, 20, 3))
    for mode in ("L", "RGB"):
        x, y = (Image.fromarray(image[..., :3]).convert(mode) for image in (a, b))
        arrays = [np.atleast_3d(np.asarray(image)) for image in (x, y)]
        given = weight[..., : arrays[0].shape[2]]
        for measure in (psnr, ssim):
            assert measure(x, y, weight=given) == measure(*arrays, weight=given)
    opaque = np.dstack([a[..., :3], np.full((30, 20), 255, np.uint8)])
    shown = Image.fromarray(opaque), Image.fromarray(b[..., :3])
    assert psnr(*shown, weight=weight) == psnr(a[..., :3], b[..., :3], weight=weight)


def test_psnr_of_grey_images_takes_weights(rng):
    a, b = rng.random((2, 9, 7, 1))
    weight = rng.random((9, 7, 1)) > 0.5
    expected = -10 * math.log10(np.square(a - b)[weight].mean())
    assert psnr(a, b, "data", weight) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("weight", "words"),
    [
        (np.zeros((4, 5)), "weight is 0 for all pixels; at least one must count"),
        (-np.eye(4, 5), "finite and at least 0"),
        (np.full((4, 5), np.inf), "finite and at least 0"),
        (np.ones((5, 4)), r"weight has shape \(5, 4\), but the images have 5x4 pixels"),
        (np.ones((4, 5, 4)), r"have 3 channels; give \(H, W\), or \(H, W, 3\)"),
        (1.0, r"weight has shape \(\); expected"),
    ],
)
def test_weights_that_psnr_refuses(rng, weight, words):
    with pytest.raises(ValueError, match=words) as error:
        psnr(*rng.random((2, 4, 5, 3)), weight=weight)
    assert "\n" not in str(error.value)


def test_psnr_rgb_sees_eight_bits_only():
    black = np.zeros((2, 2, 3))
    assert psnr(black, black - 5) == math.inf
    assert psnr(black, black + 0.49 / 255) == math.inf
    assert psnr(black, black + 0.51 / 255) == pytest.approx(20 * math.log10(255))
    assert math.isfinite(psnr(black, black - 5, space="ycbcr"))


def test_psnr_equals_scikit_image(rng):
    a, b = rng.random((9, 7, 3)), rng.random((9, 7, 3))
    bytes_a, bytes_b = (np.rint(255 * image).astype(np.uint8) for image in (a, b))
    assert psnr(a, b) == pytest.approx(metrics.peak_signal_noise_ratio(bytes_a, bytes_b))
    ycbcr_a, ycbcr_b = (color.rgb2ycbcr(image) / 255 for image in (a, b))
    expected = metrics.peak_signal_noise_ratio(ycbcr_a, ycbcr_b, data_range=1)
    assert psnr(a, b, space="ycbcr") == pytest.approx(expected)
    beyond = rng.normal(size=(2, 9, 7, 1))  # of data nothing is clamped or rounded
    expected = metrics.peak_signal_noise_ratio(*beyond, data_range=1)
    assert psnr(*beyond, "data") == pytest.approx(expected, abs=1e-12)


def test_sums_of_several_strips_equal_scikit_image(rng, small_strips):
    a = picture(rng, 70, 90).astype(np.float32)
    b = np.clip(noisy(rng, a, 0.05), 0, 1).astype(np.float32)
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = metrics.structural_similarity(a, b, data_range=1, channel_axis=2, **settings)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)
    a, b = a.astype(np.float64), b.astype(np.float64)
    expected = metrics.peak_signal_noise_ratio(a, b, data_range=1)
    assert psnr(a, b, "data") == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("metric", [ssim, ms_ssim])
def test_similarity_of_any_size(rng, metric, size):
    a, b = rng.random((*size, 3)), rng.random((*size, 3))
    assert metric(a, a) == pytest.approx(1, abs=1e-12)
    assert metric(a, b) < 1
    assert metric(a, b) == pytest.approx(metric(b, a), abs=1e-12)


def test_ssim_of_constant_images_is_the_luminance_term():
    a, b = np.full((16, 16, 3), 0.2), np.full((16, 16, 3), 0.6)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-9)
    assert ssim(a[:1, :1], b[:1, :1]) == pytest.approx(expected, abs=1e-9)


def test_ssim_sees_clamped_images():
    a = np.zeros((12, 12, 3))
    assert ssim(a, a - 3) == pytest.approx(1) == ssim(a + 1, a + 4)


@pytest.mark.parametrize(
    ("size", "scales"), [((11, 12), 1), ((22, 30), 2), ((45, 47), 3), ((176, 180), 5)]
)
def test_ms_ssim_equals_its_definition(rng, size, scales):
    a = picture(rng, *size)
    b = noisy(rng, a, 0.1)
    assert ms_ssim(a, b) == pytest.approx(slow_ms_ssim(a, b, scales), abs=1e-12)


def test_ms_ssim_takes_negative_correlation_as_zero(rng):
    image = picture(rng)
    assert ms_ssim(image, 1 - image) == 0


@pytest.mark.parametrize("metric", [psnr, ssim, ms_ssim])
def test_refuses_images_that_do_not_fit(metric):
    image = np.zeros((4, 4, 3))
    with pytest.raises(ValueError, match=r"shapes \(4, 4, 3\) and \(4, 5, 3\)"):
        metric(image, np.zeros((4, 5, 3)))
    for shape in ((4, 4), (4, 4, 2), (0, 4, 3)):
        with pytest.raises(ValueError, match="expected"):
            metric(np.zeros(shape), np.zeros(shape))


def test_refuses_an_unknown_space():
    pair = np.zeros((2, 1, 1, 3))
    with pytest.raises(ValueError, match="use one of rgb, ycbcr, data, pu21"):
        psnr(*pair, space="lab")
    with pytest.raises(ValueError, match="use 'ycbcr' or 'data'"):
        ms_ssim(*pair, space="rgb")


@pytest.mark.parametrize("metric", [psnr, ssim, ms_ssim])
def test_one_channel_is_grey(metric):
    grey = np.random.default_rng(0).uniform(0, 1, (2, 24, 24, 1))
    assert metric(*grey) == pytest.approx(metric(*np.repeat(grey, 3, axis=3)))


def test_ms_ssim_of_data_is_that_of_its_channels():
    a, b = np.random.default_rng(0).uniform(0, 1, (2, 48, 48, 3))
    each = [ms_ssim(a[..., [k]], b[..., [k]], "data") for k in range(3)]
    assert ms_ssim(a, b, "data") == pytest.approx(np.mean(each))
    assert ms_ssim(a, a, "data") == 1


def gaussian_window(size):
    """Make the two-dimensional window in one go, where the package filters rows, then columns."""
    y, x = np.mgrid[:size, :size] - size // 2
    window = np.exp(-(x**2 + y**2) / (2 * 1.5**2))
    return window / window.sum()


def similarity_maps(x, y, window):
    """SSIM and its contrast-structure term at every pixel, by the formulas of the 2004 paper."""

    def mean(image):
        return correlate2d(image, window, mode="valid")

    mean_x, mean_y = mean(x), mean(y)
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
    covariance = mean(x * y) - mean_x * mean_y
    variances = mean(x * x) - mean_x**2 + mean(y * y) - mean_y**2
    structure = (2 * covariance + 0.03**2) / (variances + 0.03**2)
    return luminance * structure, structure


def slow_ms_ssim(a, b, scales):
    weights = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])
    weights = weights[:scales] / weights[:scales].sum() * weights.sum()
    values = []
    for channel in range(3):
        x, y = (color.rgb2ycbcr(image)[..., channel] / 255 for image in (a, b))
        value = 1.0
        for scale, weight in enumerate(weights):
            whole, structure = similarity_maps(x, y, gaussian_window(11))
            term = whole if scale == scales - 1 else structure
            value *= max(term.mean(), 0) ** weight
            rows, columns = x.shape[0] // 2 * 2, x.shape[1] // 2 * 2
            x, y = (
                sum(z[i:rows:2, j:columns:2] for i in (0, 1) for j in (0, 1)) / 4 for z in (x, y)
            )
        values.append(value)
    return np.mean(values)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_have_the_range_of_their_type(rng, dtype):
    most = np.iinfo(dtype).max
    a, b = (rng.integers(0, most, (40, 40, 3), dtype=dtype, endpoint=True) for _ in range(2))
    assert psnr(a, b, space="data") == pytest.approx(
        metrics.peak_signal_noise_ratio(a, b, data_range=most), abs=1e-6
    )
    for metric in (psnr, ssim, ms_ssim):
        assert metric(a, b) == pytest.approx(metric(a / most, b / most), abs=1e-6)
        assert metric(a, b / most) == pytest.approx(metric(a, b), abs=1e-6)
    assert psnr(np.full((9, 9, 3), 10, dtype), np.full((9, 9, 3), most, dtype)) < 1


@pytest.mark.parametrize("dtype", [np.int64, np.uint32, complex])
@pytest.mark.parametrize("metric", [psnr, ssim, ms_ssim])
def test_other_numbers_are_refused(metric, dtype):
    with pytest.raises(ValueError, match="expected uint8, uint16 or floats"):
        metric(np.ones((12, 12, 3), dtype), np.ones((12, 12, 3), dtype))


def test_psnr_in_pu21():
    light = np.full((4, 5, 3), 8.0)
    brighter = light * 1.1
    assert psnr(to_coded(light), to_coded(brighter), space="rgb") == np.inf  # both are white
    found = psnr(to_coded(light), to_coded(brighter), space="pu21")
    expected = -20 * np.log10(to_pu21(brighter) - to_pu21(light))[0, 0, 0]
    assert found == pytest.approx(expected)
