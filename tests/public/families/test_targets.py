"""How few components are enough: for a family, for images held out, and for one image."""

import numpy as np
import pytest
from skimage.color import rgb2ycbcr

import eigengs_dr as eg
from _helpers.families import family, fidelity, small_basis, small_model, splits

SIDE, RANKS = 16, (5, 3, 1)
OTHERS = family(8, seed=1)
"""Images of the family of `small_basis` that it was not made of."""


def low_rank(count, noise, seed):
    """RGB images that vary along few directions a channel, the same for every seed, and noise."""
    fixed, drawn = np.random.default_rng(0), np.random.default_rng(seed)
    images = np.full((count, SIDE, SIDE, 3), 0.5)
    for c, rank in enumerate(RANKS):
        rows = np.linalg.qr(fixed.normal(size=(SIDE**2, rank)))[0].T.reshape(rank, SIDE, SIDE)
        images[..., c] += np.tensordot(drawn.normal(0, 0.5, (count, rank)), rows, 1)
    return (images + noise * drawn.normal(size=images.shape)).astype(np.float32)


# --- Bases ---


def test_held_out_images_tell_the_rank():
    """Noise of the training images alone is no reason to keep components of it."""
    basis = eg.Eigenbasis.from_images(low_rank(60, 1e-3, 1), (SIDE, SIDE), 20, space="rgb")
    assert [len(c) for c in basis.components] == [20] * 3
    held_out = low_rank(20, 0, seed=2)
    assert basis.truncation_curve(held_out).rank_for_psnr(50) == RANKS
    assert basis.truncated(RANKS).truncation_curve(held_out).psnr[-1] >= 50
    energy = eg.Eigenbasis.from_images(
        low_rank(60, 1e-4, seed=1), (SIDE, SIDE), energy=0.999, space="rgb"
    )
    assert tuple(map(len, energy.components)) == RANKS


@pytest.mark.parametrize("images", [OTHERS, None], ids=["others", "training images"])
def test_the_curve_is_what_truncated_bases_reach(images):
    basis = small_basis()
    curve = basis.truncation_curve(images)
    assert curve.counts[-1].tolist() == [12, 6, 6] and len(curve.psnr) == 25
    seen = family() if images is None else images
    for n in (0, 1, 7, 24):
        few = basis.truncated(curve.counts[n])
        shown = np.stack([few.reconstruct(few.project(image)) for image in seen])
        if images is None:  # of all images together, by the eigenvalues
            errors = np.square(rgb2ycbcr(shown) - rgb2ycbcr(seen)) / 255**2
            expected = -10 * np.log10(errors.mean())
        else:
            expected = fidelity(shown, seen)
        assert curve.psnr[n] == pytest.approx(expected, abs=1e-3)


def test_components_come_by_falling_eigenvalue():
    basis = small_basis()
    curve = basis.truncation_curve()
    steps = np.diff(curve.counts, axis=0)
    assert (steps.sum(axis=1) == 1).all() and (steps >= 0).all()
    gains = -np.diff(10 ** (-curve.psnr / 10)) * basis.mean.size
    expected = np.sort(np.concatenate(basis.eigenvalues))[::-1]
    np.testing.assert_allclose(gains, expected, rtol=1e-6)
    ratio = curve.explained_variance_ratio()
    assert ratio[0] == 0
    assert ratio[-1] == pytest.approx(expected.sum() / basis.variance.sum())


def test_targets_out_of_reach_are_told():
    curve = small_basis().truncation_curve(OTHERS)
    with pytest.warns(UserWarning, match=r"90 dB is out of reach: all 12\+6\+6 components reach"):
        assert curve.rank_for_psnr(90) == (12, 6, 6)
    for target in (0, -3, np.nan, np.inf):
        with pytest.raises(ValueError, match="target_psnr is"):
            curve.rank_for_psnr(target)
    with pytest.raises(ValueError, match="no images"):
        small_basis().truncation_curve([])
    none = eg.Eigenbasis.from_images(family(1), (32, 32), 0).truncation_curve()
    assert none.counts.tolist() == [[0, 0, 0]] and none.psnr.tolist() == [120]


# --- Images ---


def shown(model, coefficients):
    return eg.render(model.reconstruct(coefficients)).numpy()


def truncated(model, counts):
    weights = tuple(w[:k] for w, k in zip(model.weights, counts, strict=True))
    values = tuple(v[:k] for v, k in zip(model.eigenvalues, counts, strict=True))
    return eg.EigenGS(model.gaussians, weights, values, model.mean_image, model.low)


@splits
def test_an_image_meets_a_bound_with_the_fewest(backend, split):
    model, target = small_model(backend, split), 22
    for image in OTHERS[:2]:
        found = model.project(image, target)
        assert eg.psnr(image, shown(model, found), "ycbcr") >= target - 1e-3
        counts = [len(w) for w in found]
        assert sum(counts) < sum(model.components)
        for c in np.flatnonzero(counts):
            fewer = [k - (i == c) for i, k in enumerate(counts)]
            best = truncated(model, fewer).project(image)
            assert eg.psnr(image, shown(model, best), "ycbcr") < target + 1e-3
        alone = truncated(model, counts).project(image)
        np.testing.assert_allclose(np.concatenate(found), np.concatenate(alone), atol=1e-4)


def test_an_image_of_a_subspace_needs_no_more(backend):
    model = small_model(backend)
    only = (np.array([0.0, 0.9], np.float32), np.zeros(0), np.array([0.5], np.float32))
    found = model.project(shown(model, only), 55)
    assert [len(w) for w in found] == [2, 0, 1]
    np.testing.assert_allclose(np.concatenate(found), np.concatenate(only), atol=2e-3)
    assert [len(w) for w in model.project(shown(model, (only[1],) * 3), 55)] == [0, 0, 0]


def test_wrong_or_unmet_bounds(backend):
    model = small_model(backend)
    with pytest.raises(ValueError, match="colors 'projected'"):
        model.encode(OTHERS[0], target_psnr=24)
    for target in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="target_psnr is"):
            model.project(OTHERS[0], target)
    with pytest.warns(UserWarning, match=r"out of reach: all 12\+6\+6 components reach 2\d\."):
        found = model.project(OTHERS[0], 60)
    every = np.concatenate(model.project(OTHERS[0]))
    np.testing.assert_allclose(np.concatenate(found), every, atol=1e-5)
