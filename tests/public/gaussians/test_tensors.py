"""Sets as tensors and back: values, gradients both ways, shapes that do not fit."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import NAMES, check_equal, random_scene


@pytest.mark.parametrize("bits", [32, pytest.param(64, marks=pytest.mark.slow)])
def test_there_and_back(backend, bits):
    scene = random_scene()
    g = scene.on(backend, bits=bits)
    tensors = eg.to_tensors(g)
    assert tuple(tensors) == NAMES
    for name in NAMES:
        np.testing.assert_allclose(tensors[name].numpy(), getattr(scene, name), rtol=1e-6)
    back = eg.from_tensors(tensors, like=g)
    assert (back.width, back.height, back.space) == (g.width, g.height, g.space)
    check_equal(back, g.to_arrays())
    doubled = eg.from_tensors({"color": 2 * tensors["color"], "other": 1}, like=g)
    check_equal(doubled, {**g.to_arrays(), "color": 2 * g.to_arrays()["color"]})


def test_a_background_that_is_one_number(backend):
    g = random_scene().on(backend)
    g.background = type(g.background)(0.5, 0.25, 0.125)
    np.testing.assert_array_equal(eg.to_tensors(g)["background"].numpy(), [0.5, 0.25, 0.125])


@pytest.mark.parametrize("name", NAMES)
def test_gradients_pass_both_ways(backend, name):
    g = random_scene().on(backend)
    field = getattr(g, name)
    dr.enable_grad(field)
    tensor = eg.to_tensors(g)[name]
    weight = np.random.default_rng(0).normal(size=tensor.shape).astype(np.float32)
    dr.backward(dr.sum(tensor * type(tensor)(weight), axis=None))
    np.testing.assert_array_equal(np.atleast_2d(np.array(dr.grad(field)).T), np.atleast_2d(weight))

    tensor = type(tensor)(weight)
    dr.enable_grad(tensor)
    rows = getattr(eg.from_tensors({name: tensor}, like=g), name)
    dr.backward(sum(dr.sum((k + 1) * row) for k, row in enumerate(rows)))
    expected = np.broadcast_to(np.arange(1, len(rows) + 1), weight.shape)
    np.testing.assert_array_equal(dr.grad(tensor).numpy(), expected)


@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        ("mean", (24, 3), r"\(24, 2\)"),
        ("background", (1, 3), r"\(3,\)"),
        ("color", (5, 3), r"\(24, 3\)"),
    ],
)
def test_shapes_that_do_not_fit(name, shape, expected):
    g = random_scene().on("llvm")
    tensor = dr.llvm.ad.TensorXf(np.ones(shape, np.float32))
    with pytest.raises(ValueError, match=f"{name} has shape .*, expected {expected}"):
        eg.from_tensors({name: tensor}, like=g)


def test_tensors_of_another_precision_are_converted(backend):
    g = random_scene().on(backend)
    colors = getattr(dr, backend).ad.TensorXf64(eg.to_tensors(g)["color"])
    dr.enable_grad(colors)
    converted = eg.from_tensors({"color": colors}, like=g)
    check_equal(converted, g.to_arrays())
    dr.backward(dr.sum(converted.color, axis=None))
    np.testing.assert_array_equal(dr.grad(colors).numpy(), 1)


@pytest.mark.parametrize(
    ("color", "kind"), [(np.ones((24, 3)), "numpy.ndarray"), ([[1]], "builtins.list")]
)
def test_arrays_that_are_no_tensors_are_refused(color, kind):
    with pytest.raises(TypeError, match=f"color is a {kind}"):
        eg.from_tensors({"color": color}, like=random_scene().on("llvm"))
