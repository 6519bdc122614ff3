"""Rendering: against a float64 sum over all pairs, of good and of bad numbers and arguments."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eigengs_dr as eg
from _helpers.reference import BLACK, FROM_YCBCR, render_exact
from _helpers.sets import (
    COUNT,
    SIZE,
    SMOOTH,
    arrays_of,
    bound,
    check_equal,
    covariances,
    factors_of,
    few,
    random_scene,
    scenes,
)

CUTOFF = 3.0


def rendered(scene, backend, *size, **asked):
    return eg.render(scene.on(backend), *size, **asked).numpy()


def check_off_edge(image, scene, tolerance, margin=1e-4):
    """Equal where no cutoff is so near that rounding decides; that is at most pixels."""
    clear = scene.off_edge(CUTOFF, margin)
    assert clear.mean() > 0.9
    np.testing.assert_allclose(image[clear], scene.exact(CUTOFF)[clear], rtol=0, atol=tolerance)


def test_reference_is_the_formula():
    """``exp(-1/2 d^T Sigma^-1 d)`` with the covariances from which the factors came."""
    rng = np.random.default_rng(0)
    covariance = covariances(rng.uniform(0.5, 9, (COUNT, 2)), rng.uniform(0, np.pi, COUNT))
    mean, color = rng.uniform(-2, 24, (COUNT, 2)), rng.normal(size=(COUNT, 3))
    found = render_exact(mean, factors_of(covariance), color, np.array([1.0, 2, 3]), *SIZE)
    row, column = 4, 11
    d = np.array([column + 0.5, row + 0.5]) - mean
    weight = np.exp(-0.5 * np.einsum("ni,nij,nj->n", d, np.linalg.inv(covariance), d))
    np.testing.assert_allclose(found[row, column], [1, 2, 3] + weight @ color, rtol=1e-12)
    assert found.shape == (SIZE[1], SIZE[0], 3)


# --- The sum -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "channels"),
    [*((SIZE, k) for k in (1, 2, 3, 4)), *((s, 3) for s in ((1, 1), (9, 1), (1, 6), (8, 8)))],
)
def test_sizes_and_channels(backend, size, channels):
    scene = random_scene(1, size=size, channels=channels)
    image = rendered(scene, backend)
    assert image.shape == (size[1], size[0], channels) and image.dtype == np.float32
    check_off_edge(image, scene, 1e-5)


@few
@given(
    scene=scenes(),
    cutoff=st.sampled_from([1.5, CUTOFF, 5.0, 12.0]),
    narrow=st.booleans(),
    bits=st.sampled_from([32, 64]),
)
def test_cutoffs_and_precisions(backend, scene, cutoff, narrow, bits):
    if narrow:
        scene.factor[0] = 8, 0, 8  # so narrow that exponentials are taken instead of products
    margin, rounding = (1e-4, 1e-5) if bits == 32 else (1e-9, 1e-12)
    image = eg.render(scene.on(backend, bits), cutoff=cutoff).numpy()
    assert image.dtype == (np.float32 if bits == 32 else np.float64)
    error = np.abs(image - scene.exact(cutoff))
    assert (error <= bound(scene, rounding))[scene.off_edge(cutoff, margin)].all()


def test_stretched_splats(backend):
    """1:400 at all angles, where boxes and ellipses differ the most."""
    rng = np.random.default_rng(0)
    variances = np.tile([[100.0, 0.25]], (COUNT, 1)) ** 2
    factor = factors_of(covariances(variances, np.linspace(0, np.pi, COUNT))).astype(np.float32)
    mean = rng.uniform(-20, 40, (COUNT, 2)).astype(np.float32)
    scene = random_scene(3)._replace(mean=mean, factor=factor)
    check_off_edge(rendered(scene, backend), scene, 1e-4, 1e-3)


def test_renderings_are_bit_equal_and_leave_the_set_as_it_was(backend):
    scene = random_scene(14)
    gaussians = scene.on(backend)
    np.testing.assert_array_equal(*(eg.render(gaussians, width=10, height=8) for _ in range(2)))
    check_equal(gaussians, arrays_of(scene))
    assert (gaussians.width, gaussians.height) == SIZE


# --- Numbers without a place or an end ---------------------------------------------------------

spoil = pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])


@pytest.mark.parametrize("away", [1e3, -1e9, 1e30])
def test_all_splats_outside(backend, away):
    scene = random_scene(7)
    image = rendered(scene._replace(mean=scene.mean + away), backend)
    np.testing.assert_array_equal(image, np.broadcast_to(np.float32(scene.background), image.shape))


@spoil
@pytest.mark.parametrize("position", range(5))
def test_splats_that_are_not_finite_are_not_drawn(backend, position, value):
    scene = random_scene(8)
    parameters = np.concatenate([scene.mean, scene.factor], axis=1)
    parameters[1::2, position] = value
    spoilt = scene._replace(mean=parameters[:, :2], factor=parameters[:, 2:])
    rest = scene.permuted(slice(0, None, 2))
    np.testing.assert_allclose(rendered(spoilt, backend), rendered(rest, backend), atol=1e-6)


@spoil
def test_a_colour_that_is_not_finite_spoils_what_is_near_alone(backend, value):
    scene = random_scene(8)
    mean, factor, color = (v.copy() for v in scene[:3])
    mean[3], factor[3], color[3] = (3, 3), (0.75, 0.25, 1), value
    scene = scene._replace(mean=mean, factor=factor)
    image, spoilt = (rendered(s, backend) for s in (scene, scene._replace(color=color)))
    distance = scene.distances()[3]
    assert not np.isfinite(spoilt[distance < CUTOFF * 0.999]).any()
    far = distance > 14  # more than a tile beyond its cutoff
    assert far.any()
    np.testing.assert_array_equal(spoilt[far], image[far])


@pytest.mark.parametrize("diagonal", [1e-15, 1e15, 1e-25, 1e25])
@pytest.mark.parametrize("width", [SIZE[0], 5])
def test_extreme_widths(backend, diagonal, width):
    """What has no end is a constant, also in a smaller picture; what no pixel sees stays unseen."""
    scene = random_scene(11, count=1)._replace(factor=np.array([[diagonal, 0, diagonal]]))
    image = rendered(scene, backend, width=width)
    exact = np.broadcast_to(scene.background + (diagonal < 1) * scene.color, image.shape)
    np.testing.assert_allclose(image, exact, atol=1e-6)


# --- Spaces ------------------------------------------------------------------------------------


def test_ycbcr_comes_out_as_rgb(backend):
    scene = random_scene(12)
    image = eg.render(scene.on(backend, space="ycbcr")).numpy()
    clear = scene.off_edge(CUTOFF)
    expected = (scene.exact(CUTOFF) - BLACK) @ FROM_YCBCR.T
    np.testing.assert_allclose(image[clear], expected[clear], rtol=0, atol=2e-5)


def test_negative_light_is_black(backend):
    gaussians = random_scene()._replace(background=np.full(3, -0.5)).on(backend, space="linear")
    light, shown = eg.render(gaussians).numpy(), eg.picture_of(gaussians)
    assert (light < 0).any()
    assert (shown[light <= 0] == 0).all()
    assert np.isfinite(shown).all()


# --- Other sizes, and regions ------------------------------------------------------------------


@pytest.mark.parametrize("filter", [True, False])
@pytest.mark.parametrize(
    ("asked", "size"),
    [
        ({"width": 44}, (44, 34)),
        ({"height": 34}, (44, 34)),
        ({"width": 10, "height": 30}, (10, 30)),
        ({"width": 1}, (1, 1)),
        ({"height": 1}, (1, 1)),
    ],
)
def test_size_arguments(backend, asked, size, filter):
    """Positions and lengths scale with each side: means by s, factors by 1 / s."""
    scene = random_scene(4)
    image = rendered(scene, backend, **asked, filter=filter)
    assert image.shape == (size[1], size[0], 3)
    scaled = scene.at(size, filter)
    clear = scaled.off_edge(CUTOFF, 1e-3)
    np.testing.assert_allclose(image[clear], scaled.exact(CUTOFF)[clear], rtol=0, atol=2e-5)


@pytest.mark.parametrize("times", [(2, 2), (8, 8), (1, 4), (6, 1)])
def test_a_smaller_picture_is_the_average_of_the_native_one(backend, times):
    """Samples at the centres of pixels are far from it."""
    size = (96, 48)
    gaussians = random_scene(5, 3000, size).on(backend)
    small = [side // k for side, k in zip(size, times, strict=True)]
    native = eg.render(gaussians).numpy()
    average = native.reshape(small[1], times[1], small[0], times[0], 3).mean((1, 3))
    errors = [
        np.std(eg.render(gaussians, *small, filter=kept).numpy() - average)
        for kept in (True, False)
    ]
    assert errors[0] < 0.25 * errors[1]
    assert errors[0] < 0.1 * average.std()


@pytest.mark.parametrize("scale", [(1, 1), (2, 2), (0.5, 0.5), (0.25, 3)])
def test_a_region_is_the_crop_of_the_whole(backend, scale):
    gaussians = random_scene(7, size=(24, 16)).on(backend)
    region = (8, 4, 12, 8)
    size = [int(side * s) for side, s in zip((24, 16), scale, strict=True)]
    left, top, width, height = (int(v * s) for v, s in zip(region, scale * 2, strict=True))
    whole = eg.render(gaussians, *size, cutoff=SMOOTH).numpy()
    part = eg.render(gaussians, width, height, SMOOTH, region=region).numpy()
    np.testing.assert_allclose(part, whole[top : top + height, left : left + width], atol=1e-5)
    picture = eg.picture_of(gaussians, width, cutoff=SMOOTH, region=region)
    assert picture.shape == (round(width * 8 / 12), width, 3)
    assert eg.render(gaussians, region=region).shape == (8, 12, 3)


# --- Arguments ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        *(({"cutoff": c}, "cutoff") for c in (0, math.nan, math.inf, np.nextafter(12.0, 13))),
        ({"width": 0}, "at least 1"),
        ({"width": -3, "height": 5}, "at least 1"),
        # Beyond 32 bits, and before anything is allocated.
        ({"width": 37838, "height": 37838}, "37838x37838 pixels and 3 channels has"),
        *(({"region": r}, "region") for r in ((0, 0, 23, 5), (-1, 0, 5, 5), (3, 3, 0, 2))),
        ({"region": (1, 2, 3)}, "region"),
    ],
)
def test_bad_arguments(backend, asked, words):
    with pytest.raises((ValueError, TypeError), match=words) as error:
        eg.render(random_scene().on(backend), **asked)
    assert "\n" not in str(error.value)
