"""Derivatives through Mitsuba's integrators, parameters from a model, what optimisers leave."""

import gc
import weakref

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_model
from _helpers.process import run_python
from _helpers.sets import SIZE, random_scene
from _helpers.texture import (
    at,
    backend,
    gaussians,
    in_front,
    mi,
    picture,
    small_scene,
    texel_centres,
    texture,
)
from eigengs_dr.gaussian.gaussians import MIN_DEVIATION
from eigengs_dr.plugins import keep_in_bounds, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

PARAMETERS = ["mean", "factor", "color", "background"]

TEXTURE = "wall.bsdf.reflectance"

SIDE, SPP, SEED = 12, 32, 3


def of_texture(scene):
    parameters = mi.traverse(scene)
    parameters.keep(f"{TEXTURE}\\.(?!to_uv|prefilter)")
    return parameters


def wall(g, **properties):
    return {"type": "diffuse", "reflectance": {**texture_of(g), **properties}}


def gradients(scene, weight):
    """Gradient of ``<weight, image>`` with respect to every parameter, from the integrator."""
    parameters = of_texture(scene)
    for key, value in parameters:
        dr.enable_grad(value)
        parameters[key] = value
    parameters.update()
    scene.integrator().render_backward(scene, parameters, weight, seed=SEED, spp=SPP)
    return {key.split(".")[-1]: np.array(dr.grad(value)) for key, value in parameters}


def difference(scene, name, step, direction, weight):
    """The same along a direction, by finite differences at the same seed."""
    parameters, key = of_texture(scene), f"{TEXTURE}.{name}"
    start, losses = np.array(parameters[key]), []
    for moved in (start + step * direction, start - step * direction, start):
        parameters[key] = mi.TensorXf(np.float32(moved))
        parameters.update()
        with dr.suspend_grad():
            image = scene.integrator().render(scene, seed=SEED, spp=SPP)
        losses.append((np.array(image, np.float64) * np.array(weight)).sum())
    return (losses[0] - losses[1]) / (2 * step)


def direction_like(array):
    return np.random.default_rng(2).normal(size=array.shape).astype(np.float32)


FORWARD_WITH_PREFILTER = """
import drjit as dr, eigengs_dr as eg, mitsuba as mi
from eigengs_dr.plugins import texture_of
mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
g = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1, 1, 1]], size=(8, 8), space="linear")
texture = mi.load_dict(texture_of(g, prefilter=0.05))
parameters, along = mi.traverse(texture), mi.Float(0)
dr.enable_grad(along)
parameters["color"] = parameters["color"] + along
parameters.update()
try:
    dr.forward(along)
except RuntimeError as error:
    print(error, flush=True)
"""


def upstream(shape=(SIDE, SIDE, 3)):
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


STEPS = {"mean": 2e-2, "factor": 1e-3, "coefficients": 1e-2}


def check_gradients(scene, names):
    """Compare with finite differences to 1 %, at equal seeds."""
    weight = mi.TensorXf(upstream())
    found = gradients(scene, weight)
    assert list(found) == names
    for name, gradient in found.items():
        direction = direction_like(gradient)
        expected = difference(scene, name, STEPS.get(name, 2e-3), direction, weight)
        assert abs(expected) > 1e-2
        assert (gradient * direction).sum() == pytest.approx(expected, rel=0.01), name


