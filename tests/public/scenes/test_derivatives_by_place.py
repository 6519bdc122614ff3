"""Derivatives by what moves a picture under a prefilter: finite differences of the rendering.

Gaussians end at their cutoff, and an end has no derivative: some percent may be missing.
"""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.lit_models import LitFormula
from _helpers.poster import camera, quad
from _helpers.skies import sky
from _helpers.texture import at, in_front, mi
from eigengs_dr.plugins import environment_of, follow, material_of, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

EXACT, PYRAMID = 0.05, 0.2
"""Angles in radians: exact sums, then lookups of the pyramid."""

STEP = 0.01


def gaussians(count=100, size=(32, 32)):
    rng = np.random.default_rng(1)
    a, c = rng.uniform(0.25, 0.5, (2, count))
    factor = np.stack([a, rng.uniform(-0.1, 0.1, count), c], axis=1)
    return eg.Gaussians.from_arrays(
        rng.uniform(0, size, (count, 2)),
        factor,
        rng.uniform(-0.12, 0.12, (count, 3)),
        np.full(3, 0.45),
        size=size,
        space="linear",
    )


@pytest.fixture
def square(tmp_path):
    """A square whose sides are those of the picture."""
    return quad(tmp_path, np.array([[1, 0], [0, 1], [0, 0.0]]))


