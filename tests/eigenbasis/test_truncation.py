"""How few components are enough for a family, and for images held out."""

import itertools
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import eigengs_dr as eg
from _helpers.families import family, fidelity, small_basis
from eigengs_dr.eigenbasis.truncation import (
    curve_from_eigenvalues,
    curve_from_residuals,
    min_ranks_per_channel,
    residual_energy,
)
from eigengs_dr.image.color import RGB_TO_YCBCR

SIDE, RANKS = 16, (5, 3, 1)


def low_rank(count, noise, seed):
    """RGB images that vary along few directions a channel, the same for every seed, and noise."""
    fixed, drawn = np.random.default_rng(0), np.random.default_rng(seed)
    images = np.full((count, SIDE, SIDE, 3), 0.5)
    for c, rank in enumerate(RANKS):
        rows = np.linalg.qr(fixed.normal(size=(SIDE**2, rank)))[0].T.reshape(rank, SIDE, SIDE)
        images[..., c] += np.tensordot(drawn.normal(0, 0.5, (count, rank)), rows, 1)
    return (images + noise * drawn.normal(size=images.shape)).astype(np.float32)


def test_held_out_images_tell_the_rank():
    """Noise of the training images alone is no reason to keep components of it."""
    basis = eg.Eigenbasis.from_images(
        low_rank(60, 1e-3, seed=1), (SIDE, SIDE), components=20, space="rgb"
    )
    assert [len(c) for c in basis.components] == [20] * 3
    fall = basis.truncation_curve(low_rank(20, 0, seed=2))
    assert fall.rank_for_psnr(50) == RANKS
    assert basis.truncated(RANKS).truncation_curve(low_rank(20, 0, seed=2)).psnr[-1] >= 50
    energy = eg.Eigenbasis.from_images(
        low_rank(60, 1e-4, seed=1), (SIDE, SIDE), energy=0.999, space="rgb"
    )
    assert tuple(map(len, energy.components)) == RANKS


def test_fall_is_what_truncated_bases_reach(others):
    basis = small_basis()
    fall = basis.truncation_curve(others)
    assert fall.counts[-1].tolist() == [12, 6, 6] and len(fall.psnr) == 25
    for n in (0, 1, 7, 24):
        few = basis.truncated(fall.counts[n])
        shown = [few.reconstruct(few.project(image)) for image in others]
        assert fall.psnr[n] == pytest.approx(fidelity(shown, others), abs=1e-3)


def test_fall_of_the_training_images():
    basis, fall = small_basis(), small_basis().truncation_curve()
    for n in (0, 5, 24):
        few = basis.truncated(fall.counts[n])
        shown = [few.reconstruct(few.project(image)) for image in family()]
        errors = (np.stack(shown) - family()) @ RGB_TO_YCBCR.T
        assert fall.psnr[n] == pytest.approx(-10 * np.log10(np.square(errors).mean()), abs=1e-3)
    held = sum(values.sum() for values in basis.eigenvalues) / basis.variance.sum()
    assert fall.explained_variance_ratio()[0] == 0
    assert fall.explained_variance_ratio()[-1] == pytest.approx(held)


spectra = st.lists(st.floats(0, 9), max_size=6).map(lambda v: np.array(sorted(v, reverse=True)))


@given(st.tuples(spectra, spectra, spectra))
@settings(max_examples=50, deadline=None)
def test_components_come_by_falling_eigenvalue(eigenvalues):
    fall = curve_from_eigenvalues(eigenvalues, np.array([v.sum() + 1 for v in eigenvalues]), 10)
    steps = np.diff(fall.counts, axis=0)
    assert (steps.sum(axis=1) == 1).all() and (steps >= 0).all()
    assert fall.counts[-1].tolist() == [len(v) for v in eigenvalues]
    gains = -np.diff(10 ** (-fall.psnr / 10)) * 10
    np.testing.assert_allclose(gains, np.sort(np.concatenate(eigenvalues))[::-1], atol=1e-9)


@given(
    st.tuples(*[hnp.arrays(float, st.integers(0, 4), elements=st.floats(0, 5)) for _ in "abc"]),
    st.floats(1, 30),
)
@settings(max_examples=60, deadline=None)
def test_no_fewer_components_do(gains, target):
    left = [residual_energy(values.sum() + 0.1, values) for values in gains]
    allowed = 7 * 10 ** (-target / 10)
    ways = itertools.product(*[range(len(rows)) for rows in left])
    enough = [w for w in ways if left[0][w[0]] + left[1][w[1]] + left[2][w[2]] <= allowed - 1e-9]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = min_ranks_per_channel(left, 7, target)
    if enough:
        assert sum(found) <= min(map(sum, enough))
        assert sum(rows[k] for rows, k in zip(left, found, strict=True)) <= allowed + 1e-9
    else:
        reached = sum(rows[k] for rows, k in zip(left, found, strict=True))
        assert reached <= allowed + 1e-9 or found == tuple(map(len, gains))


def test_components_that_add_nothing_are_left_out():
    none = np.zeros(1)
    assert min_ranks_per_channel([np.array([2, 1, 1, 0.5]), none, none], 10, 10) == (1, 0, 0)


def test_targets_out_of_reach_are_told(others):
    fall = small_basis().truncation_curve(others)
    with pytest.warns(UserWarning, match=r"90 dB is out of reach: all 12\+6\+6 components reach"):
        assert fall.rank_for_psnr(90) == (12, 6, 6)
    for target in (0, -3, np.nan, np.inf):
        with pytest.raises(ValueError, match="target_psnr is"):
            fall.rank_for_psnr(target)
    with pytest.raises(ValueError, match="no images"):
        small_basis().truncation_curve([])


def test_no_components_at_all():
    fall = curve_from_residuals([np.zeros(0)] * 3, [np.array([2.0])] * 3, 6)
    assert fall.counts.tolist() == [[0, 0, 0]] and fall.psnr.tolist() == [0]
    assert eg.Eigenbasis.from_images(family(1), (32, 32), 0).truncation_curve().psnr.tolist() == [
        120
    ]
