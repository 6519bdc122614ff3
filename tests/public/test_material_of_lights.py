"""Photos under lights as a material: light from the right side, on every surface and way."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.lit_models import SIZE, LitFormula, to_light
from _helpers.packed import few_groups

mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
dr = pytest.importorskip("drjit")

from eigengs_dr.plugins import environment_of, material_of, resident_bytes  # noqa: E402

pytestmark = pytest.mark.mitsuba

TABLE = 4e-3
"""What the interpolation between directions of the table may cost, of values up to 0.3."""


@pytest.fixture(autouse=True, scope="module")
def llvm():
    """A variant with the plugins."""
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    yield
    if before:
        mi.set_variant(before)


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


def quad(folder, matrix, flipped=False, normals=False):
    """A parallelogram, its corners `matrix` times (2 u - 1, 2 v - 1); faces may be turned over."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    normal = np.cross(*matrix.T)
    order = [1, 4, 3, 2] if flipped else [1, 2, 3, 4]
    lines = [f"v {x} {y} {z}" for x, y, z in (2 * corners - 1) @ matrix.T]
    lines += [f"vt {u} {v}" for u, v in corners]
    lines += [f"vn {normal[0]} {normal[1]} {normal[2]}"] if normals else []
    names = [f"{k}/{k}/1" if normals else f"{k}/{k}" for k in order]
    lines += [f"f {names[0]} {names[k]} {names[k + 1]}" for k in (1, 2)]
    path = folder / "quad.obj"
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path), "flip_tex_coords": False}


def values(shape, points, normals, lamps):
    """What a shape reflects (n, 3) at points that are seen along their normals, and the hit."""
    scene = mi.load_dict({"type": "scene", "shape": shape})
    origin, towards = (np.float32(a).T for a in (points + 0.5 * normals, -normals))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(towards)))
    assert np.array(si.is_valid()).all()
    light = si.to_local(mi.Vector3f(np.float32(lamps).T))
    return np.array(si.bsdf().eval(mi.BSDFContext(), si, light)).T


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
    "a quarter turn": (PLANE, [[0, -1, 1], [1, 0, 0]], {}),
    "scaled unequally": (PLANE, [[3, 0, 0.2], [0, -0.5, 0.1]], {}),
    "sheared": (SHEARED, [[2, 0.7, 0.3], [-0.4, -1.5, 0.2]], {}),
    "mirrored copies": (PLANE, [[2.6, 0, -0.8], [0, -3.3, 1.2]], {"wrap": "mirror"}),
    "turned, mirrored copies": (SHEARED, [[1.5, -2, 0.8], [2.2, 1.4, -1.2]], {"wrap": "mirror"}),
    "turned over": (PLANE @ np.diag([1, -1]), UPRIGHT, {"flipped": True, "flip_normals": True}),
    "uv mirrored": (PLANE[:, ::-1], [[1, 0, 0], [0, 1, 0]], {}),
    "normals against faces": (SHEARED, UPRIGHT, {"flipped": True, "normals": True}),
    "normal map": (PLANE @ np.diag([1, 2]), [[1, 0.3, 0], [0, -1, 1]], {"map": True}),
}
TURNS = (([1, 2, 3], 200), ([0, 1, 0], 140), ([1, 0, 0], -90))


@pytest.mark.parametrize("name", WALLS)
@pytest.mark.parametrize("axis, degrees", TURNS)
def test_light_comes_from_the_side_that_the_photo_has_on_a_wall(
    formula, name, axis, degrees, tmp_path
):
    matrix, chart, options = WALLS[name]
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


def test_an_update_of_to_uv_turns_the_light(saved):
    lamps = over(np.tile([0, 0, 1.0], (50, 1)))
    points = np.c_[np.random.default_rng(5).uniform(-0.9, 0.9, (50, 2)), np.zeros(50)]
    bsdf = {"type": "gaussian_relightable", "model": saved}

    def seen(scene):
        origin = mi.Point3f(np.float32(points + np.array([0, 0, 1])).T)
        si = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))
        light = si.to_local(mi.Vector3f(np.float32(lamps).T))
        return np.array(si.bsdf().eval(mi.BSDFContext(), si, light))

    loaded, changed = (
        mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "bsdf": bsdf | more}})
        for more in ({"to_uv": to_uv(UPRIGHT)}, {})
    )
    parameters = mi.traverse(changed)
    parameters["wall.bsdf.planes.to_uv"] = to_uv(UPRIGHT)
    parameters.update()
    np.testing.assert_allclose(seen(changed), seen(loaded), atol=1e-6)


