"""The peaks of an error, beside a plain search by NumPy and SciPy."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import correlate1d, maximum_filter

from _helpers.sets import few
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.fitting.placement.filters import TRUNCATION
from eigengs_dr.fitting.placement.peaks import (
    CANDIDATE_SIZES,
    SUPPRESSION_RADIUS,
    residual_peaks,
)
from eigengs_dr.raster.binning.tiles import Grid
from eigengs_dr.raster.render import batch_to_tiles, to_tiles


def found_peaks(missed, count, spacing, weight=None, backend="llvm"):
    types, grid = types_in(select(backend)), Grid(missed.shape[1], missed.shape[0])
    squares = None if weight is None else to_tiles(types, np.square(weight, dtype=np.float32), grid)
    image = to_tiles(types, missed.astype(np.float32), grid)
    return to_numpy(residual_peaks(image, grid, missed.shape[2], count, spacing, squares))


def to_numpy(peaks):
    """Mean (n, 2), size (n,) and colour (n, C)."""
    return SimpleNamespace(
        mean=peaks.mean.numpy().T,
        size=peaks.size.numpy(),
        color=np.stack([row.numpy() for row in peaks.color], axis=1),
    )


def plain_peaks(missed, spacing, weight=None):
    """Mean, size, colour and gain of all peaks, the best first."""
    factor = np.ones_like(missed) if weight is None else np.square(weight)
    gain, size = np.zeros(missed.shape[:2]), np.zeros(missed.shape[:2])
    color = np.zeros_like(missed)
    for deviation in np.multiply(CANDIDATE_SIZES, spacing):
        radius = max(1, int(np.ceil(TRUNCATION * deviation)))
        taps = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / deviation))
        along = correlate1d(correlate1d(missed, taps, 0, mode="constant"), taps, 1, mode="constant")
        own = np.square(taps).sum() ** 2
        total = (np.square(along) * factor).sum(axis=2) / own
        better = total > gain
        gain[better], size[better], color[better] = total[better], deviation, along[better] / own
    y, x = np.nonzero((gain == maximum_filter(gain, 3, mode="constant")) & (gain > 0))
    own, reach = gain[y, x], np.ceil(SUPPRESSION_RADIUS * size[y, x])
    away = np.maximum(np.abs(x - x[:, None]), np.abs(y - y[:, None]))
    stays = ~((away <= reach[:, None]) & (own[:, None] > own)).any(axis=0)
    order = np.flatnonzero(stays)[np.argsort(-own[stays])]
    y, x = y[order], x[order]
    return np.stack([x + 0.5, y + 0.5], axis=1), size[y, x], color[y, x], gain[y, x]


@few
@given(
    height=st.integers(1, 30),
    width=st.integers(1, 30),
    channels=st.integers(1, 4),
    spacing=st.floats(0.8, 5.9),
    weighted=st.booleans(),
)
def test_peaks_are_those_of_a_plain_search(backend, height, width, channels, spacing, weighted):
    """On sizes that whole tiles do not fill too; rounding may exchange peaks of equal gain."""
    generator = np.random.default_rng(height * width)
    missed = generator.normal(size=(height, width, channels))
    weight = generator.uniform(0.5, 2, missed.shape) if weighted else None
    mean, size, color, gain = plain_peaks(missed, spacing, weight)
    found = found_peaks(missed, len(mean), spacing, weight, backend)
    assert abs(len(found.mean) - len(mean)) <= 1 + len(mean) // 20
    place = {tuple(row): k for k, row in enumerate(mean.tolist())}
    same = [(k, place[tuple(row)]) for k, row in enumerate(found.mean) if tuple(row) in place]
    assert len(same) >= 0.9 * len(mean) - 1
    ours, plain = np.array(same).T.reshape(2, -1)
    equal = np.isclose(found.size[ours], size[plain])
    assert equal.mean() > 0.9 if len(equal) > 10 else True
    np.testing.assert_allclose(
        found.color[ours[equal]], color[plain[equal]], rtol=1e-3, atol=1e-3 * np.abs(color).max()
    )
    assert (np.diff(gain[plain]) <= 1e-3 * gain[0]).all()  # the best first


@pytest.mark.parametrize("deviation", [4.5, 1.5, 0.6])
def test_the_gain_of_a_place_is_what_a_gaussian_takes(backend, deviation):
    """Of a residual that is one round Gaussian of a tried size, also where it is below a pixel."""
    y, x = np.indices((64, 64)) + 0.5
    alone = 0.7 * np.exp(-((x - 32.5) ** 2 + (y - 30.5) ** 2) / (2 * deviation**2))
    found = found_peaks(alone[..., None], 1, deviation / CANDIDATE_SIZES[-1], backend=backend)
    np.testing.assert_allclose(found.mean, [[32.5, 30.5]])
    np.testing.assert_allclose(found.size, [deviation], rtol=1e-6)
    np.testing.assert_allclose(found.color, [[0.7]], rtol=0.01)


def test_a_wide_gaussian_is_found_on_a_smaller_image(backend):
    y, x = np.indices((101, 90)) + 0.5
    alone = 0.7 * np.exp(-((x - 39) ** 2 + (y - 57) ** 2) / (2 * 12.0**2))
    missed = np.stack([alone, 0 * alone, -alone], axis=2)
    found = found_peaks(missed, 1, 12.0 / CANDIDATE_SIZES[-1], backend=backend)
    np.testing.assert_allclose(found.mean, [[39, 57]], atol=2)
    np.testing.assert_allclose(found.size, [12.0], rtol=1e-6)
    np.testing.assert_allclose(found.color, [[0.7, 0, -0.7]], atol=0.02)


@given(st.integers(0, 40))
def test_places_keep_apart_and_never_exceed(count):
    missed = np.random.default_rng(count).normal(size=(24, 20, 3))
    found = found_peaks(missed, count, 4.0)
    mean, size = found.mean, found.size
    assert len(mean) == len(size) == len(found.color) <= count
    for k in range(len(mean)):
        away = np.abs(mean[k + 1 :] - mean[k]).max(axis=1)
        assert (away > np.ceil(SUPPRESSION_RADIUS * size[k])).all()


def test_an_image_without_error_has_no_peaks(backend):
    found = found_peaks(np.zeros((9, 14, 3)), 5, 3.0, backend=backend)
    assert len(found.mean) == len(found.size) == len(found.color) == 0


def test_each_image_of_a_batch_has_its_own_peaks(backend):
    """Those that it has alone, bit for bit: a neighbour in memory is no neighbour in space."""
    missed = np.random.default_rng(2).normal(size=(3, 22, 17, 2)).astype(np.float32)
    missed[1] = 0
    types, grid = types_in(select(backend)), Grid(17, 22, images=3)
    for spacing in (2.5, 7.0):
        found = residual_peaks(batch_to_tiles(types, missed), grid, 2, 9, spacing)
        together, image = to_numpy(found), found.image.numpy()
        for k in range(3):
            alone = found_peaks(missed[k], 9, spacing, backend=backend)
            for name in ("mean", "size", "color"):
                np.testing.assert_array_equal(
                    getattr(together, name)[image == k], getattr(alone, name)
                )
            ranks = found.rank.numpy()[image == k]
            np.testing.assert_array_equal(ranks, np.arange(len(alone.size)))
