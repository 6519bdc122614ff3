"""Photos under lights as a material: light from the right side, on every surface and way."""

import drjit as dr
import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.chi_square import assert_density
from _helpers.derivatives import check_gradients
from _helpers.light import to_coded
from _helpers.lit_models import SIZE, LitFormula, to_light
from _helpers.lit_spheres import directions, photos
from _helpers.poster import camera, quad
from _helpers.texture import in_front, mi, picture, texel_centres
from _helpers.variants import in_variants
from eigengs_dr.plugins import material_of, resident_bytes

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

TABLE = 4e-3
"""What the interpolation between directions of the table may cost, of values up to 0.3."""


@pytest.fixture(scope="module")
def formula():
    return LitFormula()


@pytest.fixture(scope="module")
def saved(formula, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "m.npz"
    formula.model().save(path)
    return str(path)


def turn(axis, degrees):
    """A rotation (3, 3)."""
    return np.array(mi.ScalarTransform4f().rotate(axis, degrees).matrix, float)[:3, :3]


def to_uv(matrix):
    """The property of a matrix (2, 3)."""
    return mi.ScalarTransform3f([*np.asarray(matrix, float).tolist(), [0, 0, 1]])


def folded(place, wrap):
    """Where the photo shows a place beyond its borders, and the sign of its axes there."""
    tile = np.floor(place)
    odd = (wrap == "mirror") & (tile % 2 == 1)
    return np.where(odd, 1 - (place - tile), place - tile), np.where(odd, -1, 1)


def values(shape, points, normals, lamps):
    """What a shape, or a scene, reflects (n, 3) at points that are seen along their normals."""
    scene = mi.load_dict({"type": "scene", "shape": shape}) if isinstance(shape, dict) else shape
    origin, towards = (np.float32(a).T for a in (points + 0.5 * normals, -normals))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(towards)))
    assert np.array(si.is_valid()).all()
    light = si.to_local(mi.Vector3f(np.float32(lamps).T))
    return np.array(si.bsdf().eval(mi.BSDFContext(), si, light)).T


def of_a_wall(count):
    """Random uv of a rectangle, its points there, and its normals."""
    uv = np.random.default_rng(1).uniform(0.05, 0.95, (count, 2))
    return uv, np.c_[2 * uv - 1, np.zeros(count)], np.tile([0, 0, 1.0], (count, 1))


def over(normals, seed=2):
    """Random lamps above each surface."""
    lamps = np.random.default_rng(seed).normal(size=normals.shape)
    height = np.einsum("nk,nk->n", lamps, normals)
    lamps += (1.2 * abs(height) - height + 0.3)[:, None] * normals
    return lamps / np.linalg.norm(lamps, axis=1, keepdims=True)


