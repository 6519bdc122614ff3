"""SSIM and MS-SSIM of arrays and tensors, and derivatives, against SciPy in double precision."""

import drjit as dr
import numpy as np
import pytest
from scipy.ndimage import correlate1d
from skimage import color
from skimage.metrics import structural_similarity

import eigengs_dr as eg
from _helpers.arrays import upload_rows

SHAPES = [(11, 40, 3), (37, 19, 2), (64, 70, 1)]
SMALL = [(1, 1, 3), (2, 9, 1), (5, 6, 1)]
EXACT = {32: 2e-6, 64: 1e-12}


def pictures(shape, seed=0):
    """Two random pictures that have something in common, in [0.1, 0.9]."""
    first, second = np.random.default_rng(seed).uniform(0.1, 0.9, (2, *shape))
    return first, 0.7 * first + 0.3 * second


def terms(a, b):
    """SSIM of all windows inside, (H', W', C), and its contrast-structure term."""
    radius = min(5, (min(a.shape[:2]) - 1) // 2)
    taps = np.exp(-np.square(np.arange(-radius, radius + 1)) / (2 * 1.5**2))
    inside = slice(radius, -radius or None)

    def mean(image):
        for axis in (0, 1):
            image = correlate1d(image, taps / taps.sum(), axis)
        return image[inside, inside]

    mean_a, mean_b = mean(a), mean(b)
    luminance = (2 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2)
    covariance = mean(a * b) - mean_a * mean_b
    variances = mean(a * a + b * b) - mean_a**2 - mean_b**2
    structure = (2 * covariance + 0.03**2) / (variances + 0.03**2)
    return luminance * structure, structure


def exact(a, b, weight=None):
    """SSIM by the formulas of the paper, not clamped; weighted by the pixels of window centres."""
    similar = terms(a, b)[0]
    if weight is not None:
        radius = (len(weight) - len(similar)) // 2
        inside = slice(radius, -radius or None)
        weight = np.broadcast_to(np.atleast_3d(weight)[inside, inside], similar.shape)
    return np.average(similar, weights=weight)


def tensor(backend, bits, values):
    module, suffix = getattr(dr, backend).ad, "64" if bits == 64 else ""
    values = np.ascontiguousarray(values)
    [flat] = upload_rows(getattr(module, "Float" + suffix), [values.ravel()])
    return getattr(module, "TensorXf" + suffix)(flat, values.shape)


def value_of(result):
    assert dr.width(result) == 1 and dr.depth_v(result) == 1
    return float(result[0])


# --- Values ---


def test_the_oracle_is_scikit_image():
    a, b = pictures((40, 30, 3))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    found = structural_similarity(a, b, channel_axis=2, full=True, data_range=1, **settings)[1]
    np.testing.assert_allclose(terms(a, b)[0], found[5:-5, 5:-5], rtol=1e-10)


@pytest.mark.parametrize(
    ("shape", "bits"), [*((s, 32) for s in SHAPES[1:]), *((s, 64) for s in SHAPES[:1] + SMALL)]
)
def test_values(backend, bits, shape):
    """Small pictures have smaller windows; arrays are compared in double precision."""
    a, b = pictures(shape)
    expected = exact(a, b)
    found = eg.ssim(tensor(backend, bits, a), tensor(backend, bits, b))
    assert value_of(found) == pytest.approx(expected, abs=EXACT[bits])
    if shape[2] != 2:
        assert eg.ssim(a, b) == pytest.approx(expected, abs=1e-12)
        assert eg.ssim(a, a) == pytest.approx(1, abs=1e-12)


def test_large_arrays_are_compared_in_parts():
    a, b = (v.astype(np.float32) for v in pictures((800, 700, 1)))
    assert eg.ssim(a, b) == pytest.approx(exact(*np.float64([a, b])), abs=1e-6)


def test_arrays_are_clamped_and_tensors_are_not(backend):
    a = np.zeros((12, 12, 3))
    assert eg.ssim(a, a - 3) == pytest.approx(1) == eg.ssim(a + 1, a + 4)
    a, b = (3 * v - 1 for v in pictures((20, 21, 3)))
    found = value_of(eg.ssim(tensor(backend, 64, a), tensor(backend, 64, b)))
    assert found == pytest.approx(exact(a, b), abs=1e-12)
    assert eg.ssim(a, b) == pytest.approx(exact(a.clip(0, 1), b.clip(0, 1)), abs=1e-12)


def test_one_picture_may_be_an_array_or_of_another_precision(backend):
    a, b = pictures((30, 20, 3))
    mixed = eg.ssim(tensor(backend, 32, a), tensor(backend, 64, b))
    assert type(mixed) is getattr(dr, backend).ad.Float64
    assert value_of(mixed) == pytest.approx(exact(np.float64(np.float32(a)), b), abs=1e-12)
    codes = np.rint(a * 255).astype(np.uint8)
    for pair in ((codes, tensor(backend, 32, b)), (tensor(backend, 32, b), codes)):
        assert value_of(eg.ssim(*pair)) == pytest.approx(exact(codes / 255, b), abs=2e-6)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (12, 40), (45, 50), (176, 180)])