class TestIntegrators:
    @pytest.mark.parametrize(
        ("integrator", "prefilter"), [("direct", 0.0), ("path", 0.0), ("prb", 0.0), ("prb", 0.05)]
    )
    def test_gradients_are_finite_differences(self, integrator, prefilter):
        """A cutoff of 6 leaves no edge for finite differences to cross."""
        bsdf = wall(gaussians("ycbcr"), cutoff=6.0, prefilter=prefilter)
        check_gradients(small_scene(bsdf, integrator, SIDE, SPP), PARAMETERS)

    def along_parameters(self, integrator, names, prefilter=0.0):
        """A picture whose parameters depend on one variable, and this variable."""
        scene = small_scene(wall(gaussians(), prefilter=prefilter), integrator, SIDE, 8)
        parameters, along = of_texture(scene), mi.Float(0)
        dr.enable_grad(along)
        for name in names:
            start = mi.TensorXf(parameters[f"{TEXTURE}.{name}"])
            parameters[f"{TEXTURE}.{name}"] = start + along * mi.TensorXf(direction_like(start))
        parameters.update()
        return mi.render(scene, parameters, seed=SEED, spp=8), along

    @pytest.mark.parametrize(
        ("integrator", "names"),
        [*(("direct", [name]) for name in PARAMETERS), ("direct", PARAMETERS), ("prb", PARAMETERS)],
    )
    def test_forward_mode_in_the_usual_order(self, integrator, names):
        """Rendered first and walked then, from a variable behind the parameters."""
        image, along = self.along_parameters(integrator, names)
        dr.forward(along)
        found = (np.array(dr.grad(image)) * upstream()).sum()
        image, along = self.along_parameters(integrator, names)
        dr.backward(dr.sum(image * mi.TensorXf(upstream()), axis=None))
        assert abs(dr.grad(along)[0]) > 1e-3
        assert found == pytest.approx(dr.grad(along)[0], rel=1e-3)

    def test_forward_mode_of_a_prefilter_says_that_there_is_none(self):
        """In another process: after an error in a walk, Dr.Jit 1.5 may end it when it exits."""
        told = run_python(FORWARD_WITH_PREFILTER).stdout
        assert told.startswith("no forward mode of Gaussians with a prefilter")


@pytest.mark.parametrize("prefilter", [0.0, 0.05])
def test_derivatives_that_nobody_walks_keep_nothing_alive(prefilter):
    """Operations that hold their texture would be left when the process ends, and end it badly."""
    tex = texture(gaussians(), prefilter=prefilter)
    parameters = mi.traverse(tex)
    dr.enable_grad(parameters["color"])
    parameters.update()
    dr.eval(tex.eval_3(in_front(at(0.3, 0.4))))
    table = weakref.ref(tex.table)
    del tex, parameters
    gc.collect()
    assert table() is None


