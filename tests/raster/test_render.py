"""Rendering: against a float64 sum over all pairs, of good and of bad numbers and arguments."""

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter

from _helpers.reference import render_exact
from _helpers.sets import (
    COUNT,
    SIZE,
    SMOOTH,
    Scene,
    arrays_of,
    bound,
    check_equal,
    covariances,
    factors_of,
    few,
    random_scene,
    scenes,
)
from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.gaussian.file import CUTOFF, MAX_CUTOFF
from eigengs_dr.gaussian.gaussians import concatenate
from eigengs_dr.image.color import rgb_to_ycbcr
from eigengs_dr.image.space import YCBCR
from eigengs_dr.raster.binning.tiles import TILE, Grid
from eigengs_dr.raster.render import (
    picture_of,
    render,
    to_tensor,
    to_tiles,
)


@pytest.mark.parametrize(
    ("size", "channels"),
    [*((SIZE, k) for k in (1, 2, 3, 4)), *((s, 3) for s in ((1, 1), (9, 1), (1, 6), (8, 8)))],
)
def test_sizes_and_channels(backend, size, channels):
    scene = random_scene(1, size=size, channels=channels)
    image = render(scene.on(backend)).numpy()
    assert image.shape == (size[1], size[0], channels)
    assert image.dtype == np.float32
    clear = scene.off_edge(CUTOFF)
    assert clear.mean() > 0.9
    np.testing.assert_allclose(image[clear], scene.exact(CUTOFF)[clear], rtol=0, atol=1e-5)


@few
@given(
    scene=scenes(),
    cutoff=st.sampled_from([1.5, CUTOFF, 5.0, MAX_CUTOFF]),
    narrow=st.booleans(),
)
def test_same_cutoff(backend, scene, cutoff, narrow):
    if narrow:
        scene.factor[0] = 8, 0, 8  # steep: exponentials instead of products, see `is_steep`
    clear = scene.off_edge(cutoff)
    error = np.abs(render(scene.on(backend), cutoff=cutoff).numpy() - scene.exact(cutoff))
    assert (error <= bound(scene, 1e-5))[clear].all()


@few
@given(scene=scenes(), narrow=st.booleans())
def test_double_precision(backend, scene, narrow):
    if narrow:
        scene.factor[0] = 8, 0, 8
    image = render(scene.on(backend, 64)).numpy()
    assert image.dtype == np.float64
    clear = scene.off_edge(CUTOFF, 1e-9)
    assert (np.abs(image - scene.exact(CUTOFF)) <= bound(scene, 1e-12))[clear].all()


def test_stretched_splats(backend):
    """1:400 at all angles, where boxes and ellipses differ the most."""
    rng = np.random.default_rng(0)
    variances = np.tile([[100.0, 0.25]], (COUNT, 1)) ** 2
    factor = factors_of(covariances(variances, np.linspace(0, np.pi, COUNT))).astype(np.float32)
    mean = rng.uniform(-20, 40, (COUNT, 2)).astype(np.float32)
    scene = random_scene(3)._replace(mean=mean, factor=factor)
    image = render(scene.on(backend)).numpy()
    clear = scene.off_edge(CUTOFF, 1e-3)
    assert clear.mean() > 0.9
    np.testing.assert_allclose(image[clear], scene.exact(CUTOFF)[clear], rtol=0, atol=1e-4)


def test_renderings_are_bit_equal_and_leave_the_set_as_it_was(backend):
    scene = random_scene(14)
    gaussians = scene.on(backend)
    np.testing.assert_array_equal(*(render(gaussians, width=10, height=8) for _ in range(2)))
    check_equal(gaussians, arrays_of(scene))
    assert (gaussians.width, gaussians.height) == SIZE


@few
@given(scene=scenes())
def test_set_split_in_two_and_summed(backend, scene):
    gaussians = scene.on(backend)
    first, second = gaussians[: COUNT // 2], gaussians[COUNT // 2 :]
    together = render(gaussians, cutoff=SMOOTH).numpy()
    parts = [render(g, cutoff=SMOOTH).numpy() for g in (first, second)]
    limit = bound(scene, 1e-5)
    assert (np.abs(sum(parts) - scene.background - together) <= limit).all()
    joined = render(concatenate([first, second]), cutoff=SMOOTH).numpy()
    assert (np.abs(joined - sum(parts)) <= limit).all()


def test_thousands_of_splats_on_one_pixel(backend):
    """No cap on the length of a list."""
    count = 2000
    rng = np.random.default_rng(0)
    mean = np.full((count, 2), 6.5) + rng.uniform(-0.4, 0.4, (count, 2))
    factor = np.tile([1.0, 0.2, 1.0], (count, 1))
    scene = Scene(mean, factor, rng.uniform(0, 1, (count, 3)), np.zeros(3))
    image = render(scene.on(backend), cutoff=SMOOTH).numpy()
    np.testing.assert_allclose(image, scene.exact(SMOOTH), rtol=1e-4, atol=1e-5)
    assert image[6, 6].min() > 500


@pytest.mark.parametrize("away", [1e3, -1e9, 1e30])
def test_all_splats_outside(backend, away):
    scene = random_scene(7)
    scene = scene._replace(mean=scene.mean + away)
    image = render(scene.on(backend)).numpy()
    np.testing.assert_array_equal(image, np.broadcast_to(np.float32(scene.background), image.shape))


spoil = pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])