def wanted(formula, place, ex, ey, normals, lamps, wrap="repeat"):
    """The values by NumPy: the photo at `place`, whose columns grow along ex, its rows along ey."""
    uv, sign = folded(place, wrap)
    ex, ey = ex * sign[:, :1], ey * sign[:, 1:]
    x = ex / np.linalg.norm(ex, axis=1, keepdims=True)
    y = -(ey - np.einsum("nk,nk->n", ey, x)[:, None] * x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    lights = np.stack([np.einsum("nk,nk->n", lamps, axis) for axis in (x, y, normals)], 1)
    return to_light(formula.codes(lights, uv)) / np.pi


UPRIGHT = [[1, 0, 0], [0, -1, 1]]
PLANE = np.array([[1, 0], [0, 1], [0, 0.0]])
SHEARED = np.array([[1, 0.5], [0, 0.6], [0, 0.0]])

WALLS = {
    "upright": (PLANE, UPRIGHT, {}),
    "sheared": (SHEARED, [[2, 0.7, 0.3], [-0.4, -1.5, 0.2]], {}),
    "turned, mirrored copies": (SHEARED, [[1.5, -2, 0.8], [2.2, 1.4, -1.2]], {"wrap": "mirror"}),
    "turned over": (PLANE @ np.diag([1, -1]), UPRIGHT, {"flipped": True, "flip_normals": True}),
    "uv mirrored": (PLANE[:, ::-1], [[1, 0, 0], [0, 1, 0]], {}),
    "normals against faces": (SHEARED, UPRIGHT, {"flipped": True, "normals": True}),
    "normal map": (PLANE @ np.diag([1, 2]), [[1, 0.3, 0], [0, -1, 1]], {"map": True}),
}
TURNS = (([1, 2, 3], 200), ([0, 1, 0], 140), ([1, 0, 0], -90))


@pytest.mark.parametrize("name", WALLS)
def test_light_comes_from_the_side_that_the_photo_has_on_a_wall(formula, name, tmp_path):
    matrix, chart, options = WALLS[name]
    axis, degrees = TURNS[len(name) % 3]
    wrap, chart = options.get("wrap", "repeat"), np.array(chart, float)
    matrix = turn(axis, degrees) @ matrix
    bsdf = material_of(formula.model(), wrap_mode=wrap, to_uv=to_uv(chart))
    if "map" in options:
        texels = mi.TensorXf(np.full((4, 4, 3), [0.5, 0.5, 1], np.float32))
        flat = {"type": "bitmap", "data": texels, "raw": True}
        bsdf = {"type": "normalmap", "normalmap": flat, "bsdf": bsdf}
    shape = quad(tmp_path, matrix, options.get("flipped", False), options.get("normals", False))
    shape |= {"bsdf": bsdf, "flip_normals": options.get("flip_normals", False)}
    uv = np.random.default_rng(1).uniform(0.02, 0.98, (200, 2))
    points, side = (2 * uv - 1) @ matrix.T, np.cross(*matrix.T)
    normals = np.tile(side / np.linalg.norm(side), (len(uv), 1))
    lamps, (ex, ey) = over(normals), (2 * matrix @ np.linalg.inv(chart[:, :2])).T
    expected = wanted(
        formula,
        uv @ chart[:, :2].T + chart[:, 2],
        np.tile(ex, (len(uv), 1)),
        np.tile(ey, (len(uv), 1)),
        normals,
        lamps,
        wrap,
    )
    found = values(shape, points, normals, lamps)
    assert np.percentile(abs(found - expected), 98) < TABLE


@pytest.mark.parametrize("flip", [False, True])
def test_light_comes_from_the_side_that_the_photo_has_on_a_sphere(formula, flip):
    """Mitsuba's u goes round the z axis, and v from its top down."""
    r = np.random.default_rng(3)
    turns, polar = r.uniform(0.1, 2 * np.pi - 0.1, 300), r.uniform(0.4, 2.7, 300)
    round_z, down = (np.stack([np.cos(a), np.sin(a)], 1) for a in (turns, polar))
    points = np.c_[down[:, 1:] * round_z, down[:, 0]]
    ex = np.c_[-points[:, 1], points[:, 0], 0 * turns]
    ey = np.c_[down[:, :1] * round_z, -down[:, 1]]
    chart, normals = np.array([[0, 1, 0.2], [2, 0, 0.1]]), -points if flip else points
    uv = np.stack([turns / (2 * np.pi), polar / np.pi], 1)
    lamps = over(normals)
    bsdf = material_of(formula.model(), to_uv=to_uv(chart))
    shape = {"type": "sphere", "bsdf": bsdf, "flip_normals": flip}
    place = uv @ chart[:, :2].T + chart[:, 2]
    expected = wanted(formula, place, ey, ex, normals, lamps)  # the transform swaps u and v
    found = values(shape, points, normals, lamps)
    assert np.percentile(abs(found - expected), 98) < TABLE


def test_planes_may_be_texels(saved):
    _, points, normals = of_a_wall(50)
    bsdf = {"type": "gaussian_relightable", "model": saved}
    found, expected = (
        values({"type": "rectangle", "bsdf": bsdf | more}, points, normals, over(normals))
        for more in ({"texels": 400}, {})
    )
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_an_update_of_to_uv_turns_the_light(saved):
    _, points, normals = of_a_wall(50)
    bsdf = {"type": "gaussian_relightable", "model": saved}
    loaded, changed = (
        mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "bsdf": bsdf | more}})
        for more in ({"to_uv": to_uv(UPRIGHT)}, {})
    )
    parameters = mi.traverse(changed)
    parameters["wall.bsdf.planes.to_uv"] = to_uv(UPRIGHT)
    parameters.update()
    found, expected = (values(s, points, normals, over(normals)) for s in (changed, loaded))
    np.testing.assert_allclose(found, expected, atol=1e-6)


