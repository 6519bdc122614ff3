"""What must not change a rendering, or must change it in a known way."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from _helpers.sets import (
    COUNT,
    SIZE,
    SMOOTH,
    bound,
    few,
    random_scene,
    scenes,
)
from eigengs_dr.gaussian.gaussians import concatenate
from eigengs_dr.raster.render import (
    render,
)


def test_renderings_are_bit_equal(backend):
    gaussians = random_scene(14).on(backend)
    np.testing.assert_array_equal(render(gaussians), render(gaussians))


def test_rendering_leaves_the_set_as_it_was(backend):
    scene = random_scene(15)
    gaussians = scene.on(backend)
    render(gaussians, width=10, height=8).numpy()
    for name, value in gaussians.to_arrays().items():
        np.testing.assert_array_equal(value, getattr(scene, name))
    assert (gaussians.width, gaussians.height) == SIZE


@few
@given(scene=scenes(), order=st.permutations(range(COUNT)))
def test_splats_permuted(backend, scene, order):
    image = render(scene.on(backend)).numpy()
    permuted = render(scene.permuted(list(order)).on(backend)).numpy()
    assert (np.abs(image - permuted) <= bound(scene, 1e-5)).all()


def transposed(scene):
    """Swap x and y: the covariances are transposed, and their inverses factored again."""
    a, b, c = scene.factor.T
    inverse = np.stack([np.stack([b * b + c * c, a * b], -1), np.stack([a * b, a * a], -1)], -2)
    lower = np.linalg.cholesky(inverse)
    return scene._replace(
        mean=scene.mean[:, ::-1],
        factor=np.stack([lower[:, 0, 0], lower[:, 1, 0], lower[:, 1, 1]], axis=1),
        size=scene.size[::-1],
    )


@few
@given(scene=scenes())
def test_image_transposed(backend, scene):
    image = render(scene.on(backend), cutoff=SMOOTH).numpy()
    swapped = render(transposed(scene).on(backend), cutoff=SMOOTH).numpy()
    assert (np.abs(image - swapped.transpose(1, 0, 2)) <= bound(scene, 3e-5)).all()


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


@few
@given(scene=scenes())
def test_size_tripled(backend, scene):
    """The middle of 3x3 pixels of the large picture is the centre of the small one's pixel."""
    gaussians = scene.on(backend)
    small = render(gaussians, cutoff=SMOOTH).numpy()
    large = render(gaussians, width=3 * SIZE[0], cutoff=SMOOTH).numpy()
    assert (np.abs(large[1::3, 1::3] - small) <= bound(scene, 3e-5)).all()


@few
@given(scene=scenes())
def test_size_doubled(backend, scene):
    """A pixel of the large picture is the small one sampled at quarters of a pixel."""
    large = render(scene.on(backend), width=2 * SIZE[0], cutoff=SMOOTH).numpy()
    for i, j in ((0, 0), (1, 1)):
        shift = np.array([i, j]) / 2 - 0.25
        sampled = scene._replace(mean=scene.mean - shift).exact(SMOOTH)
        assert (np.abs(large[j::2, i::2] - sampled) <= bound(scene, 3e-5)).all()


@few
@given(scene=scenes())
def test_moved_by_whole_pixels(backend, scene):
    image = render(scene.on(backend), cutoff=SMOOTH).numpy()
    moved = scene._replace(mean=scene.mean + np.array([3, 2])).on(backend)
    moved = render(moved, cutoff=SMOOTH).numpy()
    assert (np.abs(moved[2:, 3:] - image[:-2, :-3]) <= bound(scene, 3e-5)[:-2, :-3]).all()


@few
@given(scene=scenes(), other=scenes(), scale=st.floats(-2, 2, width=32))
def test_linear_in_colour(backend, scene, other, scale):
    """The shapes are those of the first scene."""
    second = scene._replace(color=other.color, background=2 * other.background)
    both = scene._replace(
        color=scene.color + scale * second.color,
        background=scene.background + scale * second.background,
    )
    images = [render(s.on(backend)).numpy() for s in (scene, second, both)]
    limit = bound(scene, 1e-5) + abs(scale) * bound(second, 1e-5)
    assert (np.abs(images[0] + scale * images[1] - images[2]) <= limit).all()
