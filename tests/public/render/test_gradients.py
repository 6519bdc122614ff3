"""Derivatives of rendering, both ways: against finite differences in float64, and each other."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import eigengs_dr as eg
from _helpers.reference import BLACK, FROM_YCBCR
from _helpers.sets import NAMES, few, random_scene, scenes

COUNT = 7
CUTOFF = 3.0
WIDE = 9.0
"""A cutoff at which a splat's edge, exp(-40), is nothing: finite differences may cross it."""

SIZES = [{}, {"width": 33}, {"width": 9, "height": 5}, {"width": 11, "height": 40}]
PRECISIONS = ((32, 1e-3), (64, 1e-6))
"""Bits of numbers, and relative errors that they allow."""


def upstream(shape, seed=0):
    """Derivatives of a loss with respect to an image."""
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def image_of(scene, cutoff, asked):
    """The picture in float64, rendered as `asked`."""
    width = asked.get("width", scene.size[0])
    height = asked.get("height", round(width * scene.size[1] / scene.size[0]))
    return scene.at((width, height)).exact(cutoff)


def numeric_gradient(loss, scene, step=1e-6):
    """Central differences of ``loss(scene)`` for every number of a scene: dict of arrays."""
    gradient = {}
    for name in NAMES:
        value = getattr(scene, name)
        gradient[name] = np.zeros(value.shape)
        for index in np.ndindex(value.shape):
            moved = np.zeros(value.shape)
            moved[index] = step
            up, down = (loss(scene._replace(**{name: value + s * moved})) for s in (1, -1))
            gradient[name][index] = (up - down) / (2 * step)
    return gradient


def attached(gaussians, names=NAMES):
    for name in names:
        dr.enable_grad(getattr(gaussians, name))
    return gaussians


def gradient_of(gaussians):
    """Gradients in the shapes of a scene: dict of float64 arrays."""
    found = {name: dr.grad(getattr(gaussians, name)).numpy().T.astype(float) for name in NAMES}
    return {**found, "background": found["background"][0]}


def pull(image, delta=None):
    """Backward from ``sum(delta * image)``."""
    delta = upstream(image.shape) if delta is None else delta
    dr.backward(dr.sum(image * type(image)(delta.astype(image.numpy().dtype))))


def reverse(gaussians, delta=None, names=NAMES, **asked):
    """Gradient of ``sum(delta * image)`` with respect to the named parameters."""
    attached(gaussians, names)
    pull(eg.render(gaussians, **asked), delta)
    return gradient_of(gaussians)


def forward(gaussians, along, names=NAMES, **asked):
    """Derivative of the image along the named parameters of another set."""
    attached(gaussians, names)
    for name in names:
        dr.set_grad(getattr(gaussians, name), getattr(along, name))
    image = eg.render(gaussians, **asked)
    dr.forward_to(image)
    return dr.grad(image).numpy().astype(np.float64)


def check(found, exact, rtol, floor=0.02):
    """Every number to `rtol`; where it is below `floor` of the largest, to `rtol` of that."""
    for name in NAMES:
        scale = np.abs(exact[name]).max()
        assert scale > 0, name
        np.testing.assert_allclose(
            found[name], exact[name], rtol=rtol, atol=floor * rtol * scale, err_msg=name
        )


# --- Against finite differences ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "asked"),
    [
        pytest.param(random_scene(1, COUNT, channels=1), {}, marks=pytest.mark.slow),
        (random_scene(4, COUNT, channels=4), {}),
        *((random_scene(3, COUNT), asked) for asked in SIZES),
        (random_scene(1, 3), {"width": 200}),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else f"{value.color.shape}",
)
def test_reverse(backend, scene, asked):
    """Also in thousands of tiles, as a GPU adds in blocks: one Gaussian has 122 pieces of 16."""
    delta = upstream(image_of(scene, WIDE, asked).shape)
    exact = numeric_gradient(lambda s: (delta * image_of(s, WIDE, asked)).sum(), scene)
    for bits, rtol in PRECISIONS if len(scene.background) == 3 else PRECISIONS[:1]:
        check(reverse(scene.on(backend, bits), delta, cutoff=WIDE, **asked), exact, rtol)


