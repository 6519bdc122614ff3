"""SSIM of tensors against scikit-image, finite differences in float64, and SSIM of NumPy arrays."""

import drjit as dr
import numpy as np
import pytest
from skimage.metrics import structural_similarity

import eigengs_dr as eg
from _helpers.kernels import jit, launches
from eigengs_dr.backend.arrays import _types, upload
from eigengs_dr.backend.selection import select

SETTINGS = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
SHAPES = [(11, 11, 1), (11, 40, 3), (12, 13, 3), (37, 19, 2), (64, 70, 1), (61, 48, 3)]
SMALL = [(1, 1, 3), (2, 9, 1), (10, 30, 3), (7, 6, 3)]
EXACT = {32: 2e-6, 64: 1e-12}


def pictures(shape, seed=0):
    """Two random pictures that have something in common, in [0.1, 0.9]."""
    first, second = np.random.default_rng(seed).uniform(0.1, 0.9, (2, *shape))
    return first, 0.7 * first + 0.3 * second


def tensor(types, values):
    return upload(types.Tensor, np.ascontiguousarray(values))


def similarities(a, b):
    """SSIM of all windows inside, by scikit-image: (H - 10, W - 10, C)."""
    return structural_similarity(a, b, channel_axis=2, full=True, **SETTINGS)[1][5:-5, 5:-5]


def value_of(result):
    assert dr.width(result) == 1
    assert dr.depth_v(result) == 1
    return float(result[0])


@pytest.fixture
def double(backend):
    return _types(select(backend).__name__, 64)


# --- Values ---


@pytest.mark.parametrize("shape", SHAPES)
def test_equals_scikit_image(types, shape):
    a, b = pictures(shape)
    found = eg.ssim(tensor(types, a), tensor(types, b))
    assert type(found) is types.Float
    assert value_of(found) == pytest.approx(similarities(a, b).mean(), abs=EXACT[types.bits])


@pytest.mark.parametrize("shape", SMALL)
def test_small_pictures_have_smaller_windows(types, shape):
    a, b = pictures(shape)
    found = eg.ssim(tensor(types, a), tensor(types, b))
    assert value_of(found) == pytest.approx(eg.ssim(a, b), abs=EXACT[types.bits])


def test_values_are_not_clamped(double):
    a, b = (3 * v - 1 for v in pictures((20, 21, 3)))
    found = value_of(eg.ssim(tensor(double, a), tensor(double, b)))
    assert found == pytest.approx(similarities(a, b).mean(), abs=1e-12)
    assert abs(found - eg.ssim(a, b)) > 1e-3


def test_one_picture_may_be_an_array(types):
    a, b = pictures((30, 20, 3))
    codes = np.rint(a * 255).astype(np.uint8)
    for pair in ((codes, tensor(types, b)), (tensor(types, b), codes)):
        found = value_of(eg.ssim(*pair))
        assert found == pytest.approx(similarities(codes / 255, b).mean(), abs=EXACT[types.bits])


def test_the_finer_precision_counts(backend):
    single, double = (_types(select(backend).__name__, bits) for bits in (32, 64))
    a, b = (tensor(t, v) for t, v in zip((single, double), pictures((16, 16, 1)), strict=True))
    dr.enable_grad(a)
    found = eg.ssim(a, b)
    assert type(found) is double.Float
    dr.backward(found)
    assert type(dr.grad(a)) is single.Tensor
    assert np.abs(dr.grad(a).numpy()).max() > 1e-4


def test_equal_runs_give_equal_bits(types):
    def run():
        a, b = (tensor(types, v) for v in pictures((50, 60, 3)))
        dr.enable_grad(a)
        found = eg.ssim(a, b)
        dr.backward(found)
        return found.numpy().tobytes(), dr.grad(a).numpy().tobytes()

    assert run() == run()


# --- Derivatives ---


def slope(function, *moves, step=1e-5):
    """Central difference of a function of several arrays along moves of all of them."""
    up, down = (function(*(s * step * move for move in moves)) for s in (1, -1))
    return (up - down) / (2 * step)


@pytest.mark.parametrize("shape", [(11, 12, 1), (14, 11, 3), (5, 6, 1)])
@pytest.mark.parametrize("weighted", [False, True])
def test_reverse_mode_equals_finite_differences(double, shape, weighted):
    a, b = pictures(shape, 1)
    weight = np.random.default_rng(2).uniform(0, 3, shape) if weighted else None
    leaves = [tensor(double, v) for v in (a, b)]
    dr.enable_grad(leaves)
    dr.backward(-2 * eg.ssim(*leaves, weight))
    for number, leaf in enumerate(leaves):
        found = dr.grad(leaf).numpy()
        for place in [*np.ndindex(shape)][::5]:
            moves = np.zeros((2, *shape))
            moves[(number, *place)] = 1
            expected = slope(lambda u, v: -2 * eg.ssim(a + u, b + v, weight), *moves)
            assert found[place] == pytest.approx(expected, abs=1e-8, rel=1e-6)


