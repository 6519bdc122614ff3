"""Rows in words of 16 bits a number: what they lose, and which sets keep floats."""

import drjit as dr
import numpy as np
import pytest

from _helpers.footprints import coordinates, some_points, stacked
from _helpers.sets import SIZE, random_scene
from eigengs_dr.backend.arrays import types_of
from eigengs_dr.raster.evaluate import inverted
from eigengs_dr.raster.lookup import cells as numbered
from eigengs_dr.raster.lookup.cells import list_cells
from eigengs_dr.raster.lookup.coding import MEAN_BITS, encode_rows
from eigengs_dr.raster.lookup.points import Packed, invert, sum_at_points, value_terms
from eigengs_dr.raster.lookup.prefilter import sum_prefiltered
from eigengs_dr.raster.lookup.size_classes import classify_by_size
from eigengs_dr.raster.parameters import KernelParameters, kernel_radius
from eigengs_dr.raster.render import decode_parameters

HALF, SHORT = 2.0**-11, 2.0**-10
"""Largest relative errors of 10 and of 9 bits of mantissa: half of the last bit, beside 1."""

POINTS = some_points(300)


def coded(gaussians, filtered=False):
    """What decodes the rows of a set, their words, and the parameters that were encoded."""
    p = decode_parameters(gaussians)
    stored = inverted(p.shape) if filtered else p.shape
    found = encode_rows(p.shape, stored, p.color, (gaussians.width, gaussians.height))
    return found and (*found, KernelParameters(stored, p.color, p.background))


def numbers(rows):
    return np.stack([np.array(row, np.float64) for row in rows])


def spread(scene, colors):
    """The scene with colours of many orders of magnitude, of both signs."""
    rng = np.random.default_rng(5)
    sign = rng.choice([-1, 1], scene.color.shape)
    return scene._replace(color=np.float32(sign * 10 ** rng.uniform(*colors, scene.color.shape)))


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("channels", [1, 2, 3, 7])
@pytest.mark.parametrize("colors", [(-3, 0), (-2, 5.3), (-18, -12)])
def test_numbers_lose_what_their_bits_say(backend, filtered, channels, colors):
    """Also light above 65,504, the largest of plain halves, and colours below all of theirs."""
    scene = spread(random_scene(3, 60, channels=channels), colors)
    coding, words, given = coded(scene.on(backend), filtered)
    assert len(words) == coding.words == 2 + (1 + channels + 1) // 2
    shape, color = (numbers(rows) for rows in coding.decode(words))
    (x, y, a, b, c), exact = numbers(given.shape), numbers(given.color)
    for found, mean, step in zip(shape[:2], (x, y), coding.step, strict=True):
        # Half a step, and the rounding of the product and of the sum in single precision.
        np.testing.assert_allclose(found, mean, atol=step / 2 + 2 * np.spacing(np.float32(64)))
    np.testing.assert_allclose(shape[2:5:2], (a, c), rtol=SHORT)
    np.testing.assert_allclose(shape[3], b, rtol=HALF, atol=2.0**-26 * max(a.max(), c.max()))
    np.testing.assert_allclose(color, exact, rtol=HALF)


def lookups(gaussians, filtered, encode, parameters=None):
    """Sums of a set at points or over footprints: of words, or of the floats that are given."""
    p = decode_parameters(gaussians)
    types, size = types_of(gaussians.mean), (gaussians.width, gaussians.height)
    x, y = coordinates(types.Float, POINTS)
    if filtered:
        sizes = classify_by_size(dr.detach(p.shape), *size, 3.0, "repeat")
        cells = sizes.cells
    else:
        cells = list_cells([(dr.detach(p.shape), 4)], *size, kernel_radius(3.0))
    if encode:
        coding, words, _ = coded(gaussians, filtered)
        rows = cells.pack_rows(words, coding.blank)
        packed = Packed(rows, gaussians.channels, 3.0, filtered, coding)
    else:
        shape, color = parameters or (invert(p.shape, p.color) if filtered else (p.shape, p.color))
        packed = Packed(cells.pack(shape, color), gaussians.channels, 3.0, filtered)
    if not filtered:
        return stacked(sum_at_points(cells, packed, x, y, types.Bool(True), value_terms(packed)))
    footprint = [dr.opaque(types.Float, k) for k in (4.0, 1.5, 2.0)]
    return stacked(sum_prefiltered(sizes, packed, x, y, footprint, types.Bool(True)))


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 7])
@pytest.mark.parametrize("most", [1000, 58])
def test_sums_are_those_of_the_decoded_numbers(backend, filtered, channels, most, monkeypatch):
    """In several bands too."""
    monkeypatch.setattr(numbered, "MOST", most)
    gaussians = random_scene(2, 60, (64, 64), channels=channels)
    gaussians = gaussians._replace(factor=np.tile([0.6, 0.1, 0.5], (60, 1))).on(backend)
    coding, words, _ = coded(gaussians, filtered)
    shape, color = coding.decode(words)
    if filtered:
        color = [k * shape[2] * shape[4] for k in color]
    dr.eval(shape, color)
    found = lookups(gaussians, filtered, True)
    expected = lookups(gaussians, filtered, False, (shape, color))
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def bound(scene, points, step, cutoff=3.0):
    """The largest error of sums at points from the rounding of rows.

    With u = a dx + b dy and v = c dy, a weight w = exp(-(u^2 + v^2) / 2) changes by at most
    max |r exp(-r^2 / 2)| = exp(-1/2) times the length of the change of (u, v): rounding of a, b, c
    changes it by their share of the terms, and half a step of a mean by |a| + |b| and |c| steps.
    """
    dx, dy = np.abs(np.moveaxis(points[:, None] - scene.mean, -1, 0))
    a, b, c = np.abs(scene.factor.T)
    step = 0.5 * np.array(step) + np.spacing(np.float32(64))
    du = SHORT * a * dx + HALF * b * dy + a * step[0] + b * step[1]
    dv = SHORT * c * dy + c * step[1]
    moved = np.exp(-0.5) * np.hypot(du, dv)
    weight = np.exp(-0.5 * (np.maximum(a * dx - b * dy, 0) ** 2 + (c * dy) ** 2))
    near = c * dy <= 1.01 * cutoff
    return (near * (moved + HALF * weight)) @ np.abs(scene.color)


