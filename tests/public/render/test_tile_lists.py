"""Renderings with lists that were made before: recorded by `drjit.freeze`, and while sets move."""

import gc
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import NAMES, SIZE, arrays_of, random_scene


@pytest.fixture(autouse=True)
def no_collection():
    """No scene of another test is freed while Dr.Jit records, which would end the process."""
    gc.disable()
    yield
    gc.enable()


def on(backend, count=30, dtype=np.float32):
    arrays = arrays_of(random_scene(count=count))
    return eg.Gaussians.from_arrays(**arrays, size=SIZE, space="rgb", backend=backend, dtype=dtype)


def step(gaussians, lists, size):
    """The picture, and the gradient of the sum of its squares.

    A frozen `drjit.mean` divides on cuda by an approximate reciprocal, a plain one by a number.
    """
    gaussians = dr.detach(gaussians)
    dr.enable_grad(gaussians)
    picture = eg.render(gaussians, *size, lists=lists)
    dr.backward(dr.sum(dr.square(picture), axis=None))
    return dr.detach(picture), dr.grad(gaussians)


@pytest.mark.parametrize(
    ("size", "dtype"),
    [
        ((), np.float32),
        pytest.param((), np.float64, marks=pytest.mark.slow),
        ((9, 11), np.float32),
    ],
)
def test_a_frozen_rendering_and_its_gradient(backend, size, dtype):
    """The bits of plain ones, in the recording, in replays, and with other values."""
    g = on(backend, dtype=dtype)
    frozen = dr.freeze(lambda g, lists: step(g, lists, size))
    for shift in (0, 0, 0.25, 0.5):
        moved = replace(g, mean=g.mean + shift)
        found, wanted = frozen(moved, eg.tile_lists(moved, *size)), step(moved, None, size)
        np.testing.assert_array_equal(found[0].numpy(), wanted[0].numpy())
        for name in NAMES:
            pair = [getattr(gradient, name).numpy() for gradient in (found[1], wanted[1])]
            np.testing.assert_array_equal(*pair)


def test_without_lists_a_recording_says_what_to_do(backend):
    g = on(backend)
    with pytest.raises(RuntimeError) as error:
        dr.freeze(eg.render)(g)
    assert "build them with eigengs_dr.tile_lists" in str(error.value.__cause__)
    assert eg.render(g).numpy().any()  # Dr.Jit goes on


def test_lists_serve_sets_that_move_within_the_margin(backend):
    g = on(backend)
    moved = replace(g, mean=g.mean + 1)
    wanted = eg.render(moved).numpy()
    assert (eg.render(moved, lists=eg.tile_lists(g)).numpy() != wanted).any()
    found = eg.render(moved, lists=eg.tile_lists(g, margin=1.5)).numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize("frozen", [False, True])
def test_a_gaussian_that_shrinks_to_an_eighth_of_a_pixel_is_drawn(backend, frozen):
    """With lists of before, plain or replayed, also in the gradient; and it may grow again."""
    scene = random_scene(count=30)
    scene.factor[:] /= 4
    scene.mean[0] = 7.5, 8.5
    wide = scene.on(backend)
    scene.factor[0] = 8, 0, 8
    narrow, exact, sure = scene.on(backend), scene.exact(3.0), scene.off_edge(3.0)
    lists = eg.tile_lists(wide)
    assert not sure.all() and sure[8, 7] and np.abs(exact[8, 7] - scene.background).max() > 0.1

    def program(g, lists):
        return step(g, lists, ())

    frozen_program = dr.freeze(program) if frozen else program
    for g in (wide, narrow, wide, narrow):
        found, wanted = frozen_program(g, lists), step(g, None, ())
        np.testing.assert_allclose(found[0].numpy(), wanted[0].numpy(), atol=1e-5)
        for name in NAMES:
            pair = [getattr(gradient, name).numpy() for gradient in (found[1], wanted[1])]
            np.testing.assert_allclose(*pair, rtol=1e-4, atol=1e-4)
        if g is wide:  # nobody is steep: the bits of fresh lists
            np.testing.assert_array_equal(found[0].numpy(), wanted[0].numpy())
    np.testing.assert_allclose(found[0].numpy()[sure], exact[sure], atol=1e-5)


def test_lists_of_another_picture_are_refused(backend):
    g = on(backend)
    for asked, other, line in (
        ({}, {"width": 99}, "rebuild them with tile_lists"),
        ({"cutoff": 2}, {"cutoff": 3}, "the lists are for the cutoff 2, the rendering has 3; "),
        ({"region": (0, 0, 8, 8)}, {"region": (8, 8, 8, 8)}, "another region or filter"),
        ({"width": 10}, {"width": 10, "filter": False}, "another region or filter"),
    ):
        lists = eg.tile_lists(g, **asked)
        np.testing.assert_array_equal(eg.render(g, lists=lists, **asked), eg.render(g, **asked))
        with pytest.raises(ValueError, match=line):
            eg.render(g, lists=lists, **other)
    with pytest.raises(ValueError, match=r"the lists are for .* 30 Gaussians"):
        eg.render(g[:20], lists=eg.tile_lists(g))
    eg.render(g, lists=eg.tile_lists(g), filter=False)  # at the native size it makes no difference
    for margin in (-1, np.nan, np.inf):
        with pytest.raises(ValueError, match="margin is"):
            eg.tile_lists(g, margin=margin)
