"""Derivatives by what moves a picture under a prefilter: finite differences of the rendering.

Gaussians end at their cutoff, and an end has no derivative: some percent may be missing.
"""

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")

import eigengs_dr as eg  # noqa: E402
from _helpers.lit_spheres import directions, photos  # noqa: E402
from eigengs_dr.plugins import environment_of, follow, texture_of  # noqa: E402

pytestmark = pytest.mark.mitsuba

PREFILTERS = [0.05, pytest.param(0.1, marks=pytest.mark.slow), 0.2]
"""Angles in radians: exact sums, then lookups of the pyramid."""

STEP = 0.01

CORNERS = [(-1, -1), (1, -1), (1, 1), (-1, 1)]


@pytest.fixture(scope="module", autouse=True)
def variant():
    """One variant for the module."""
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    yield
    if before:
        mi.set_variant(before)


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


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    """The path of a square whose uv goes beyond all borders of the picture."""
    path = tmp_path_factory.mktemp("mesh") / "square.ply"
    low, high = -0.4, 1.5
    rows = [f"{x} {y} 0 {low if x < 0 else high} {low if y < 0 else high}" for x, y in CORNERS]
    numbers = "\n".join(f"property float {k}" for k in "xyzuv")
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 4\n{numbers}\nelement face 2\n"
        "property list uchar int vertex_indices\nend_header\n"
        + "\n".join([*rows, "3 0 1 2", "3 0 2 3", ""])
    )
    return str(path)


def looking(origin, target, fov=28.0):
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": 10,
            "height": 10,
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
    }


