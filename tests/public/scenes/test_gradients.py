"""Derivatives through Mitsuba's integrators, parameters from a model, what optimisers leave."""

import gc
import weakref

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.derivatives import SIDE, SPP, check_forward_mode, check_gradients
from _helpers.families import small_model
from _helpers.poster import camera
from _helpers.process import run_python
from _helpers.sets import SIZE, random_scene
from _helpers.skies import lit, sky, uniform
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
from eigengs_dr.plugins import environment_of, keep_in_bounds, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

PARAMETERS = ["mean", "factor", "color", "background"]
TEXTURE = "wall.bsdf.reflectance"


def wall(g, **properties):
    return {"type": "diffuse", "reflectance": {**texture_of(g), **properties}}


@pytest.mark.parametrize(
    ("integrator", "prefilter"),
    [("direct", 0.0), ("prb", 0.05)],
)
def test_gradients_are_finite_differences(integrator, prefilter):
    """A cutoff of 6 leaves no edge for finite differences to cross."""
    bsdf = wall(gaussians(), cutoff=6.0, prefilter=prefilter)
    check_gradients(small_scene(bsdf, integrator, SIDE, SPP), TEXTURE, PARAMETERS)


@pytest.mark.parametrize(
    ("space", "prefilter"),
    [("radiance", 0.0), pytest.param("log", 0.2, marks=pytest.mark.slow)],
)
def test_gradients_of_a_sky_are_finite_differences(space, prefilter):
    """Of its picture; where it lights a scene, its samples move with it."""
    light = environment_of(sky(space, count=12), cutoff=6.0, prefilter=prefilter)
    view = camera([0, 0, 0], SIDE, fov=120, target=[1, 0.2, 0.3])
    scene = {"type": "scene", "integrator": {"type": "direct"}, "sensor": view, "sky": light}
    check_gradients(mi.load_dict(scene), "sky", ["scale", *PARAMETERS])


def wall_in_a_scene():
    return small_scene(wall(gaussians()), "prb", SIDE, 8)


def ball_under_a_sky():
    return lit(environment_of(sky(count=12)), "prb", SIDE)


@pytest.mark.parametrize(
    ("make", "name", "names"),
    [(wall_in_a_scene, TEXTURE, PARAMETERS), (ball_under_a_sky, "sky", ["color"])],
)
def test_forward_mode_in_the_usual_order(make, name, names):
    check_forward_mode(make, name, names)