@pytest.mark.parametrize("wanted", [(1, 0), (0, 1), (1, 1)])
@pytest.mark.parametrize("shape", [(31, 30, 3), (20, 41, 1)])
def test_both_modes_equal_finite_differences(double, shape, wanted):
    a, b = pictures(shape, 3)
    moves = np.random.default_rng(4).normal(size=(2, *shape)) * np.reshape(wanted, (2, 1, 1, 1))
    expected = slope(lambda u, v: eg.ssim(a + u, b + v), *moves)

    def leaves():
        found = [tensor(double, v) for v in (a, b)]
        for leaf, want in zip(found, wanted, strict=True):
            dr.set_grad_enabled(leaf, bool(want))
        return found

    forward = leaves()
    for leaf, move in zip(forward, moves, strict=True):
        if dr.grad_enabled(leaf):
            dr.set_grad(leaf, tensor(double, move))
    found = eg.ssim(*forward)
    dr.forward_to(found)
    assert value_of(dr.grad(found)) == pytest.approx(expected, rel=1e-6)

    backward = leaves()
    dr.backward(eg.ssim(*backward))
    total = sum((dr.grad(t).numpy() * m).sum() for t, m in zip(backward, moves, strict=True))
    assert total == pytest.approx(expected, rel=1e-6)


def test_single_precision_has_the_derivatives_of_double(backend):
    a, b = pictures((48, 40, 3), 5)
    found = []
    for bits in (32, 64):
        types = _types(select(backend).__name__, bits)
        leaf = tensor(types, a)
        dr.enable_grad(leaf)
        dr.backward(eg.ssim(leaf, tensor(types, b)))
        found.append(dr.grad(leaf).numpy())
    np.testing.assert_allclose(found[0], found[1], atol=1e-4 * np.abs(found[1]).max())


def test_derivatives_pass_on_and_add_up(double):
    """The pictures depend on a number, twice; an array beside them has no part in it."""
    a, b = (tensor(double, v) for v in pictures((16, 15, 3)))
    number, other = double.Float(0.8), double.Float(3)
    dr.enable_grad(number, other)
    beside = dr.square(other)
    loss = dr.mean(dr.square(number * a - b), axis=None) - eg.ssim(number * a, b + 0.1 * number)
    dr.backward(loss)

    def exact(u):
        x, y = ((0.8 + u) * a.numpy(), b.numpy())
        return np.square(x - y).mean() - eg.ssim(x, y + 0.1 * (0.8 + u))

    assert dr.grad(number)[0] == pytest.approx(slope(exact, 1.0), rel=1e-6)
    assert dr.grad(other)[0] == 0
    dr.backward(beside)
    assert dr.grad(other)[0] == 6


def test_a_picture_equals_itself(types):
    a = tensor(types, pictures((20, 20, 3))[0])
    dr.enable_grad(a)
    found = eg.ssim(a, a)
    dr.backward(found)
    assert value_of(found) == pytest.approx(1, abs=1e-6)
    assert np.abs(dr.grad(a).numpy()).max() < 1e-4 / 1200


def test_a_loss_of_ssim_brings_a_rendering_closer(backend):
    image = eg.sample("coffee")[100:140, 200:240]
    start = eg.fit(image, 40, 0, space="rgb", backend=backend).gaussians
    target = upload(type(eg.render(start)), image)
    before = value_of(eg.ssim(eg.render(start), target))
    dr.enable_grad(start.color)
    dr.backward(eg.ssim(eg.render(start), target))
    gradient = dr.grad(start.color)
    length = dr.sqrt(dr.sum(dr.sum(dr.square(gradient)))[0])
    start.color = dr.detach(start.color) + gradient * (0.05 / float(length))
    assert value_of(eg.ssim(eg.render(start), target)) > before


# --- Frozen functions ---


def test_frozen_functions_follow_their_arguments(types):
    @dr.freeze
    def step(a, b, weight):
        leaf = type(a)(a)
        dr.enable_grad(leaf)
        found = eg.ssim(leaf, b, weight)
        dr.backward(found)
        return found, dr.grad(leaf)

    for seed, shape in enumerate([(23, 30, 3)] * 3 + [(30, 25, 3)] * 2):
        a, b = (tensor(types, v) for v in pictures(shape, seed))
        weight = tensor(types, np.random.default_rng(seed).uniform(0, 1, shape[:2]))
        found, gradient = step(a, b, weight)
        leaf = type(a)(a)
        dr.enable_grad(leaf)
        expected = eg.ssim(leaf, b, weight)
        dr.backward(expected)
        assert value_of(found) == pytest.approx(value_of(expected), abs=1e-6)
        np.testing.assert_allclose(gradient.numpy(), dr.grad(leaf).numpy(), atol=1e-8)
    assert step.n_recordings == 2