def test_sums_at_points_lose_what_rounding_explains(backend):
    scene = random_scene(4, 60)
    found, exact = (lookups(scene.on(backend), False, encode) for encode in (True, False))
    distance = scene.mean - POINTS[:, None]
    u = scene.factor[:, 0] * distance[..., 0] + scene.factor[:, 1] * distance[..., 1]
    edge = np.hypot(u, scene.factor[:, 2] * distance[..., 1])
    sure = (np.abs(edge / 3.0 - 1) > 4 * SHORT).all(axis=1)  # on one side of every cutoff
    assert sure.mean() > 0.5
    error = np.abs(found - exact)[sure]
    coding, *_ = coded(scene.on(backend))
    assert max(coding.step) < 2 * max(SIZE) / (2**MEAN_BITS - 1)
    assert (error <= bound(scene, POINTS, coding.step)[sure] + 1e-5).all()
    assert np.sqrt(np.mean(error**2)) < 1e-3 * np.abs(scene.color).mean()


def test_sums_over_footprints_lose_little(backend):
    """A weight loses its share of p r / sqrt(D), and of the exponent q, whose largest q exp(-q/2)
    is 0.74; both change by a few times the rounding of p, t, r."""
    scene = random_scene(4, 60)
    scene = scene._replace(factor=np.tile([0.6, 0.2, 0.5], (60, 1)))
    found, exact = (lookups(scene.on(backend), True, encode) for encode in (True, False))
    assert np.abs(found - exact).max() < 8 * SHORT * np.abs(scene.color).sum(axis=0).max() / 4


def changed(scene, name, values):
    array = getattr(scene, name).copy()
    array[: len(values)] = values
    return scene._replace(**{name: array})


def test_sets_that_words_do_not_hold_keep_floats(backend):
    scene = random_scene(1, 60)
    assert coded(scene.on(backend)) is not None
    assert coded(scene.on(backend, bits=64)) is None  # double precision
    giant = changed(scene, "factor", [[1e-12, 0, 1.0]])
    assert coded(giant.on(backend)) is None
    narrow = changed(scene, "factor", [[1e6, 0, 1.0]])  # a step of a mean is far for it
    assert coded(narrow.on(backend)) is None
    away = changed(scene, "mean", [[1e6, 3.0]])
    assert coded(away.on(backend)) is None
    spoilt = changed(scene, "color", [[np.nan, 0, 0]])
    assert coded(spoilt.on(backend)) is None
    beside_the_sun = changed(scene, "color", [[1e7, 0, 0]])  # the others would lose their bits
    assert coded(beside_the_sun.on(backend)) is None
    assert coded(scene._replace(color=np.float32(3e9 + scene.color)).on(backend)) is None
    dark = scene._replace(color=0 * scene.color)
    assert coded(dark.on(backend)) is not None


def test_means_outside_of_the_image_and_single_gaussians_are_held(backend):
    scene = changed(random_scene(1, 60), "mean", np.array([[-1.5, 0.3], [2.5, -0.7]]) * SIZE)
    for one in (scene, scene.permuted([0])):
        coding, words, given = coded(one.on(backend))
        shape, _ = coding.decode(words)
        np.testing.assert_allclose(numbers(shape[:2]), numbers(given.shape[:2]), atol=1e-3)