class TestBroken:
    @pytest.mark.parametrize("name", PARAMETERS)
    @pytest.mark.parametrize("prefilter", [0.0, 0.01])
    def test_parameters_leave_a_finite_picture(self, name, prefilter):
        tex = texture(gaussians(), prefilter=prefilter)
        parameters = mi.traverse(tex)
        start = np.array(parameters[name])
        for value in (np.nan, np.inf, -np.inf, 0.0, -5.0, 1e30, 1e-20):
            broken = start.copy()
            broken[: max(1, len(broken) // 4)] = value
            parameters[name] = mi.TensorXf(broken)
            parameters.update()
            found = np.array(tex.eval(in_front(texel_centres())))
            assert np.isfinite(found).all(), value
            assert found.min() >= 0 and found.max() <= 1, value

    @pytest.mark.parametrize("factor", [[1e-20, 0, 1], [1e-30, 0, 1e-30], [1, 1e20, 1]])
    def test_a_set_of_giants_loads(self, factor):
        g = eg.Gaussians.from_arrays(
            [[8, 8]], [factor], [[0.5] * 3], size=(16, 16), space="linear", backend=backend()
        )
        assert np.isfinite(np.array(texture(g, prefilter=0.01).eval(at(0.3, 0.4)))).all()

    def test_one_broken_splat_is_as_none(self):
        scene = random_scene(0)
        broken = scene.factor.copy()
        broken[5] = np.nan
        kept = scene.permuted(np.setdiff1d(np.arange(len(broken)), 5))
        tex = texture(gaussians(), raw=True)
        parameters = mi.traverse(tex)
        parameters["factor"] = mi.TensorXf(broken.astype(np.float32))
        parameters.update()
        g = kept._replace(color=0.04 * kept.color, background=np.full(3, 0.5)).on(backend())
        np.testing.assert_allclose(
            picture(tex.eval_3(texel_centres())), eg.render(g).numpy(), atol=1e-5
        )

    def test_bounds(self):
        optimizer = mi.ad.Adam(lr=0.1)
        optimizer["t.mean"] = mi.TensorXf(np.float32([[1, 2], [np.nan, 99], [-3, 4]]))
        optimizer["t.factor"] = mi.TensorXf(np.float32([[1, 2, 3], [np.nan, 99, -1], [1, 0, 1]]))
        optimizer["t.color"] = mi.TensorXf(np.float32([[1, 2, 3], [np.nan, 99, -1], [1, 0, 1]]))
        keep_in_bounds(optimizer, "t", gaussians())
        high, low = 1 / MIN_DEVIATION, 1 / (2 * max(SIZE))
        np.testing.assert_allclose(
            np.array(optimizer["t.mean"]), [[1, 2], [SIZE[0] / 2, SIZE[1]], [0, 4]]
        )
        np.testing.assert_allclose(
            np.array(optimizer["t.factor"]), [[1, 2, 3], [high, high, low], [1, 0, 1]]
        )
        np.testing.assert_allclose(
            np.array(optimizer["t.color"]), [[1, 2, 3], [0, 99, -1], [1, 0, 1]]
        )


class TestModel:
    @pytest.fixture
    def saved(self, tmp_path):
        model = small_model(backend())
        model.save(tmp_path / "m.npz")
        return str(tmp_path / "m.npz"), eg.EigenGS.load(tmp_path / "m.npz", backend())

    def test_coefficients_give_the_model_s_picture(self, saved):
        path, model = saved
        rng = np.random.default_rng(0)
        rows = [0.1 * rng.normal(size=k).astype(np.float32) for k in model.components]
        tex = mi.load_dict({"type": "gaussian_texture", "model": path, "raw": True})
        parameters = mi.traverse(tex)
        assert [key for key, _ in parameters] == ["coefficients", "to_uv", "prefilter"]
        assert parameters["coefficients"].shape == (3, max(model.components))
        table = np.zeros(parameters["coefficients"].shape, np.float32)
        for padded, row in zip(table, rows, strict=True):
            padded[: len(row)] = row
        for given in (table, table * 0):
            parameters["coefficients"] = mi.TensorXf(given)
            parameters.update()
            expected = model.reconstruct(
                [r[:k] for r, k in zip(given, model.components, strict=True)]
            )
            found = picture(tex.eval_3(texel_centres((32, 32))), (32, 32))
            np.testing.assert_allclose(found, eg.render(expected).numpy(), atol=1e-4)

    @pytest.mark.parametrize("integrator", ["direct", "prb"])
    def test_gradients_are_finite_differences(self, saved, integrator):
        bsdf = {"type": "diffuse", "reflectance": {"type": "gaussian_texture", "model": saved[0]}}
        check_gradients(small_scene(bsdf, integrator, SIDE, SPP), ["coefficients"])

    def test_coefficients_of_another_shape(self, saved):
        with pytest.raises(RuntimeError, match=r"coefficients has shape \(2, 2\), expected \(3, "):
            given = {"coefficients": mi.TensorXf(np.zeros((2, 2), np.float32))}
            mi.load_dict({"type": "gaussian_texture", "model": saved[0], **given})

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_coefficients_that_are_not_finite(self, saved, value):
        path, model = saved
        given = {"type": "gaussian_texture", "model": path}
        broken = np.zeros((3, max(model.components)), np.float32)
        broken[:, -1] = value
        with pytest.raises(RuntimeError, match="coefficients must be finite"):
            mi.load_dict({**given, "coefficients": mi.TensorXf(broken)})
        tex = mi.load_dict({**given, "memory": "exact"})
        expected = np.array(tex.eval(texel_centres()))
        parameters = mi.traverse(tex)
        parameters["coefficients"] = mi.TensorXf(broken)  # as a step of an optimiser may leave
        parameters.update()
        np.testing.assert_array_equal(np.array(tex.eval(texel_centres())), expected)

    def test_a_set_is_no_model(self, tmp_path):
        gaussians().save(tmp_path / "x.npz")
        with pytest.raises(RuntimeError, match=r"x\.npz"):
            mi.load_dict({"type": "gaussian_texture", "model": str(tmp_path / "x.npz")})