@pytest.mark.parametrize("narrow", [False, True])
def test_inside_the_cutoff(backend, narrow):
    """At the default cutoff, on scenes in which no pixel is so close to an edge as to cross it."""
    drawn = (random_scene(seed, 3) for seed in range(1000))
    if narrow:  # exponentials instead of products
        at = {"mean": np.array([7.6, 8.4]), "factor": np.array([6.0, 1.0, 6.0])}
        drawn = (
            s._replace(**{n: np.vstack([at[n], getattr(s, n)[1:]]) for n in at}) for s in drawn
        )
    clear = (s for s in drawn if s.off_edge(CUTOFF, 2e-3).all() and s.distances().min() < CUTOFF)
    for _ in range(2):
        scene = next(clear)
        delta = upstream(scene.exact().shape)
        exact = numeric_gradient(lambda s, d=delta: (d * s.exact(CUTOFF)).sum(), scene)
        for bits, rtol in PRECISIONS:
            check(reverse(scene.on(backend, bits), delta), exact, rtol)


def test_mean_squared_error_of_rgb(backend):
    """Through the colour conversion, and a loss that is not linear, in a smaller picture."""
    scene, asked = random_scene(5, COUNT), {"width": 9, "height": 5}
    target = upstream(image_of(scene, WIDE, asked).shape, seed=1)
    exact = numeric_gradient(
        lambda s: np.square((image_of(s, WIDE, asked) - BLACK) @ FROM_YCBCR.T - target).mean(),
        scene,
    )
    gaussians = attached(scene.on(backend, space="ycbcr"))
    image = eg.render(gaussians, cutoff=WIDE, **asked)
    dr.backward(dr.mean(dr.square(image - type(image)(target))))
    check(gradient_of(gaussians), exact, 1e-3)


@few
@given(
    scene=scenes(COUNT),
    direction=scenes(COUNT),
    narrow=st.booleans(),
    precision=st.sampled_from([(32, 1e-5), (64, 1e-13)]),
    asked=st.sampled_from([{}, {"width": 9, "height": 5}]),
)
def test_forward_and_reverse_are_adjoint(backend, scene, direction, narrow, precision, asked):
    """``<J v, w> = <v, J^T w>``."""
    bits, share = precision
    if narrow:
        scene.factor[0] = 8, 0, 8
    image_tangent = forward(scene.on(backend, bits), direction.on(backend, bits), **asked)
    delta = upstream(image_tangent.shape)
    gradient = reverse(scene.on(backend, bits), delta, **asked)
    terms = [getattr(direction, name) * gradient[name] for name in NAMES]
    size = sum(np.abs(t).sum() for t in terms) + np.abs(image_tangent * delta).sum()
    difference = (image_tangent * delta).sum() - sum(t.sum() for t in terms)
    assert abs(difference) <= share * size


# --- Some parameters, some splats --------------------------------------------------------------


def test_splats_that_are_not_drawn_have_no_gradient(backend):
    scene = random_scene(9, COUNT)
    mean, factor = scene.mean.copy(), scene.factor.copy()
    mean[1], mean[3, 0], factor[5, 1] = 1e4, np.nan, np.inf
    found = reverse(scene._replace(mean=mean, factor=factor).on(backend))
    drawn = [0, 2, 4, 6]
    expected = reverse(scene.permuted(drawn).on(backend))
    for name in NAMES[:3]:
        assert not found[name][[1, 3, 5]].any()
        np.testing.assert_allclose(found[name][drawn], expected[name], rtol=1e-5, atol=1e-5)


def test_a_value_that_all_splats_share(backend):
    """Its gradient is the sum of theirs."""
    scene = random_scene(10, COUNT)._replace(factor=np.tile([0.5, 0.25, 0.75], (COUNT, 1)))
    gaussians = scene.on(backend)
    shared = type(gaussians.factor)(0.5, 0.25, 0.75)
    dr.enable_grad(shared)
    pull(eg.render(replace(gaussians, factor=shared)))
    expected = reverse(scene.on(backend))["factor"].sum(axis=0)
    np.testing.assert_allclose(dr.grad(shared).numpy().ravel(), expected, rtol=1e-4)


@pytest.mark.slow
def test_through_selection_and_concatenation(backend):
    """A splat that is drawn twice has twice the gradient, one that is left out has none."""
    scene = random_scene(11, COUNT)
    gaussians = attached(scene.on(backend))
    order = [0, 2, 2, 5]
    pull(eg.render(eg.concatenate([gaussians[order], gaussians[[4]]])))
    found = gradient_of(gaussians)
    expected = reverse(scene.permuted([*order, 4]).on(backend))
    np.testing.assert_allclose(found["background"], 2 * expected["background"], rtol=1e-5)
    for name in NAMES[:3]:
        summed = np.zeros_like(found[name])
        np.add.at(summed, [*order, 4], expected[name])
        np.testing.assert_allclose(found[name], summed, rtol=1e-4, atol=1e-4)