def test_one_program_serves_all_sizes(types):
    def run(shape):
        a, b = (tensor(types, v) for v in pictures(shape))
        dr.enable_grad(a)
        dr.eval(dr.backward(eg.ssim(a, b)), dr.grad(a))

    run((40, 30, 3))
    with launches() as launched:
        for shape in ((40, 30, 3), (31, 55, 1)):
            run(shape)
    hashes = [kernel.hash for kernel in jit(launched)]
    half = len(hashes) // 2
    assert half >= 4
    assert hashes[:half] == hashes[half:]


# --- Weights ---


@pytest.mark.parametrize("layers", [0, 1, 3])
def test_weights_are_factors_of_windows(types, layers):
    a, b = pictures((26, 33, 3))
    weight = np.random.default_rng(6).uniform(0, 5, (26, 33, layers) if layers else (26, 33))
    weight[:, 20:] = 0
    inside = np.broadcast_to(np.atleast_3d(weight)[5:-5, 5:-5], (16, 23, 3))
    expected = np.average(similarities(a, b), weights=inside)
    assert eg.ssim(a, b, weight) == pytest.approx(expected, abs=1e-6)
    pair = [tensor(types, v) for v in (a, b)]
    exact = 2e-6 if types.bits == 32 else 1e-6  # weights in arrays have single precision
    assert value_of(eg.ssim(*pair, weight)) == pytest.approx(expected, abs=exact)
    found = value_of(eg.ssim(*pair, tensor(types, weight)))
    assert found == pytest.approx(expected, abs=EXACT[types.bits])


def test_windows_without_weight_do_not_count(types):
    a, b = pictures((30, 40, 1))
    weight = np.ones((30, 40))
    weight[:, 24:] = 0
    expected = eg.ssim(a[:, :29], b[:, :29])
    a[:, 30:] = np.nan
    assert eg.ssim(a, b, weight) == pytest.approx(expected, abs=1e-6)
    pair = [tensor(types, v) for v in (a, b)]
    assert value_of(eg.ssim(*pair, weight)) == pytest.approx(expected, abs=2e-6)
    a[0, 28] = np.nan  # in a window that counts
    assert np.isnan(eg.ssim(a, b, weight))
    assert np.isnan(value_of(eg.ssim(tensor(types, a), pair[1], weight)))


@pytest.mark.parametrize(
    ("weight", "words"),
    [
        (np.zeros((20, 22)), "weight is 0 for all pixels; at least one must count"),
        (-np.eye(20, 22), "finite and at least 0"),
        (np.full((20, 22), np.nan), "finite and at least 0"),
        (np.ones(20), r"weight has shape \(20,\); expected"),
        (np.ones((22, 20)), r"weight has shape \(22, 20\), but the images have 22x20 pixels"),
        (np.ones((20, 22, 2)), r"have 3 channels; give \(H, W\), or \(H, W, 3\)"),
        (np.pad(np.zeros((10, 12)), 5, constant_values=1), "weight is 0 for all windows"),
    ],
)
def test_weights_that_are_refused(backend, weight, words):
    types = _types(select(backend).__name__, 32)
    pair = pictures((20, 22, 3))
    for images in (pair, [tensor(types, v) for v in pair]):
        with pytest.raises(ValueError, match=words) as error:
            eg.ssim(*images, weight=weight)
        assert "\n" not in str(error.value)
    if "have" in words:
        with pytest.raises(ValueError, match=words):
            eg.ssim(*images, weight=tensor(types, weight))


def test_tensors_that_are_refused(types):
    a, b = (tensor(types, np.zeros(shape)) for shape in ((12, 12, 3), (12, 13, 3)))
    with pytest.raises(ValueError, match=r"shapes \(12, 12, 3\) and \(12, 13, 3\)"):
        eg.ssim(a, b)
    for shape in ((12, 12), (0, 4, 3)):
        a = tensor(types, np.zeros(shape))
        with pytest.raises(ValueError, match=r"expected \(H, W, C\), not empty"):
            eg.ssim(a, a)
    huge = dr.zeros(types.Tensor, (20000, 20000, 3))  # takes no memory
    with pytest.raises(ValueError, match="20000x20000 pixels and 3 channels are too large"):
        eg.ssim(huge, huge)
