"""The arguments of `render`: sizes and cutoffs, good and bad."""

import math

import numpy as np
import pytest

from _helpers.sets import (
    SIZE,
    bound,
    random_scene,
)
from eigengs_dr.gaussian.file import CUTOFF, MAX_CUTOFF
from eigengs_dr.raster.render import (
    render,
)


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
def test_size_arguments(backend, asked, size):
    """Positions and lengths scale with each side: means by s, factors by 1 / s."""
    scene = random_scene(4)
    image = render(scene.on(backend), **asked).numpy()
    assert image.shape == (size[1], size[0], 3)
    sx, sy = size[0] / SIZE[0], size[1] / SIZE[1]
    larger = scene._replace(
        mean=scene.mean * [sx, sy], factor=scene.factor / [sx, sy, sy], size=size
    )
    clear = larger.off_edge(CUTOFF, 1e-3)
    np.testing.assert_allclose(image[clear], larger.exact(CUTOFF)[clear], rtol=0, atol=2e-5)


@pytest.mark.parametrize("cutoff", [0, -1.0, math.nan, math.inf, np.nextafter(12.0, 13)])
def test_bad_cutoff(backend, cutoff):
    with pytest.raises(ValueError, match="cutoff") as error:
        render(random_scene().on(backend), cutoff=cutoff)
    assert "\n" not in str(error.value)


def test_widest_cutoff(backend):
    scene = random_scene(5)
    image = render(scene.on(backend), cutoff=MAX_CUTOFF).numpy()
    assert (np.abs(image - scene.exact()) <= bound(scene, 1e-5)).all()


@pytest.mark.parametrize("asked", [{"width": 0}, {"height": 0}, {"width": -3, "height": 5}])
def test_bad_size(backend, asked):
    with pytest.raises(ValueError, match="at least 1") as error:
        render(random_scene().on(backend), **asked)
    assert "\n" not in str(error.value)


def test_size_beyond_32_bits_is_refused_before_it_is_allocated(backend):
    with pytest.raises(ValueError, match="37838x37838 pixels and 3 channels has") as error:
        render(random_scene().on(backend), width=37838, height=37838)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", [int, np.float64, np.float32])
def test_numbers_of_other_types(backend, kind):
    gaussians = random_scene().on(backend)
    image = render(gaussians, width=np.int64(10), height=np.int64(8), cutoff=kind(3))
    np.testing.assert_array_equal(image, render(gaussians, width=10, height=8, cutoff=3.0))