FORWARD_WITH_PREFILTER = """
import drjit as dr, eigengs_dr as eg, mitsuba as mi
from eigengs_dr.plugins import texture_of
mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
arrays = [[4, 4]] * 24, [[0.5, 0, 0.5]] * 24, [[0.01] * 3] * 24, [0.5] * 3
g = eg.Gaussians.from_arrays(*arrays, size=(22, 17), space="linear")
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


def test_forward_mode_of_a_prefilter_says_that_there_is_none():
    """In another process: after an error in a walk, Dr.Jit 1.5 may end it when it exits."""
    told = run_python(FORWARD_WITH_PREFILTER).stdout
    assert told.startswith("no forward mode of Gaussians with a prefilter")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["direct_projective", "prb_projective"])
def test_projective_integrators(kind):
    """Their pictures, and the derivatives that the plain ones have too: those of colours."""
    seen, slopes = [], []
    for name in (kind, kind.removesuffix("_projective")):
        scene = small_scene(wall(gaussians("linear")), "direct", spp=256)
        parameters, key = mi.traverse(scene), f"{TEXTURE}.color"
        dr.enable_grad(parameters[key])
        parameters.update()
        image = mi.render(scene, parameters, integrator=mi.load_dict({"type": name}), seed=1)
        dr.backward(dr.mean(dr.square(image), axis=None))
        seen.append(np.array(image))
        slopes.append(np.array(dr.grad(parameters[key])))
    assert np.abs(slopes[1]).max() > 1e-4
    for found, expected in (seen, slopes):  # but for noise
        assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected)


def test_derivatives_that_nobody_walks_keep_nothing_alive():
    """Operations that hold their texture would be left when the process ends, and end it badly."""
    tex = texture(gaussians(), prefilter=0.05)
    parameters = mi.traverse(tex)
    dr.enable_grad(parameters["color"])
    parameters.update()
    dr.eval(tex.eval_3(in_front(at(0.3, 0.4))))
    alive = weakref.ref(tex)
    del tex, parameters
    gc.collect()
    assert alive() is None


class TestBroken:
    @pytest.mark.parametrize("kind", ["texture", "environment"])
    @pytest.mark.parametrize("name", PARAMETERS)
    def test_parameters_leave_a_finite_picture(self, kind, name):
        """Between 0 and 1, as the space is; light has no largest value. Near, and from afar."""
        of_a_sky = kind == "environment"
        made = environment_of(sky()) if of_a_sky else texture_of(gaussians(), prefilter=0.01)
        plugin = mi.load_dict(made)
        parameters = mi.traverse(plugin)
        start, largest = np.array(parameters[name]), 3.3e38 if name == "factor" else 1e30
        for value in (np.nan, np.inf, -np.inf, 0.0, -5.0, largest, 1e-20):
            broken = start.copy()
            broken[: max(1, len(broken) // 4)] = value
            parameters[name] = mi.TensorXf(broken)
            parameters.update()
            for distance in (0.01, 1.0, 10.0):
                si = in_front(texel_centres(), distance)
                if of_a_sky:
                    si.wi = mi.warp.square_to_uniform_sphere(uniform(dr.width(si)))
                    ds, _ = plugin.sample_direction(si, uniform(dr.width(si)))
                    assert np.isfinite(np.array(ds.d)).all(), value
                found = np.array(plugin.eval(si))
                assert found.min() >= 0 and (found.max() <= 1 or of_a_sky), value
                assert np.isfinite(found).all() or (of_a_sky and value > 1), value

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
        """Deviations of 0.25 pixels to twice the longer side."""
        optimizer = mi.ad.Adam(lr=0.1)
        optimizer["t.mean"] = mi.TensorXf(np.float32([[1, 2], [np.nan, 99], [-3, 4]]))
        optimizer["t.factor"] = mi.TensorXf(np.float32([[1, 2, 3], [np.nan, 99, -1], [1, 0, 1]]))
        optimizer["t.color"] = mi.TensorXf(np.float32([[1, 2, 3], [np.nan, 99, -1], [1, 0, 1]]))
        keep_in_bounds(optimizer, "t", gaussians())
        for name, expected in (
            ("mean", [[1, 2], [SIZE[0] / 2, SIZE[1]], [0, 4]]),
            ("factor", [[1, 2, 3], [4, 4, 1 / (2 * max(SIZE))], [1, 0, 1]]),
            ("color", [[1, 2, 3], [0, 99, -1], [1, 0, 1]]),
        ):
            np.testing.assert_allclose(np.array(optimizer[f"t.{name}"]), expected)


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

    def test_gradients_are_finite_differences(self, saved):
        bsdf = {"type": "diffuse", "reflectance": {"type": "gaussian_texture", "model": saved[0]}}
        check_gradients(small_scene(bsdf, "prb", SIDE, SPP), TEXTURE, ["coefficients"])

    def test_coefficients_of_another_shape_or_that_are_not_finite(self, saved):
        path, model = saved
        given = {"type": "gaussian_texture", "model": path}
        few = mi.TensorXf(np.zeros((2, 2), np.float32))
        with pytest.raises(RuntimeError, match=r"coefficients has shape \(2, 2\), expected \(3, "):
            mi.load_dict({**given, "coefficients": few})
        broken = np.zeros((3, max(model.components)), np.float32)
        broken[:, -1] = np.nan
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