def test_ms_ssim_is_its_definition(size):
    a, b = pictures((*size, 3))
    y, x = np.mgrid[: size[0], : size[1]][..., None] / 9
    a, b = (0.5 * v + 0.2 * np.sin(x + [0, 1, 2] * y) + 0.1 for v in (a, b))
    scales = max(1, sum(min(size) >> j >= 11 for j in range(5)))
    weights = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])
    weights = weights[:scales] / weights[:scales].sum() * weights.sum()
    planes, product = [color.rgb2ycbcr(image) / 255 for image in (a, b)], 1
    for scale, weight in enumerate(weights):
        means = [term.mean(axis=(0, 1)) for term in terms(*planes)]
        product = product * np.maximum(means[0 if scale == scales - 1 else 1], 0) ** weight
        even = [z[: z.shape[0] // 2 * 2, : z.shape[1] // 2 * 2] for z in planes]
        planes = [sum(z[i::2, j::2] for i in (0, 1) for j in (0, 1)) / 4 for z in even]
    assert eg.ms_ssim(a, b) == pytest.approx(product.mean(), abs=1e-12)
    assert eg.ms_ssim(a, a) == pytest.approx(1, abs=1e-12)


def test_ms_ssim_by_space_and_of_grey():
    a, b = pictures((48, 48, 3))
    each = [eg.ms_ssim(a[..., [k]], b[..., [k]], "data") for k in range(3)]
    assert eg.ms_ssim(a, b, "data") == pytest.approx(np.mean(each))
    assert eg.ms_ssim(a, 1 - a) == 0  # a negative correlation counts as none
    for metric in (eg.psnr, eg.ssim, eg.ms_ssim):
        grey = a[..., :1], b[..., :1]
        assert metric(*grey) == pytest.approx(metric(*(np.repeat(v, 3, axis=2) for v in grey)))


# --- Derivatives ---


def slope(function, *moves, step=1e-5):
    """Central difference of a function of several arrays along moves of all of them."""
    up, down = (function(*(s * step * move for move in moves)) for s in (1, -1))
    return (up - down) / (2 * step)


@pytest.mark.parametrize(("shape", "weighted"), [((14, 11, 3), True), ((5, 6, 1), False)])
def test_every_derivative_is_a_finite_difference(backend, shape, weighted):
    a, b = pictures(shape, 1)
    weight = np.random.default_rng(2).uniform(0, 3, shape).astype(np.float32) if weighted else None
    leaves = [tensor(backend, 64, v) for v in (a, b)]
    dr.enable_grad(leaves)
    dr.backward(-2 * eg.ssim(*leaves, weight))
    for number, leaf in enumerate(leaves):
        found = dr.grad(leaf).numpy()
        for place in np.ndindex(shape):
            moves = np.zeros((2, *shape))
            moves[(number, *place)] = 1
            expected = slope(lambda u, v: -2 * exact(a + u, b + v, weight), *moves)
            assert found[place] == pytest.approx(expected, abs=1e-8, rel=1e-6)


def test_the_derivative_along_a_move_is_a_finite_difference(backend):
    a, b = pictures((31, 30, 3), 3)
    moves = np.random.default_rng(4).normal(size=(2, *a.shape))
    leaves = [tensor(backend, 64, v) for v in (a, b)]
    dr.enable_grad(leaves)
    for leaf, move in zip(leaves, moves, strict=True):
        dr.set_grad(leaf, tensor(backend, 64, move))
    found = eg.ssim(*leaves)
    dr.forward_to(found)
    expected = slope(lambda u, v: exact(a + u, b + v), *moves)
    assert value_of(dr.grad(found)) == pytest.approx(expected, rel=1e-6)


def test_single_precision_has_the_derivatives_of_double_in_every_run(backend):
    a, b = pictures((31, 30, 3), 5)

    def gradient(bits):
        leaf = tensor(backend, bits, a)
        dr.enable_grad(leaf)
        dr.backward(eg.ssim(leaf, tensor(backend, bits, b)))
        return dr.grad(leaf).numpy()

    single, double = gradient(32), gradient(64)
    np.testing.assert_allclose(single, double, atol=1e-4 * np.abs(double).max())
    np.testing.assert_array_equal(gradient(32), single)


def test_derivatives_pass_on_and_add_up(backend):
    """The pictures depend on a number, twice; an array beside them has no part in it."""
    a, b = (tensor(backend, 64, v) for v in pictures((16, 15, 3)))
    Double = getattr(dr, backend).ad.Float64
    number, other = Double(0.8), Double(3)
    dr.enable_grad(number, other)
    beside = dr.square(other)
    loss = dr.mean(dr.square(number * a - b), axis=None) - eg.ssim(number * a, b + 0.1 * number)
    dr.backward(loss)

    def loss_of(u):
        x, y = (0.8 + u) * a.numpy(), b.numpy()
        return np.square(x - y).mean() - exact(x, y + 0.1 * (0.8 + u))

    assert dr.grad(number)[0] == pytest.approx(slope(loss_of, 1.0), rel=1e-6)
    assert dr.grad(other)[0] == 0
    dr.backward(beside)
    assert dr.grad(other)[0] == 6


def test_frozen_functions_follow_their_arguments(backend):
    @dr.freeze
    def step(a, b, weight):
        leaf = type(a)(a)
        dr.enable_grad(leaf)
        found = eg.ssim(leaf, b, weight)
        dr.backward(found)
        return found, dr.grad(leaf)

    for seed, shape in enumerate([(23, 30, 3)] * 2 + [(30, 25, 3)] * 2):
        a, b = (tensor(backend, 32, v) for v in pictures(shape, seed))
        weight = tensor(backend, 32, np.random.default_rng(seed).uniform(0, 1, shape[:2]))
        found, gradient = step(a, b, weight)
        leaf = type(a)(a)
        dr.enable_grad(leaf)
        expected = eg.ssim(leaf, b, weight)
        dr.backward(expected)
        assert value_of(found) == pytest.approx(value_of(expected), abs=1e-6)
        np.testing.assert_allclose(gradient.numpy(), dr.grad(leaf).numpy(), atol=1e-8)
    assert step.n_recordings == 2


# --- Weights ---


@pytest.mark.parametrize("layers", [0, pytest.param(1, marks=pytest.mark.slow), 3])
def test_weights_are_factors_of_windows(backend, layers):
    a, b = pictures((26, 33, 3))
    weight = np.random.default_rng(6).uniform(0, 5, (26, 33, layers) if layers else (26, 33))
    weight[:, 20:] = 0
    expected = exact(a, b, weight)
    assert eg.ssim(a, b, weight) == pytest.approx(expected, abs=1e-6)
    pair = [tensor(backend, 32, v) for v in (a, b)]
    for given in (weight, tensor(backend, 32, weight)):
        assert value_of(eg.ssim(*pair, given)) == pytest.approx(expected, abs=2e-6)


def test_windows_without_weight_do_not_count(backend):
    a, b = pictures((30, 40, 1))
    weight = np.ones((30, 40))
    weight[:, 24:] = 0
    expected = exact(a[:, :29], b[:, :29])
    a[:, 30:] = np.nan
    pair = [tensor(backend, 32, v) for v in (a, b)]
    assert eg.ssim(a, b, weight) == pytest.approx(expected, abs=1e-6)
    assert value_of(eg.ssim(*pair, weight)) == pytest.approx(expected, abs=2e-6)
    a[0, 28] = np.nan  # in a window that counts
    assert np.isnan(eg.ssim(a, b, weight))
    assert np.isnan(value_of(eg.ssim(tensor(backend, 32, a), pair[1], weight)))


def test_what_is_refused_of_tensors(backend):
    """What is refused of arrays stands beside PSNR."""
    a, b = (tensor(backend, 32, v) for v in pictures((20, 22, 3)))
    with pytest.raises(ValueError, match="weight is 0 for all windows"):
        eg.ssim(a, b, np.pad(np.zeros((10, 12)), 5, constant_values=1))
    with pytest.raises(ValueError, match=r"have 3 channels; give \(H, W\), or \(H, W, 3\)"):
        eg.ssim(a, b, tensor(backend, 32, np.ones((20, 22, 2))))
    with pytest.raises(ValueError, match=r"shapes \(20, 22, 3\) and \(12, 13, 3\)"):
        eg.ssim(a, tensor(backend, 32, np.zeros((12, 13, 3))))
    for shape in ((12, 12), (0, 4, 3)):
        empty = dr.zeros(type(a), shape)
        with pytest.raises(ValueError, match=r"expected \(H, W, C\), not empty"):
            eg.ssim(empty, empty)
    huge = dr.zeros(type(a), (20000, 20000, 3))  # takes no memory
    with pytest.raises(ValueError, match="20000x20000 pixels and 3 channels are too large"):
        eg.ssim(huge, huge)