def scene_of(square, surface, integrator="direct"):
    """A square with a material or an emitter, under a lamp."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "lamp": {"type": "point", "position": [0.5, 0.3, 3], "intensity": 10.0},
            "wall": {"type": "ply", "filename": square, **surface},
            "camera": looking([0.3, 0.2, 3.5], [0, 0, 0]),
        }
    )


def painted(**properties):
    return {"bsdf": {"type": "diffuse", "reflectance": texture_of(gaussians(), **properties)}}


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
        lambda view, t: view @ mi.Transform4f().translate(mi.Vector3f(t, 0.3 * t, 0)),
    ),
    "nearer camera": (
        "camera.to_world",
        lambda view, t: view @ mi.Transform4f().translate(mi.Vector3f(0, 0, t)),
    ),
}


class TestTexture:
    @pytest.mark.parametrize("prefilter", PREFILTERS)
    @pytest.mark.parametrize("what", MOVES)
    def test_derivative_by_what_moves(self, square, what, prefilter):
        scene = scene_of(square, painted(prefilter=prefilter))
        assert_close(ratios(scene, *MOVES[what]))

    @pytest.mark.parametrize("integrator", ["path", "prb"])
    @pytest.mark.parametrize("prefilter", [0.05, 0.2])
    def test_other_integrators(self, square, integrator, prefilter):
        scene = scene_of(square, painted(prefilter=prefilter), integrator)
        assert_close(ratios(scene, *MOVES["uv"]))

    @pytest.mark.parametrize("prefilter", PREFILTERS)
    @pytest.mark.parametrize("wrap", ["mirror", "clamp"])
    def test_borders(self, square, wrap, prefilter):
        scene = scene_of(square, painted(prefilter=prefilter, wrap_mode=wrap))
        assert_close(ratios(scene, *MOVES["uv"]))

    @pytest.mark.parametrize("memory", ["normal", "small"])
    def test_file_in_each_memory(self, square, memory, tmp_path):
        gaussians().save(tmp_path / "set.npz")
        texture = {"type": "gaussian_texture", "filename": str(tmp_path / "set.npz")}
        texture |= {"memory": memory, "prefilter": 0.05}
        scene = scene_of(square, {"bsdf": {"type": "diffuse", "reflectance": texture}})
        assert_close(ratios(scene, *MOVES["uv"], modes=["backward"]))

    @pytest.mark.parametrize("integrator", ["direct", "prb"])
    def test_light_of_a_surface(self, square, integrator):
        radiance = texture_of(gaussians(), prefilter=0.1)
        scene = scene_of(square, {"emitter": {"type": "area", "radiance": radiance}}, integrator)
        assert_close(ratios(scene, *MOVES["uv"]))

    def test_texture_that_follows_a_camera(self, square):
        scene = scene_of(square, painted(prefilter=True))
        follow(scene)
        assert_close(ratios(scene, *MOVES["uv"]))

    def test_derivative_by_colours_too(self, square):
        """With derivatives by place beside them, those by the parameters stay what they were."""
        scene = scene_of(square, painted(prefilter=0.1))
        parameters = mi.traverse(scene)
        color, uv = "wall.bsdf.reflectance.color", "wall.vertex_texcoords"
        found = []
        for keys in ([color], [color, uv]):
            for key in keys:
                parameters[key] = type(parameters[key])(dr.detach(parameters[key]))
                dr.enable_grad(parameters[key])
            parameters.update()
            dr.backward(dr.sum(mi.render(scene, parameters, spp=16, seed=3), axis=None))
            found.append(np.array(dr.grad(parameters[color])))
        np.testing.assert_allclose(found[1], found[0], rtol=1e-3, atol=1e-4 * np.abs(found).max())


def lit(square, tmp_path, **properties):
    lights = directions(12)
    eg.Relightable.fit(photos(lights), lights, gaussians=60, iterations=40).save(tmp_path / "m.egs")
    material = {"type": "gaussian_relightable", "model": str(tmp_path / "m.egs"), **properties}
    return scene_of(square, {"bsdf": material})


@pytest.mark.parametrize("prefilter", [0.05, 0.2])
def test_material_of_lights(square, tmp_path, prefilter):
    assert_close(ratios(lit(square, tmp_path, prefilter=prefilter), *MOVES["uv"]))


def interactions(uv):
    """Surfaces seen at a right angle from a distance of 1."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
    si.uv, si.wi, si.t = uv, mi.Vector3f(0, 0, 1), mi.Float(1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    return si


def points(count=400):
    return np.random.default_rng(0).uniform(-0.5, 1.5, (2, count)).astype(np.float32)


class TestLookupAlone:
    """Lookups without a scene, where Dr.Jit records nothing."""

    @pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
    @pytest.mark.parametrize("prefilter", [0.01, 0.1, 0.3])
    def test_slope_at_points(self, wrap, prefilter):
        texture = mi.load_dict(texture_of(gaussians(), prefilter=prefilter, wrap_mode=wrap))
        x, y = points()

        def looked_up(t):
            return texture.eval_3(interactions(mi.Point2f(mi.Float(x) + t, mi.Float(y)))).x

        ahead, behind = (np.array(looked_up(mi.Float(t))) for t in (1e-3, -1e-3))
        wanted = (ahead - behind) / 2e-3
        for mode in ("forward", "backward"):
            t = dr.zeros(mi.Float, len(x))
            dr.enable_grad(t)
            value = looked_up(t)
            (dr.forward if mode == "forward" else dr.backward)(t if mode == "forward" else value)
            found = np.array(dr.grad(value if mode == "forward" else t))
            # Differences may step over an end of a Gaussian: the median does not see it.
            assert np.median(np.abs(found - wanted)) < 0.005 * np.abs(wanted).mean()

    def test_wide_footprints_lack_no_slope(self):
        """Wide footprints see sums of Gaussians without ends."""
        texture = mi.load_dict(texture_of(gaussians(), prefilter=0.2))
        x, y = points()
        t = mi.Float(0)
        dr.enable_grad(t)

        def looked_up(t):
            return texture.eval_3(interactions(mi.Point2f(mi.Float(x) + t, mi.Float(y)))).x

        value = looked_up(t)
        dr.forward(t)
        ahead, behind = (np.array(looked_up(mi.Float(t))) for t in (STEP, -STEP))
        wanted = (ahead - behind) / (2 * STEP)
        ratio = (np.array(dr.grad(value)) * wanted).sum() / np.square(wanted).sum()
        assert 0.99 < ratio < 1.01

    def test_derivative_by_the_prefilter(self):
        texture = mi.load_dict(texture_of(gaussians(), prefilter=0.05))
        parameters = mi.traverse(texture)
        uv = mi.Point2f(*map(mi.Float, points()))

        def looked_up(angle):
            parameters["prefilter"] = angle
            parameters.update()
            return texture.eval_3(interactions(uv)).x

        angle = mi.Float(0.05)
        dr.enable_grad(angle)
        value = looked_up(angle)
        dr.forward(angle)
        found = np.array(dr.grad(value))
        ahead, behind = (np.array(looked_up(mi.Float(0.05 + s))) for s in (1e-3, -1e-3))
        wanted = (ahead - behind) / 2e-3
        assert np.median(np.abs(found - wanted)) < 0.005 * np.abs(wanted).mean()

    @pytest.mark.parametrize("prefilter", [0.0, 0.05, 0.3])
    @pytest.mark.parametrize("moves", ["first", "second"])
    def test_one_of_two_lookups_of_a_program(self, prefilter, moves):
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
    def sky(self):
        """Light that is even at the poles and across the seam."""
        rng = np.random.default_rng(2)
        mean = rng.uniform([12, 8], [52, 24], (60, 2))
        color = rng.uniform(0.1, 1, (60, 3))
        factor = np.tile([0.4, 0.05, 0.35], (60, 1))
        return eg.Gaussians.from_arrays(
            mean, factor, color, np.ones(3), size=(64, 32), space="radiance"
        )

    @pytest.mark.parametrize("prefilter", [0.05, 0.2, 0.5])
    def test_directions(self, prefilter):
        sky = mi.load_dict(environment_of(self.sky(), prefilter=prefilter, scale=2.0))
        rng = np.random.default_rng(0)
        towards = rng.normal(size=(3, 1000)).astype(np.float32)
        towards /= np.linalg.norm(towards, axis=0)
        aside = np.cross(towards.T, [0.3, 0.5, -0.2]).T.astype(np.float32)

        def light(t):
            si = dr.zeros(mi.SurfaceInteraction3f, towards.shape[1])
            si.wi = -(mi.Vector3f(*map(mi.Float, towards)) + t * mi.Vector3f(*map(mi.Float, aside)))
            return sky.eval(si).x

        ahead, behind = (np.array(light(mi.Float(t))) for t in (STEP, -STEP))
        wanted = (ahead - behind) / (2 * STEP)
        t = mi.Float(0)
        dr.enable_grad(t)
        value = light(t)
        dr.forward(t, flags=dr.ADFlag.ClearVertices)
        forward = (np.array(dr.grad(value)) * wanted).sum()
        dr.set_grad(t, 0)
        dr.backward(dr.sum(light(t) * mi.Float(np.float32(wanted))))
        assert_close(np.array([forward, dr.grad(t)[0]]) / np.square(wanted).sum())

    @pytest.mark.parametrize("integrator", ["direct", "path", "prb"])
    def test_turned_in_a_scene(self, integrator):
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": integrator},
                "sky": environment_of(self.sky(), prefilter=0.1),
                "camera": looking([0, 0, 0], [1, 0.2, 0.3], 60),
            }
        )

        def turn(to_world, t):
            return to_world @ mi.Transform4f().rotate(mi.Vector3f(0, 1, 0), 20 * t)

        assert_close(ratios(scene, "sky.to_world", turn))
        if integrator != "prb":  # it has no derivatives by a camera
            assert_close(ratios(scene, "camera.to_world", turn))