# --- Samples ---


def on_a_wall(count, u, v):
    """Points of a wall, seen from the side."""
    si = in_front(dr.zeros(mi.SurfaceInteraction3f, count))
    si.uv, si.wi = mi.Point2f(u, v), mi.Vector3f(0, 0.6, 0.8)
    return si


def test_samples_have_their_density(saved):
    from mitsuba.chi2 import SphericalDomain

    bsdf = mi.load_dict({"type": "gaussian_relightable", "model": saved})

    def sample(numbers):
        first = mi.Float(dr.arange(mi.UInt32, dr.width(numbers)) % 1000) / 1000
        si = on_a_wall(dr.width(numbers), 0.4, 0.6)
        return bsdf.sample(mi.BSDFContext(), si, first, numbers)[0].wo

    def density(wo):
        return bsdf.pdf(mi.BSDFContext(), on_a_wall(dr.width(wo), 0.4, 0.6), wo)

    assert_density(sample, density, SphericalDomain(), 100_000, 32)


def test_samples_weigh_the_value(saved):
    bsdf, ctx = mi.load_dict({"type": "gaussian_relightable", "model": saved}), mi.BSDFContext()
    first, *others = (mi.Float(k) for k in np.random.default_rng(0).uniform(0, 1, (5, 1000)))
    si = on_a_wall(1000, *others[:2])
    bs, weight = bsdf.sample(ctx, si, first, mi.Point2f(*others[2:]))
    value, density = bsdf.eval(ctx, si, bs.wo), bsdf.pdf(ctx, si, bs.wo)
    np.testing.assert_allclose(np.array(density), np.array(bs.pdf), rtol=1e-4)
    np.testing.assert_allclose(np.array(weight * density), np.array(value), atol=1e-5)
    behind = mi.Vector3f(bs.wo.x, bs.wo.y, -bs.wo.z)
    assert not np.array(bsdf.eval(ctx, si, behind)).any()
    assert not np.array(bsdf.pdf(ctx, si, behind)).any()


# --- Paths from the light ---


def plate(bsdf):
    """Two walls under a lamp, and a slanted camera."""
    look = mi.ScalarTransform4f().look_at
    lamp = look([-1, 2, 2], [0, 0, 0], [0, 0, 1]) @ mi.ScalarTransform4f().scale(0.5)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}
    beside = look([0, -1, 1], [0, 0, 1], [1, 0, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "camera": camera([2, 0.8, 1.0], 12, fov=30, up=[0, 0, 1]),
            "wall": {"type": "rectangle", "bsdf": bsdf},
            "side": {"type": "rectangle", "bsdf": bsdf, "to_world": beside},
            "lamp": {"type": "rectangle", "to_world": lamp, "emitter": light},
        }
    )


def test_integrators_from_the_light_and_from_the_camera_agree(saved):
    scene = plate({"type": "gaussian_relightable", "model": saved})

    def mean(name, spp, **more):
        found = mi.render(scene, integrator=mi.load_dict({"type": name, **more}), spp=spp, seed=1)
        return found.numpy().mean()

    expected = mean("path", 1024)
    for name, spp in (("ptracer", 16384), ("volpath", 1024), ("prb", 1024)):
        assert mean(name, spp) == pytest.approx(expected, rel=0.02), name
    assert mean("direct", 1024) == pytest.approx(mean("path", 1024, max_depth=2), rel=0.02)


# --- Light above white ---