def scene_of(square, surface, integrator="direct"):
    """A square with a material or an emitter, under a lamp."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "lamp": {"type": "point", "position": [0.5, 0.3, 3], "intensity": 10.0},
            "wall": {**square, **surface},
            "camera": camera([0.3, 0.2, 3.5], 10, fov=28),
        }
    )


def painted(**properties):
    """A texture that goes beyond all borders of its picture."""
    beyond = mi.ScalarTransform3f().translate([-0.4, -0.4]).scale(1.9)
    reflectance = texture_of(gaussians(), to_uv=beyond, **properties)
    return {"bsdf": {"type": "diffuse", "reflectance": reflectance}}


def ratios(scene, key, move, modes=("backward", "forward")):
    """The derivative along `move` in each mode, over finite differences: both as pictures."""
    parameters = mi.traverse(scene)
    start = type(parameters[key])(parameters[key])

    def picture(t):
        parameters[key] = move(start, t)
        parameters.update()
        return mi.render(scene, parameters, spp=256, seed=3)

    ahead, behind = (np.array(picture(mi.Float(t)), np.float64) for t in (STEP, -STEP))
    wanted = (ahead - behind) / (2 * STEP)
    found = []
    for mode in modes:
        t = mi.Float(0)
        dr.enable_grad(t)
        if mode == "backward":
            dr.backward(dr.sum(picture(t) * mi.TensorXf(np.float32(wanted)), axis=None))
            found.append(dr.grad(t)[0])
        else:
            shown = picture(t)
            dr.forward(t)
            found.append((np.array(dr.grad(shown), np.float64) * wanted).sum())
        picture(mi.Float(0))  # else the scene keeps the graph of t
    return np.array(found) / np.square(wanted).sum()


def assert_close(found):
    assert ((found > 0.95) & (found < 1.05)).all(), found


def slide(uv, t):
    return uv + mi.Float([1, 0.3] * 4) * t


MOVES = {
    "uv": ("wall.vertex_texcoords", slide),
    "zoom of uv": ("wall.vertex_texcoords", lambda uv, t: uv * (1 + t)),
    "vertices": ("wall.vertex_positions", lambda at, t: at + mi.Float([1, 0.3, 0] * 4) * t),
    "camera": (
        "camera.to_world",
        lambda view, t: view @ mi.Transform4f().translate(mi.Vector3f(t, 0.3 * t, t)),
    ),
}


class TestTexture:
    @pytest.mark.parametrize(
        ("what", "prefilter", "wrap", "integrator"),
        [
            ("uv", EXACT, "repeat", "direct"),
            ("uv", EXACT, "clamp", "prb"),
            pytest.param("zoom of uv", PYRAMID, "repeat", "direct", marks=pytest.mark.slow),
            ("vertices", EXACT, "repeat", "direct"),
            ("camera", EXACT, "repeat", "direct"),
        ],
    )
    def test_derivative_by_what_moves(self, square, what, prefilter, wrap, integrator):
        scene = scene_of(square, painted(prefilter=prefilter, wrap_mode=wrap), integrator)
        assert_close(ratios(scene, *MOVES[what]))

    def test_light_of_a_surface_that_follows_a_camera(self, square):
        radiance = texture_of(gaussians(), prefilter=True)
        scene = scene_of(square, {"emitter": {"type": "area", "radiance": radiance}})
        follow(scene)
        assert_close(ratios(scene, *MOVES["uv"]))


@pytest.mark.slow
def test_material_of_lights(square):
    bsdf = material_of(LitFormula().model(), prefilter=0.2)
    assert_close(ratios(scene_of(square, {"bsdf": bsdf}), *MOVES["uv"]))


def interactions(uv):
    """Surfaces seen at a right angle from a distance of 1."""
    return in_front(at(uv.x, uv.y))


def points(count=400):
    return np.random.default_rng(0).uniform(-0.5, 1.5, (2, count)).astype(np.float32)


class TestLookupAlone:
    """Lookups without a scene, where Dr.Jit records nothing."""

    @staticmethod
    def check(looked_up, start, modes):
        """Compare with differences, which may step over an end of a Gaussian: the median does not
        see it."""
        ahead, behind = (np.array(looked_up(mi.Float(start + s))) for s in (1e-3, -1e-3))
        wanted = (ahead - behind) / 2e-3
        for mode in modes:
            t = mi.Float(np.float32(start))
            dr.enable_grad(t)
            value = looked_up(t)
            (dr.forward if mode == "forward" else dr.backward)(t if mode == "forward" else value)
            found = np.array(dr.grad(value if mode == "forward" else t))
            assert np.median(np.abs(found - wanted)) < 0.005 * np.abs(wanted).mean()
        return found, wanted

    @pytest.mark.parametrize(
        ("wrap", "prefilter"), [("repeat", 0.3), ("mirror", 0.1), ("clamp", 0.01)]
    )
    def test_slope_at_points(self, wrap, prefilter):
        texture = mi.load_dict(texture_of(gaussians(), prefilter=prefilter, wrap_mode=wrap))
        x, y = points()

        def looked_up(x):
            return texture.eval_3(interactions(mi.Point2f(x, mi.Float(y)))).x

        found, wanted = self.check(looked_up, x, ["forward", "backward"])
        if prefilter == 0.3:  # wide footprints see sums of Gaussians without ends
            assert 0.99 < (found * wanted).sum() / np.square(wanted).sum() < 1.01

    def test_derivative_by_the_prefilter(self):
        texture = mi.load_dict(texture_of(gaussians(), prefilter=0.05))
        parameters, uv = mi.traverse(texture), mi.Point2f(*map(mi.Float, points()))

        def looked_up(angle):
            parameters["prefilter"] = angle
            parameters.update()
            return texture.eval_3(interactions(uv)).x

        self.check(looked_up, 0.05, ["forward"])

    @pytest.mark.parametrize(("moves", "prefilter"), [("first", 0.05), ("second", 0.0)])
    def test_one_of_two_lookups_of_a_program(self, moves, prefilter):
        """A recorded program looks the same points up twice, once without derivatives."""
        texture = mi.load_dict(texture_of(gaussians(), prefilter=prefilter))
        x, y = map(mi.Float, points())

        def twice(i, x, total):
            moving, still = (interactions(mi.Point2f(u, y)) for u in (x, dr.detach(x)))
            pair = (moving, still) if moves == "first" else (still, moving)
            first, second = (texture.eval_3(si).x for si in pair)
            return i + 1, x, total + first + 3 * second

        def summed(x):
            state = mi.UInt32(0), x, dr.zeros(mi.Float, dr.width(x))
            return dr.while_loop(state, lambda i, *rest: i < 1, twice, mode="symbolic")[2]

        dr.enable_grad(x)
        total = summed(x)
        dr.forward(x)
        alone = mi.Float(dr.detach(x))
        dr.enable_grad(alone)
        value = texture.eval_3(interactions(mi.Point2f(alone, y))).x
        dr.forward(alone)
        factor = 1 if moves == "first" else 3
        wanted = factor * np.array(dr.grad(value))
        np.testing.assert_allclose(np.array(dr.grad(total)), wanted, rtol=1e-3, atol=1e-4)


class TestEnvironment:
    @pytest.mark.parametrize("integrator", [pytest.param("path", marks=pytest.mark.slow), "prb"])
    def test_turned_in_a_scene(self, integrator):
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": integrator},
                "sky": environment_of(sky(), prefilter=0.1),
                "camera": camera([0, 0, 0], 10, fov=60, target=[1, 0.2, 0.3]),
            }
        )

        def turn(to_world, t):
            return to_world @ mi.Transform4f().rotate(mi.Vector3f(0, 1, 0), 20 * t)

        assert_close(ratios(scene, "sky.to_world", turn))
        if integrator != "prb":  # it has no derivatives by a camera
            assert_close(ratios(scene, "camera.to_world", turn))
