"""Derivatives of renderings by the parameters of a texture or a sky."""

import drjit as dr
import numpy as np
import pytest

from _helpers.poster import mi

SIDE, SPP, SEED = 12, 32, 3
STEPS = {"mean": 2e-2, "factor": 1e-3, "coefficients": 1e-2, "scale": 1e-2}


def parameters_of(scene, name, names):
    """Some parameters of a part of a scene."""
    parameters = mi.traverse(scene)
    parameters.keep([f"{name}.{k}" for k in names])
    assert len(list(parameters)) == len(names)
    return parameters


def direction_like(array):
    return np.random.default_rng(2).normal(size=np.shape(array)).astype(np.float32)


def upstream():
    return np.random.default_rng(1).normal(size=(SIDE, SIDE, 3)).astype(np.float32)


def gradients(scene, parameters, weight):
    """Gradient of ``<weight, image>`` with respect to every parameter, from the integrator."""
    for key, value in parameters:
        dr.enable_grad(value)
        parameters[key] = value
    parameters.update()
    scene.integrator().render_backward(scene, parameters, weight, seed=SEED, spp=SPP)
    return {key: np.array(dr.grad(value)) for key, value in parameters}


def difference(scene, parameters, key, step, direction, weight):
    """The same along a direction, by finite differences at the same seed."""
    kind, start, losses = type(parameters[key]), np.array(dr.detach(parameters[key])), []
    for moved in (start + step * direction, start - step * direction, start):
        parameters[key] = kind(np.float32(moved))
        parameters.update()
        with dr.suspend_grad():
            image = scene.integrator().render(scene, seed=SEED, spp=SPP)
        losses.append((np.array(image, np.float64) * np.array(weight)).sum())
    return (losses[0] - losses[1]) / (2 * step)


def check_gradients(scene, name, names):
    """Compare with finite differences to 1 %, at equal seeds."""
    weight, parameters = mi.TensorXf(upstream()), parameters_of(scene, name, names)
    found = gradients(scene, parameters, weight)
    for key, gradient in found.items():
        direction, step = direction_like(gradient), STEPS.get(key.split(".")[-1], 2e-3)
        expected = difference(scene, parameters, key, step, direction, weight)
        assert abs(expected) > 1e-2
        assert (gradient * direction).sum() == pytest.approx(expected, rel=0.01), key


def check_forward_mode(make, name, names):
    """Rendered first and walked then, from a variable behind parameters of a new scene."""
    found = []
    for mode in ("forward", "backward"):
        scene = make()
        parameters, along = parameters_of(scene, name, names), mi.Float(0)
        dr.enable_grad(along)
        for key in (f"{name}.{k}" for k in names):
            start = mi.TensorXf(parameters[key])
            parameters[key] = start + along * mi.TensorXf(direction_like(start))
        parameters.update()
        image = mi.render(scene, parameters, seed=SEED, spp=8)
        if mode == "forward":
            dr.forward(along)
            found.append((np.array(dr.grad(image)) * upstream()).sum())
        else:
            dr.backward(dr.sum(image * mi.TensorXf(upstream()), axis=None))
            found.append(dr.grad(along)[0])
    assert abs(found[1]) > 1e-3
    assert found[0] == pytest.approx(found[1], rel=1e-3)