# --- Paths from the light ---


def plate(bsdf, integrator="path", side=12):
    """A wall under a lamp and a slanted camera, and what else lights it."""
    look = mi.ScalarTransform4f().look_at
    film = {"type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb"}
    film["rfilter"] = {"type": "box"}
    lamp = look([-1, 2, 2], [0, 0, 0], [0, 0, 1]) @ mi.ScalarTransform4f().scale(0.5)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}
    beside = look([0, -1, 1], [0, 0, 1], [1, 0, 0])
    view = look([2, 0.8, 1.0], [0, 0, 0], [0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "camera": {"type": "perspective", "fov": 30, "to_world": view, "film": film},
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


def test_in_light_tracing_the_value_is_that_for_the_light_times_the_ratio_of_cosines(saved):
    bsdf, count = mi.load_dict({"type": "gaussian_relightable", "model": saved}), 200
    radiance, importance = (mi.BSDFContext(mode) for mode in mi.TransportMode.__members__.values())
    r = np.random.default_rng(0)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv = mi.Point2f(r.uniform(0, 1, (2, count)))
    one, other = (
        mi.Vector3f(np.float32(over(np.tile([0, 0, 1.0], (count, 1)), k)).T) for k in (1, 2)
    )
    swapped = mi.SurfaceInteraction3f(si)
    si.wi, swapped.wi = one, other
    expected = bsdf.eval(radiance, swapped, one) * (other.z / one.z)
    np.testing.assert_allclose(bsdf.eval(importance, si, other), expected, rtol=1e-4)
    numbers = mi.Float(r.uniform(0, 1, count)), mi.Point2f(r.uniform(0, 1, (2, count)))
    bs, weight = bsdf.sample(importance, si, *numbers)
    density = bsdf.pdf(importance, si, bs.wo)
    np.testing.assert_allclose(bs.pdf, density, rtol=1e-4)
    np.testing.assert_allclose(
        np.array(weight * density), np.array(bsdf.eval(importance, si, bs.wo)), rtol=1e-3, atol=1e-6
    )
    si.wi = mi.Vector3f(one.x, one.y, -one.z)  # one side only
    assert not np.array(bsdf.eval(importance, si, other)).any()


# --- Light above white ---


def test_light_above_white_survives_and_what_is_brighter_than_the_photos_does_not(tmp_path):
    formula, brightest = LitFormula(scale=3.0), 2.0
    uv = np.random.default_rng(1).uniform(0.05, 0.95, (200, 2))
    points, normals = np.c_[2 * uv - 1, np.zeros(200)], np.tile([0, 0, 1.0], (200, 1))
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


def test_an_environment_of_a_model_of_bright_photos_is_not_clamped():
    formula = LitFormula(scale=3.0)
    shown = [
        eg.render(formula.model(most).relight(np.ones((16, 32, 3)))).numpy() for most in (1, 9)
    ]
    lights = np.random.default_rng(0).normal(size=(4000, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    lights[:, 2] = abs(lights[:, 2])
    middle = np.tile([[8.5 / SIZE[0], 6.5 / SIZE[1]]], (len(lights), 1))
    expected = 2 * to_light(formula.codes(lights, middle)).mean(axis=0)  # 2 pi / pi
    np.testing.assert_allclose(shown[1][6, 8], expected, rtol=0.05)
    assert shown[0].mean() < 0.8 * shown[1].mean()


@few_groups()
def test_a_fit_knows_how_bright_its_photos_are(tmp_path):
    formula = LitFormula()
    lights = np.random.default_rng(0).normal(size=(12, 3))
    lights[:, 2] = 0.5 + abs(lights[:, 2])
    model = formula.model()
    photos = np.stack([eg.render(model.relight(light)).numpy() for light in lights])
    for factor in (1, 1.4 / photos.max()):
        options = {"gaussians": 30, "planes": 2, "iterations": 2, "progress": False}
        fitted = eg.Relightable.fit(factor * photos, lights, encoding="srgb", **options)
        assert fitted.brightest == pytest.approx(max(1, factor * photos.max()), rel=1e-5)
        for name in ("m.npz", "m.egs"):
            fitted.save(tmp_path / name) if name == "m.npz" else eg.pack(fitted, tmp_path / name)
            assert eg.Relightable.load(tmp_path / name).brightest == pytest.approx(fitted.brightest)


def test_an_environment_lights_a_model_as_an_envmap_does(formula):
    """Rows of both go from pole to pole."""
    y, x = np.mgrid[:16, :32]
    sky = np.exp(-y / 2) + 0.2 * np.exp(-((x - 11) ** 2 + (y - 9) ** 2) / 8)
    sky = np.float32(sky[..., None] * [2, 1, 0.5])
    view = mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb"}
    film["rfilter"] = {"type": "box"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "camera": {"type": "orthographic", "to_world": view, "film": film},
            "wall": {
                "type": "rectangle",
                "bsdf": material_of(formula.model(), to_uv=to_uv(UPRIGHT)),
            },
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        }
    )
    seen = mi.render(scene, spp=1024).numpy()
    found = eg.render(formula.model().relight(sky), width=16, height=16).numpy()
    np.testing.assert_allclose(found.mean((0, 1)), seen.mean((0, 1)), rtol=0.02)


# --- What is refused ---


@pytest.mark.parametrize(
    "light, error, says",
    [
        ("lights", ValueError, "one direction.*environment"),
        ("row", ValueError, "one direction"),
        ([[0, 0, 1.0]], ValueError, "one direction"),
        (np.ones((8, 16)), ValueError, r"image \(h, w, 3\)"),
        ([0, 1], ValueError, "shape"),
        (None, TypeError, "type NoneType"),
        ([None] * 3, TypeError, "type list"),
        (iter([0, 0, 1]), TypeError, "iterator"),
        (["0", "0", "1"], TypeError, "type list"),
        ([1j, 0, 1], TypeError, "type list"),
        (b"sky.exr", TypeError, "type bytes"),
        ([[0, 0], [1]], TypeError, "type list"),
        (-np.ones((8, 16, 3)), ValueError, "light is -1 somewhere"),
        (np.full((8, 16, 3), np.nan), ValueError, "not finite"),
        (np.full((8, 16, 3), np.inf), ValueError, "not finite"),
    ],
)
def test_what_is_neither_a_direction_nor_an_environment_is_refused(formula, light, error, says):
    model = formula.model()
    names = {"lights": model.lights, "row": model.lights[:1]}
    light = names.get(light, light) if isinstance(light, str) else light
    with pytest.raises(error, match=says) as caught:
        model.relight(light)
    assert "\n" not in str(caught.value)


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
    for environment in (coded, mi.Bitmap(np.float32(light))):
        found = eg.picture_of(model.relight(environment))
        np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.parametrize("value", [[float("nan")], [-1.0], [float("inf")], [1.0, 2.0], []])
@pytest.mark.parametrize("kind", ["material", "environment"])
def test_a_change_of_scale_is_checked_as_the_property_is(formula, kind, value):
    options = {"size": (16, 8), "space": "log"}
    sky = eg.Gaussians.from_arrays([[4, 4]], [[0.5, 0, 0.5]], [[1, 0.5, 0.2]], [0.4] * 3, **options)
    plugin = material_of(formula.model()) if kind == "material" else environment_of(sky)
    parameters = mi.traverse(mi.load_dict(plugin))
    parameters["scale"] = mi.Float(3)
    parameters.update()
    parameters["scale"] = mi.Float(value)
    with pytest.raises(ValueError, match=rf"{plugin['type']}: scale (is|holds).*must") as caught:
        parameters.update()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [[0.1, 0.2], []])
def test_a_prefilter_of_several_numbers_is_refused(formula, value):
    parameters = mi.traverse(mi.load_dict(material_of(formula.model())))
    parameters["planes.prefilter"] = mi.Float(value)
    with pytest.raises(ValueError, match="gaussian_relightable: prefilter holds"):
        parameters.update()


def test_messages_name_the_material(formula, saved):
    flat = mi.ScalarTransform4f().scale([0, 1, 1])
    wrong = [{"wrap_mode": "x"}, {"to_uv": flat}, {"to_uv": 3.0}, {"prefilter": -1.0}, {"a": 1}]
    wrong += [{"memory": "no"}, {"scale": -1.0}]
    for properties in wrong:
        for bsdf in (
            {"type": "gaussian_relightable", "model": saved},
            material_of(formula.model()),
        ):
            with pytest.raises(RuntimeError, match="gaussian_relightable: ") as caught:
                mi.load_dict(bsdf | properties)
            assert "gaussian_texture" not in str(caught.value)


# --- A model in memory ---


def test_a_model_in_memory_is_the_material_of_its_file(formula, saved):
    uv = np.random.default_rng(1).uniform(0, 1, (50, 2))
    points, normals = np.c_[2 * uv - 1, np.zeros(50)], np.tile([0, 0, 1.0], (50, 1))
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