@spoil
@pytest.mark.parametrize("position", range(5))
def test_splats_that_are_not_finite_are_not_drawn(backend, position, value):
    scene = random_scene(8)
    parameters = np.concatenate([scene.mean, scene.factor], axis=1)
    parameters[1::2, position] = value
    spoilt = scene._replace(mean=parameters[:, :2], factor=parameters[:, 2:])
    rest = scene.permuted(slice(0, None, 2))
    np.testing.assert_allclose(render(spoilt.on(backend)), render(rest.on(backend)), atol=1e-6)


@spoil
def test_a_colour_that_is_not_finite_spoils_no_more_than_its_tiles(backend, value):
    scene = random_scene(8)
    mean, factor, color = (v.copy() for v in scene[:3])
    mean[3], factor[3], color[3] = (11, 8), (0.75, 0.25, 1), value
    scene = scene._replace(mean=mean, factor=factor)
    image = render(scene.on(backend)).numpy()
    spoilt = render(scene._replace(color=color).on(backend)).numpy()
    distance = scene.distances()[3]
    assert not np.isfinite(spoilt[distance < CUTOFF * 0.999]).any()
    near = Scene(*scene.permuted([3])[:2], np.ones((1, 1)), np.zeros(1)).exact(CUTOFF)[..., 0] > 0
    touched = maximum_filter(near, 2 * max(TILE) - 1)  # no pixel of a touched tile is farther away
    assert 0.1 < touched.mean() < 0.9
    np.testing.assert_array_equal(spoilt[~touched], image[~touched])


@pytest.mark.parametrize("opaque", [False, True])
def test_a_value_that_all_splats_share(backend, opaque):
    scene = random_scene(10)._replace(factor=np.tile([0.5, 0.25, 0.75], (COUNT, 1)))
    gaussians = scene.on(backend)
    shared = type(gaussians.factor)(0.5, 0.25, 0.75)
    if opaque:
        dr.make_opaque(shared)
    image = render(replace(gaussians, factor=shared))
    np.testing.assert_array_equal(image, render(gaussians))


@pytest.mark.parametrize("diagonal", [1e-15, 1e-25])
def test_a_splat_without_end(backend, diagonal):
    """Standard deviations far beyond the image are a constant."""
    scene = random_scene(11, count=1)._replace(factor=np.array([[diagonal, 0, diagonal]]))
    image = render(scene.on(backend)).numpy()
    np.testing.assert_allclose(image, scene.exact(), atol=1e-6)


def test_ycbcr_comes_out_as_rgb(backend):
    scene = random_scene(12)
    scene = scene._replace(background=np.float32(rgb_to_ycbcr(np.array([0.2, 0.5, 0.9]))))
    image = render(scene.on(backend, space="ycbcr")).numpy()
    clear = scene.off_edge(CUTOFF)
    expected = YCBCR.decode_image(scene.exact(CUTOFF))
    np.testing.assert_allclose(image[clear], expected[clear], rtol=0, atol=2e-5)


@pytest.mark.parametrize("space", ["rgb", "linear"])
def test_other_spaces_come_out_as_they_are(backend, space):
    scene = random_scene(13)
    image = render(scene.on(backend, space=space))
    np.testing.assert_array_equal(image, render(scene.on(backend)))


def test_negative_light_is_black(backend):
    gaussians = random_scene()._replace(background=np.full(3, -0.5)).on(backend, space="linear")
    light, shown = render(gaussians).numpy(), picture_of(gaussians)
    assert (light < 0).any()
    assert (shown[light <= 0] == 0).all()
    assert np.isfinite(shown).all()


@pytest.mark.parametrize("size", [(8, 8), (9, 6), (1, 1)])
@pytest.mark.parametrize("layout", ["pixels", "planes", "crop", "float64"])
def test_tiles_of_any_memory_layout(backend, size, layout):
    width, height = size
    pixels = np.random.default_rng(0).uniform(size=(height + 2, width + 3, 5)).astype(np.float32)
    image = pixels[:height, :width]
    if layout == "planes":
        image = np.moveaxis(np.ascontiguousarray(np.moveaxis(image, 2, 0)), 0, 2)
    elif layout != "crop":
        image = image.astype(np.float32 if layout == "pixels" else np.float64, order="C")
    grid = Grid(width, height)
    tiles = to_tiles(types_in(select(backend)), image, grid)
    np.testing.assert_array_equal(to_tensor(tiles, grid, 5).numpy(), image)
    outside = grid.tiles * grid.pixels - width * height
    assert (tiles.numpy() == 0).sum() == 5 * outside


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


