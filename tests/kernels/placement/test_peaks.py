"""The peaks of an error, beside a plain search by NumPy and SciPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import correlate1d, maximum_filter

from _helpers.sets import few
from _oracles.tiles import to_tiles
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.fitting.peaks import RADIUS, SIZE, Canvas, residual_peaks


def found_peaks(missed, count, weight, backend):
    """Mean (n, 2) and colour (n, C), for an error (H, W, C) and its weights."""
    curvature = np.ones((*missed.shape[:-1], 1)) if weight is None else weight
    curvature = curvature.astype(np.float32)
    slope, grid = to_tiles(missed * curvature, backend)
    types = types_of(slope)
    canvas = Canvas(types, grid, grid.in_arrays(types))
    peaks = residual_peaks(canvas, slope, to_tiles(curvature, backend)[0], count)
    return peaks.mean.numpy().T, np.stack([row.numpy() for row in peaks.color], axis=1)


def plain_peaks(missed, weight):
    """Mean and colour of all peaks, the best first."""
    taps = np.exp(-0.5 * np.square(np.arange(-RADIUS, RADIUS + 1) / SIZE))
    weight = np.ones_like(missed) if weight is None else weight + 0 * missed
    slope = missed.astype(float) * weight
    for axis in (0, 1):
        slope = correlate1d(slope, taps, axis, mode="constant") / np.square(taps).sum()
    color = np.where(weight > 0, slope / np.where(weight > 0, weight, 1), 0)
    gain = (color * slope * (weight > 0)).sum(axis=2)
    y, x = np.nonzero((gain == maximum_filter(gain, 3, mode="constant")) & (gain > 0))
    order = np.argsort(-gain[y, x])
    y, x = y[order], x[order]
    return np.stack([x + 0.5, y + 0.5], axis=1), color[y, x]


@few
@given(
    height=st.integers(1, 30),
    width=st.integers(1, 30),
    channels=st.sampled_from([1, 3]),
    share=st.sampled_from([0, 0.3, 1]),
    layers=st.integers(0, 2),
)
def test_peaks_are_those_of_a_plain_search(backend, height, width, channels, share, layers):
    """On layout that whole tiles do not fill too; weights of pixels or channels, a third of them 0.

    Rounding may exchange peaks of equal gain.
    """
    generator, weight = np.random.default_rng(1), None
    missed = generator.normal(size=(height, width, channels)).astype(np.float32)
    if layers:
        shape = (height, width, (1, channels)[layers - 1])
        weight = generator.uniform(0.5, 2, shape) * (generator.uniform(0, 1, shape) > 1 / 3)
        weight = weight.astype(np.float32)
    mean, color = plain_peaks(missed, weight)
    count = int(share * len(mean))
    places, colors = found_peaks(missed, count, weight, backend)
    assert len(places) == len(colors) == count
    if count:
        np.testing.assert_array_equal(places, mean[:count])
        np.testing.assert_allclose(colors, color[:count], rtol=1e-4, atol=1e-5)
