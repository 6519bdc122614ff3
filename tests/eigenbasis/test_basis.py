"""The eigenbasis: against scikit-learn, in one block and in many, on families of every kind."""

import warnings
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from _helpers.errors import one_line
from _helpers.low_rank import HEIGHT, PIXELS, SIZE, WIDTH, basis_of, family, planes
from eigengs_dr.eigenbasis.basis import Eigenbasis
from eigengs_dr.eigenbasis.incremental import empty_state, merge
from eigengs_dr.image.io import ImageError
from eigengs_dr.image.resize import resample


def exact(images, space="ycbcr"):
    """PCA by scikit-learn in double precision, one for each channel."""
    from sklearn.decomposition import PCA  # here, because it takes a second

    data = planes(images, space).astype(np.float64)
    return [PCA(svd_solver="full").fit(data[:, c]) for c in range(3)]


def subspace_angle(a, b):
    """Largest angle, in radians, between the spans of orthonormal rows."""
    a, b = (np.linalg.qr(rows.astype(np.float64).T)[0] for rows in (a, b))
    return np.linalg.norm(a - b @ (b.T @ a), 2)


def flat(components):
    return components.reshape(len(components), components.shape[1] * components.shape[2])


def assert_orthonormal(basis):
    for components in basis.components:
        rows = flat(components).astype(np.float64)
        np.testing.assert_allclose(rows @ rows.T, np.eye(len(rows)), rtol=0, atol=1e-5)


def check_exact(basis, images, angle):
    """Check a basis of as many components a channel as it was asked for."""
    assert_orthonormal(basis)
    for c, reference in enumerate(exact(images, basis.space)):
        rows = flat(basis.components[c])
        # scikit-learn divides by m - 1, the paper by m.
        variances = reference.explained_variance_ * (1 - 1 / len(images))
        np.testing.assert_allclose(basis.mean[c].ravel(), reference.mean_, rtol=0, atol=1e-7)
        np.testing.assert_allclose(basis.eigenvalues[c], variances[: len(rows)], rtol=1e-5)
        np.testing.assert_allclose(basis.variance[c], variances.sum(), rtol=1e-6)
        assert subspace_angle(rows, reference.components_[: len(rows)]) < angle


def psnr_of(basis, images):
    errors = [basis.reconstruct(basis.project(image)) - image for image in images]
    return -10 * np.log10(np.mean(np.square(errors)))


# ---------------------------------------------------------------- against scikit-learn


@pytest.mark.parametrize("space", ["ycbcr", "rgb"])
def test_one_block_is_exact(space):
    images = family()
    basis = Eigenbasis.from_images(images, SIZE, 12, space=space)
    assert (basis.width, basis.height, len(basis.components)) == (*SIZE, 3)
    assert (basis.count, basis.space) == (60, space)
    assert basis.mean.dtype == basis.components[0].dtype == np.float32
    assert basis.eigenvalues[0].dtype == basis.variance.dtype == np.float64
    check_exact(basis, images, 1e-4)
    for c, reference in enumerate(exact(images, space)):
        for ours, theirs in zip(flat(basis.components[c]), reference.components_, strict=False):
            assert abs(ours @ theirs) > 1 - 1e-6


@pytest.mark.parametrize(("length", "shard"), [(1, 60), (7, 60), (25, 60), (59, 60), (7, 17)])
def test_blocks_and_shards_are_exact_while_the_rank_suffices(blocks_of, length, shard):
    images = family(noise=0, directions=8)
    blocks_of(length, shard)
    basis = Eigenbasis.from_images(images, SIZE, 8)
    check_exact(basis, images, 1e-3)


def test_blocks_lose_little_where_the_rank_does_not_suffice(blocks_of):
    images = family(count=400, directions=60, noise=0.01)
    whole = Eigenbasis.from_images(images, SIZE, 20)
    blocks_of(50)
    parts = Eigenbasis.from_images(images, SIZE, 20)
    assert_orthonormal(parts)
    np.testing.assert_allclose(parts.variance, whole.variance, rtol=1e-6)
    np.testing.assert_allclose(parts.mean, whole.mean, atol=1e-6)
    for a, b in zip(parts.eigenvalues, whole.eigenvalues, strict=True):
        np.testing.assert_allclose(a, b, rtol=0.2)
        np.testing.assert_allclose(a[:10], b[:10], rtol=1e-3)
        assert (a <= b * (1 + 1e-6)).all()  # a subspace cannot hold more than the best one
    others = family(count=50, directions=60, noise=0.01, seed=0)
    assert psnr_of(whole, others) - psnr_of(parts, others) < 0.05


# ---------------------------------------------------------------- families of every kind