def test_light_above_white_survives_and_what_is_brighter_than_the_photos_does_not(tmp_path):
    formula, brightest = LitFormula(scale=3.0), 2.0
    uv, points, normals = of_a_wall(200)
    lamps = over(normals)
    codes = formula.codes(lamps * [1, -1, 1], uv)
    assert (codes > brightest).any() and ((codes > 1) & (codes < brightest)).any()
    formula.model(brightest).save(tmp_path / "m.npz")
    for bsdf, most in (
        (material_of(formula.model(brightest)), brightest),
        ({"type": "gaussian_relightable", "model": str(tmp_path / "m.npz")}, brightest),
        (material_of(formula.model()), 1),  # of photos that end at white
    ):
        found = values({"type": "rectangle", "bsdf": bsdf}, points, normals, lamps)
        expected = to_light(codes.clip(0, most)) / np.pi
        assert np.percentile(abs(found - expected), 98) < 0.02 * expected.max()


@pytest.mark.parametrize(("scale", "brightest"), [(1.0, 1.0), (3.0, 9.0)])
def test_an_environment_lights_a_model_as_an_envmap_does(scale, brightest):
    """Rows of both go from pole to pole. Photos above white are not clamped to it."""
    model = LitFormula(scale).model(brightest)
    y, x = np.mgrid[:16, :32]
    sky = np.exp(-y / 2) + 0.2 * np.exp(-((x - 11) ** 2 + (y - 9) ** 2) / 8)
    sky = np.float32(sky[..., None] * [2, 1, 0.5])
    bsdf = material_of(model, to_uv=to_uv(UPRIGHT))
    scene = wall_in_light(bsdf, "direct", 16, {"type": "envmap", "bitmap": mi.Bitmap(sky)})
    seen = mi.render(scene, spp=1024).numpy()
    found = eg.render(model.relight(sky), width=16, height=16).numpy()
    np.testing.assert_allclose(found.mean((0, 1)), seen.mean((0, 1)), rtol=0.02)


# --- What is refused ---


def test_vectors_of_dr_jit_that_are_no_direction_are_refused_or_shown_from_the_camera(formula):
    model, nan = formula.model(), float("nan")
    vectors = [mi.Vector3f(0, 0, 0), mi.Vector3f(nan, 0, 1), dr.opaque(mi.Vector3f, 0)]
    vectors += [mi.Vector3f([0, 1], 0, 1), mi.Vector2f(0, 1), mi.TensorXf([0.0, 0, 0])]
    for vector in vectors:
        with pytest.raises(ValueError, match=r"(one|no) direction"):
            model.relight(vector)
    frontal = eg.picture_of(model.relight([0, 0, 1]))
    computed = dr.opaque(mi.Vector3f, 0) * 2  # unknown until a program has run
    assert np.allclose(eg.picture_of(model.relight(computed)), frontal, atol=1e-5)
    assert np.allclose(eg.picture_of(model.relight(mi.TensorXf([0.0, 0, 2]))), frontal, atol=1e-5)


def test_pictures_and_bitmaps_are_environments_of_their_own_encoding(formula):
    model, codes = formula.model(), np.full((8, 16, 3), 128, np.uint8)
    light = to_light(codes / 255)
    expected = eg.picture_of(model.relight(light))
    coded = mi.Bitmap(codes)
    coded.set_srgb_gamma(True)
    for environment in (coded, mi.Bitmap(np.float32(light)), Image.fromarray(codes)):
        found = eg.picture_of(model.relight(environment))
        np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("scale", [float("nan")]),
        ("scale", [-1.0]),
        ("scale", []),
        ("planes.prefilter", [0.1, 0.2]),
        ("planes.prefilter", []),
    ],
)
def test_changes_are_checked_as_properties_are(formula, key, value):
    parameters = mi.traverse(mi.load_dict(material_of(formula.model())))
    parameters["scale"] = mi.Float(3)
    parameters.update()
    parameters[key] = mi.Float(value)
    name = key.split(".")[-1]
    with pytest.raises(ValueError, match=f"gaussian_relightable: {name} (is|holds)") as caught:
        parameters.update()
    assert "\n" not in str(caught.value)


