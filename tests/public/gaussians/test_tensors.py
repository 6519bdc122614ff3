"""Sets as tensors and back: values, gradients both ways, shapes that do not fit."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.sets import NAMES, random_scene
from eigengs_dr.backend.arrays import types_of


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_there_and_back(backend, bits, channels):
    scene = random_scene(channels=channels)
    g = scene.on(backend, bits=bits)
    tensors = eg.to_tensors(g)
    assert tuple(tensors) == NAMES
    for name in NAMES:
        np.testing.assert_allclose(tensors[name].numpy(), getattr(scene, name), rtol=1e-6)
    back = eg.from_tensors(tensors, like=g)
    assert (back.width, back.height, back.space) == (g.width, g.height, g.space)
    for name in NAMES:
        np.testing.assert_array_equal(back.to_arrays()[name], g.to_arrays()[name])


def test_a_background_that_is_one_number(backend):
    g = random_scene().on(backend)
    g.background = type(g.background)(0.5, 0.25, 0.125)
    np.testing.assert_array_equal(eg.to_tensors(g)["background"].numpy(), [0.5, 0.25, 0.125])


def test_what_is_not_given_stays(backend):
    g = random_scene().on(backend)
    doubled = eg.from_tensors({"color": 2 * eg.to_tensors(g)["color"], "other": 1}, like=g)
    np.testing.assert_array_equal(doubled.to_arrays()["mean"], g.to_arrays()["mean"])
    np.testing.assert_array_equal(doubled.to_arrays()["color"], 2 * g.to_arrays()["color"])


@pytest.mark.parametrize("name", NAMES)
def test_gradients_pass_both_ways(backend, name):
    g = random_scene().on(backend)
    field = getattr(g, name)
    dr.enable_grad(field)
    tensor = eg.to_tensors(g)[name]
    weight = np.random.default_rng(0).normal(size=tensor.shape).astype(np.float32)
    Tensor = types_of(field).Tensor
    dr.backward(dr.sum(tensor * Tensor(weight), axis=None))
    np.testing.assert_array_equal(np.atleast_2d(np.array(dr.grad(field)).T), np.atleast_2d(weight))

    tensor = Tensor(weight)
    dr.enable_grad(tensor)
    rows = getattr(eg.from_tensors({name: tensor}, like=g), name)
    dr.backward(sum(dr.sum((k + 1) * row) for k, row in enumerate(rows)))
    expected = np.broadcast_to(np.arange(1, len(rows) + 1), weight.shape)
    np.testing.assert_array_equal(dr.grad(tensor).numpy(), expected)


@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        ("mean", (24, 3), r"\(24, 2\)"),
        ("factor", (24,), r"\(24, 3\)"),
        ("color", (24, 1), r"\(24, 3\)"),
        ("background", (1, 3), r"\(3,\)"),
        ("color", (5, 3), r"\(24, 3\)"),
    ],
)
def test_shapes_that_do_not_fit(backend, name, shape, expected):
    g = random_scene().on(backend)
    Tensor = types_of(g.mean).Tensor
    with pytest.raises(ValueError, match=f"{name} has shape .*, expected {expected}"):
        eg.from_tensors({name: Tensor(np.ones(shape, np.float32))}, like=g)


def test_tensors_of_another_precision_are_converted(backend):
    g = random_scene().on(backend)
    double = types_of(random_scene().on(backend, bits=64).mean).Tensor
    colors = double(eg.to_tensors(g)["color"])
    dr.enable_grad(colors)
    converted = eg.from_tensors({"color": colors}, like=g)
    np.testing.assert_array_equal(converted.to_arrays()["color"], g.to_arrays()["color"])
    dr.backward(dr.sum(converted.color, axis=None))
    np.testing.assert_array_equal(dr.grad(colors).numpy(), 1)


def test_arrays_that_are_no_tensors_are_refused():
    g = random_scene().on("llvm")
    with pytest.raises(TypeError, match=r"color is a numpy\.ndarray, expected a Dr\.Jit"):
        eg.from_tensors({"color": np.ones((24, 3))}, like=g)
    with pytest.raises(TypeError, match=r"color is a builtins\.list"):
        eg.from_tensors({"color": [[1, 2, 3]]}, like=g)