@pytest.mark.parametrize("filter", [True, False])
@pytest.mark.parametrize(
    ("asked", "size"),
    [
        ({}, SIZE),
        ({"width": 44}, (44, 34)),
        ({"height": 34}, (44, 34)),
        ({"width": 44, "height": 34}, (44, 34)),
        ({"width": 10, "height": 30}, (10, 30)),
        ({"width": 1}, (1, 1)),
        ({"height": 1}, (1, 1)),
    ],
)
def test_size_arguments(backend, asked, size, filter):
    """Positions and lengths scale with each side: means by s, factors by 1 / s."""
    scene = random_scene(4)
    image = render(scene.on(backend), **asked, filter=filter).numpy()
    assert image.shape == (size[1], size[0], 3)
    scaled = scene.at(size, filter)
    clear = scaled.off_edge(CUTOFF, 1e-3)
    np.testing.assert_allclose(image[clear], scaled.exact(CUTOFF)[clear], rtol=0, atol=2e-5)


@pytest.mark.parametrize("times", [(2, 2), (4, 4), (8, 8), (1, 4), (6, 1)])
def test_a_smaller_picture_is_the_average_of_the_native_one(backend, times):
    """Samples at the centres of pixels are far from it."""
    size = (96, 48)
    gaussians = random_scene(5, 3000, size, channels=1).on(backend, space="data")
    small = [side // k for side, k in zip(size, times, strict=True)]
    native = render(gaussians).numpy()[..., 0]
    average = native.reshape(small[1], times[1], small[0], times[0]).mean((1, 3))
    errors = [
        np.std(render(gaussians, *small, filter=kept).numpy()[..., 0] - average)
        for kept in (True, False)
    ]
    assert errors[0] < 0.25 * errors[1]
    assert errors[0] < 0.1 * average.std()


@pytest.mark.parametrize("asked", [{}, {"width": SIZE[0], "height": 40}, {"width": 100}])
def test_nothing_is_averaged_where_pixels_are_not_larger(backend, asked):
    gaussians = random_scene(6).on(backend)
    np.testing.assert_array_equal(
        render(gaussians, **asked), render(gaussians, **asked, filter=False)
    )


@pytest.mark.parametrize("diagonal", [1e-15, 1e15, 1e-25, 1e25])
def test_extreme_widths_in_a_smaller_picture(backend, diagonal):
    """A constant stays one, and what no pixel sees does not become visible."""
    scene = random_scene(11, count=1)._replace(factor=np.array([[diagonal, 0, diagonal]]))
    image = render(scene.on(backend), width=5).numpy()
    exact = np.broadcast_to(scene.background + (diagonal < 1) * scene.color, image.shape)
    np.testing.assert_allclose(image, exact, atol=1e-6)


@pytest.mark.parametrize("scale", [(1, 1), (2, 2), (0.5, 0.5), (0.25, 3)])
def test_a_region_is_the_crop_of_the_whole(backend, scale):
    gaussians = random_scene(7, size=(24, 16)).on(backend)
    region = (8, 4, 12, 8)
    size = [int(side * s) for side, s in zip((24, 16), scale, strict=True)]
    left, top, width, height = (int(v * s) for v, s in zip(region, scale * 2, strict=True))
    whole = render(gaussians, *size, cutoff=SMOOTH).numpy()
    part = render(gaussians, width, height, SMOOTH, region=region).numpy()
    np.testing.assert_allclose(part, whole[top : top + height, left : left + width], atol=1e-5)
    picture = picture_of(gaussians, width, cutoff=SMOOTH, region=region)
    assert picture.shape == (round(width * 8 / 12), width, 3)
    assert render(gaussians, region=region).shape == (8, 12, 3)


@pytest.mark.parametrize(
    "region", [(0, 0, 23, 5), (-1, 0, 5, 5), (20, 0, 3, 3), (3, 3, 0, 2), (1, 2, 3), (0.5, 0, 2, 2)]
)
def test_regions_that_are_refused(backend, region):
    with pytest.raises((ValueError, TypeError), match=r"region|integer"):
        render(random_scene().on(backend), region=region)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        *(({"cutoff": c}, "cutoff") for c in (0, math.nan, math.inf, np.nextafter(12.0, 13))),
        ({"width": 0}, "at least 1"),
        ({"width": -3, "height": 5}, "at least 1"),
        # Beyond 32 bits, and before anything is allocated.
        ({"width": 37838, "height": 37838}, "37838x37838 pixels and 3 channels has"),
    ],
)
def test_bad_arguments(backend, asked, words):
    with pytest.raises(ValueError, match=words) as error:
        render(random_scene().on(backend), **asked)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", [int, np.float64, np.float32])
def test_numbers_of_other_types(backend, kind):
    gaussians = random_scene().on(backend)
    image = render(gaussians, width=np.int64(10), height=np.int64(8), cutoff=kind(3))
    np.testing.assert_array_equal(image, render(gaussians, width=10, height=8, cutoff=3.0))