def test_messages_name_the_material(formula, saved):
    flat = mi.ScalarTransform4f().scale([0, 1, 1])
    wrong = [{"wrap_mode": "x"}, {"to_uv": flat}, {"to_uv": 3.0}, {"prefilter": -1.0}, {"a": 1}]
    wrong += [{"memory": "no"}, {"scale": -1.0}, {"light": [0, 0, 1.0]}]
    for properties in wrong:
        for bsdf in (
            {"type": "gaussian_relightable", "model": saved},
            material_of(formula.model()),
        ):
            with pytest.raises(RuntimeError, match="gaussian_relightable: ") as caught:
                mi.load_dict(bsdf | properties)
            assert "gaussian_texture" not in str(caught.value)
    with pytest.raises(RuntimeError, match="gaussian_relightable: give model"):
        mi.load_dict({"type": "gaussian_relightable", "filename": saved})


# --- A model in memory ---


def test_a_model_in_memory_is_the_material_of_its_file(formula, saved):
    _, points, normals = of_a_wall(50)
    lamps = over(normals)
    for options in ({}, {"scale": 2.0, "wrap_mode": "mirror", "to_uv": to_uv(UPRIGHT)}):
        found, expected = (
            values({"type": "rectangle", "bsdf": bsdf}, points, normals, lamps)
            for bsdf in (
                material_of(formula.model(), prefilter=None, **options),
                {"type": "gaussian_relightable", "model": saved, "memory": "exact", **options},
            )
        )
        np.testing.assert_allclose(found, expected, atol=1e-5)
    parameters = mi.traverse(mi.load_dict(material_of(formula.model())))
    assert {"planes.color", "planes.to_uv", "scale"} <= set(parameters.keys())


@pytest.mark.parametrize(
    "change, says", [("lights", "no direction"), ("values", "shape"), ("kind", "kind")]
)
def test_arrays_that_are_no_model_are_refused(formula, change, says):
    bsdf = material_of(formula.model())
    bsdf[change] = "spline" if change == "kind" else bsdf[change] * 0
    if change == "values":
        bsdf[change] = bsdf[change][:3]
    with pytest.raises(RuntimeError, match=f"gaussian_relightable: .*{says}"):
        mi.load_dict(bsdf)
    for nothing in (None, "m.npz", formula.planes):
        with pytest.raises(TypeError, match="takes a Relightable"):
            material_of(nothing)


def test_a_material_counts_its_table(formula):
    bsdf = mi.load_dict(material_of(formula.model()))
    numbers = 32 * 32 * 9  # three colours of two planes and what is added
    counted = resident_bytes(bsdf) - resident_bytes(bsdf.planes)
    assert 4 * numbers <= counted < 8 * numbers  # rows of 9 take 16 in Dr.Jit


# --- Derivatives, polarization, maps of memory ---


@pytest.mark.parametrize(
    ("name", "names"),
    [("wall.bsdf.planes", ["color", "background"]), ("wall.bsdf.reflectance", ["light"])],
)
def test_derivatives_are_finite_differences(saved, name, names):
    """Of the planes of a material, and of a texture by its light."""
    if names == ["light"]:
        texture = {"type": "gaussian_texture", "model": saved, "light": LIGHT}
        bsdf = {"type": "diffuse", "reflectance": texture}
    else:
        bsdf = {"type": "gaussian_relightable", "model": saved}
    check_gradients(wall_in_light(bsdf, "prb"), name, names)


@in_variants(["llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"])
def test_a_material_depolarizes(saved, variant):
    """Beside the light, all parameters of Stokes are 0."""
    stokes = mi.load_dict({"type": "stokes", "inner": {"type": "direct"}})
    scene = wall_in_light({"type": "gaussian_relightable", "model": saved}, "direct")
    seen = mi.render(scene, integrator=stokes, spp=16, seed=1).numpy()
    shown, total, others = np.split(seen, [-12, -9], axis=2)  # three channels per parameter
    assert shown.mean() > 0.01 and not others.any()
    np.testing.assert_allclose(total, np.broadcast_to(shown, total.shape), rtol=1e-3, atol=1e-4)