def test_energy_keeps_as_few_as_hold_it():
    images = family()
    full = Eigenbasis.from_images(images, SIZE, 59)
    for shares in full.energy():
        assert (np.diff(shares) >= 0).all() and shares[-1] == pytest.approx(1, abs=1e-5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        basis = Eigenbasis.from_images(images, SIZE, energy=0.9)
    for shares, all_shares in zip(basis.energy(), full.energy(), strict=True):
        k = len(shares)
        assert shares[-1] >= 0.9 and (k == 1 or shares[-2] < 0.9)
        np.testing.assert_allclose(shares, all_shares[:k], rtol=1e-6)


def test_energy_beyond_the_cap_is_told_by_channel():
    with pytest.warns(UserWarning) as caught:
        basis = Eigenbasis.from_images(family(), SIZE, (3, 59, 59), energy=0.99)
    (message,) = (str(w.message) for w in caught)
    share = basis.energy()[0][-1]
    assert message == (
        f"channel Y: 3 components hold {share:.2%} of the variance, less than 99.00%; "
        "raise components"
    )
    assert len(basis.components[0]) == 3 < len(basis.components[1])


def test_all_energy_can_be_had():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        basis = Eigenbasis.from_images(family(20, noise=0, directions=5), SIZE, energy=1)
    assert [len(c) for c in basis.components] == [5, 5, 5]


def test_truncated_is_what_fewer_components_give():
    images = family()
    basis = Eigenbasis.from_images(images, SIZE, 12)
    few = basis.truncated((5, 3, 100))
    assert [len(c) for c in few.components] == [len(e) for e in few.eigenvalues] == [5, 3, 12]
    np.testing.assert_array_equal(few.components[1], basis.components[1][:3])
    np.testing.assert_array_equal(few.variance, basis.variance)
    assert [len(c) for c in basis.truncated(0).components] == [0, 0, 0]
    for three in (np.int64(3), [3, 3, 3], np.array([3, 3, 3])):
        assert [len(c) for c in basis.truncated(three).components] == [3, 3, 3]


def test_grey_images_have_no_chroma_components():
    grey = family()[..., :1].repeat(3, axis=3)
    basis = Eigenbasis.from_images(grey, SIZE, 5)
    assert [len(c) for c in basis.components] == [5, 0, 0]
    np.testing.assert_allclose(basis.mean[1:], 128 / 255, atol=1e-6)
    result = basis.reconstruct(basis.project(grey[0]))
    np.testing.assert_allclose(result, result[..., :1].repeat(3, axis=2), atol=1e-5)


@pytest.mark.parametrize("length", [7, 1024])
@pytest.mark.parametrize(("count", "copies"), [(1, 1), (12, 1), (1, 50), (5, 10)])
def test_few_images_are_spanned(blocks_of, length, count, copies):
    """Directions of copies that are nothing but rounding are not taken for components."""
    images = np.tile(family(count), (copies, 1, 1, 1))
    blocks_of(length)
    told = pytest.warns(UserWarning, match=f"{count} images? gives? at most {count - 1} components")
    with told if copies == 1 else nullcontext():
        basis = Eigenbasis.from_images(images, SIZE, 20)
    assert [len(c) for c in basis.components] == [len(e) for e in basis.energy()] == [count - 1] * 3
    assert_orthonormal(basis)
    for image in images[:count]:
        np.testing.assert_allclose(basis.reconstruct(basis.project(image)), image, atol=5e-5)


# ---------------------------------------------------------------- projecting


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_projecting_twice_is_projecting_once_and_brings_no_image_away(seed):
    basis = basis_of("rgb")
    image = np.random.default_rng(seed).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    once = basis.reconstruct(basis.project(image))
    np.testing.assert_allclose(basis.reconstruct(basis.project(once)), once, atol=2e-5)
    mean = np.moveaxis(basis.mean, 0, 2)
    left, moved = np.sum((image - once) ** 2), np.sum((once - mean) ** 2)
    assert left + moved == pytest.approx(np.sum((image - mean) ** 2), rel=1e-4)  # Pythagoras


def test_images_of_any_size_and_type_are_projected():
    basis = basis_of("ycbcr")
    large = resample(family(1)[0], 50, 60)
    fitting = resample(large, WIDTH, HEIGHT)
    for a, b in zip(basis.project(large), basis.project(fitting), strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(basis.project(np.zeros((4, 4), np.uint8))[0]) == 12
    with pytest.raises(ImageError, match="not finite"):
        basis.project(np.full((4, 4), np.nan))


def test_coefficients_of_another_basis_are_refused():
    for weights in ([np.zeros(12)] * 3, [np.zeros(12)], [np.zeros((12, 1)), np.zeros(5), 0]):
        with pytest.raises(ValueError, match="coefficients have shapes") as error:
            basis_of("rgb").reconstruct(weights)
        one_line(error)


def test_rows_stay_orthonormal_when_variances_differ_much():
    """What rounding mixes into small components is as large as they are."""
    rng = np.random.default_rng(0)
    spread = np.logspace(-1, -4.5, 30)
    directions = np.linalg.qr(rng.normal(size=(PIXELS, 30)))[0].T * np.sqrt(PIXELS)
    images = 0.5 + (rng.normal(size=(200, 30)) * spread) @ directions
    state = empty_state(SIZE)
    for block in np.split(images.astype(np.float32), 8):
        state = merge(state, block, 40)
        overlap = state.rows.astype(np.float64) @ state.rows.T.astype(np.float64)
        assert np.abs(overlap - np.eye(len(state.rows))).max() < 1e-5