def test_a_file_loses_little(formula, saved):
    """Rows of 8 words instead of 12 numbers, and no parameters: 9 numbers."""
    file = {"type": "gaussian_relightable", "model": saved}
    coded, exact = (mi.load_dict({**file, "memory": name}) for name in ("normal", "exact"))
    held = resident_bytes(exact) - resident_bytes(coded)
    number = len(formula.planes)
    assert held >= 32 * number
    si = in_front(texel_centres(SIZE))
    towards = mi.Vector3f(0.3, -0.2, 0.9)
    values = [picture(one.eval(mi.BSDFContext(), si, towards), SIZE) for one in (coded, exact)]
    np.testing.assert_allclose(*values, atol=0.01)
    assert np.abs(values[0]).max() > 0.1


# --- A texture that shows one light ---


LIGHT = [0.3, -0.4, 0.8]


def wall_in_light(bsdf, integrator, side=12, light=None):
    """A wall that fills the picture of a camera in front of it, by default under a lamp."""
    film = {"type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    film["rfilter"] = {"type": "box"}
    lamp = {"type": "directional", "direction": [-0.3, -0.4, -0.8], "irradiance": np.pi}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "lamp": light or lamp,
            "wall": {"type": "rectangle", "bsdf": bsdf},
            "camera": {"type": "orthographic", "to_world": view, "film": film},
        }
    )


def test_a_wall_under_a_lamp_looks_like_a_photo(formula, saved):
    scene = wall_in_light({"type": "gaussian_relightable", "model": saved}, "direct", 24)
    shown = mi.render(scene, spp=64).numpy()[::-1]  # row 0 lies at v = 0, the bottom of the wall
    photo = eg.render(formula.model().relight(LIGHT), width=24, height=24).numpy().clip(0, 1)
    assert eg.psnr(to_coded(shown.clip(0, 1)), photo) > 30


class TestTexture:
    def test_shows_the_model_under_its_light(self, formula, saved):
        texture = mi.load_dict({"type": "gaussian_texture", "model": saved, "light": LIGHT})
        parameters = mi.traverse(texture)
        assert [key for key, _ in parameters] == ["light", "to_uv", "prefilter"]
        for light in (LIGHT, [-3.0, 2.0, 9.0]):
            parameters["light"] = mi.Vector3f(*light)
            parameters.update()
            found = picture(texture.eval_3(texel_centres(SIZE)), SIZE)
            expected = eg.picture_of(formula.model().relight(light)).clip(0, 1)
            np.testing.assert_allclose(found, to_light(expected), atol=1e-3)

    def test_a_light_that_an_optimiser_spoilt_is_that_of_the_camera(self, saved):
        texture = mi.load_dict({"type": "gaussian_texture", "model": saved, "memory": "exact"})
        expected = picture(texture.eval_3(texel_centres(SIZE)), SIZE)
        parameters = mi.traverse(texture)
        for light in ([np.nan, 0, 1], [0, 0, 0]):
            parameters["light"] = mi.Vector3f(*light)
            parameters.update()
            found = picture(texture.eval_3(texel_centres(SIZE)), SIZE)
            np.testing.assert_array_equal(found, expected)

    def test_lights_that_are_refused(self, saved):
        for light, says in (([0, 0, -1.0], "below the horizon"), ([0, 0, 0.0], "no direction")):
            with pytest.raises(RuntimeError, match=says):
                mi.load_dict({"type": "gaussian_texture", "model": saved, "light": light})


@pytest.mark.slow
def test_one_plane_is_a_plane():
    """As two are, which of another texture would be those of normals, and get a third."""
    lights = directions(8)
    model = eg.Relightable.fit(photos(lights), lights, gaussians=8, planes=1, iterations=0)
    texture = mi.load_dict(material_of(model))
    si = in_front(texel_centres((24, 24)))
    found = picture(texture.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1)), (24, 24))
    expected = eg.picture_of(model.relight([0, 0, 1])).clip(0, 1)
    np.testing.assert_allclose(found, to_light(expected) / np.pi, atol=5e-3)
