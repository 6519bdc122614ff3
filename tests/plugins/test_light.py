"""A model of lights in a scene: a texture with a light to be found, or a material under lamps."""

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.chi_square import assert_density
from _helpers.lit_spheres import directions, photos
from _helpers.packed import few_groups
from _helpers.texture import backend, mi, picture, small_scene, texel_centres
from _helpers.variants import in_variants
from eigengs_dr.image.color import to_linear

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]

LIGHT = [0.3, -0.4, 0.8]
NAME = "wall.bsdf.reflectance.light"
SIDE, SPP, SEED, SIZE = 24, 16, 3, (24, 24)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The file of a model of a bump on a plane, from photos under 30 lights."""
    lights, path = directions(30), tmp_path_factory.mktemp("model") / "m.npz"
    options = {"gaussians": 80, "planes": 4, "iterations": 20, "backend": "llvm"}
    eg.Relightable.fit(photos(lights), lights, **options, progress=False).save(path)
    return str(path)


def scene_of(path, light=LIGHT, integrator="direct"):
    texture = {"type": "gaussian_texture", "model": path, "light": light}
    return small_scene({"type": "diffuse", "reflectance": texture}, integrator, SIDE, SPP)


def test_a_texture_shows_the_model_under_its_light(saved):
    texture = mi.load_dict({"type": "gaussian_texture", "model": saved, "light": LIGHT})
    parameters = mi.traverse(texture)
    assert [key for key, _ in parameters] == ["light", "to_uv", "prefilter"]
    model = eg.Relightable.load(saved, backend())
    for light in (LIGHT, [-3.0, 2.0, 9.0]):
        parameters["light"] = mi.Vector3f(*light)
        parameters.update()
        found = picture(texture.eval_3(texel_centres(SIZE)), SIZE)
        expected = eg.picture_of(model.relight(light)).clip(0, 1)
        np.testing.assert_allclose(found, to_linear(expected), atol=1e-3)


@few_groups()
def test_packed_models_are_read(saved, tmp_path):
    eg.pack(eg.Relightable.load(saved, backend()), tmp_path / "m.egs", max_psnr_drop=0.1)
    packed = mi.load_dict({"type": "gaussian_texture", "model": str(tmp_path / "m.egs")})
    whole = mi.load_dict({"type": "gaussian_texture", "model": saved})
    found, expected = (picture(t.eval_3(texel_centres(SIZE)), SIZE) for t in (packed, whole))
    np.testing.assert_allclose(found, expected, atol=0.05)


@pytest.mark.parametrize("integrator", ["direct", "prb"])
def test_the_derivative_is_that_of_finite_differences(saved, integrator):
    scene = scene_of(saved, integrator=integrator)
    parameters = mi.traverse(scene)

    def rendered(light):
        parameters[NAME] = light
        parameters.update()
        return dr.sum(dr.square(mi.render(scene, parameters, seed=SEED, spp=SPP)), axis=None)

    light = mi.Vector3f(*LIGHT)
    dr.enable_grad(light)
    dr.backward(rendered(light))
    step, found = 2e-2, np.array(dr.grad(light)).ravel()
    ends = [
        [
            float(rendered(mi.Vector3f(*(np.array(LIGHT) + s * axis).tolist())).array[0])
            for s in (step, -step)
        ]
        for axis in np.eye(3)
    ]
    expected = np.array([up - down for up, down in ends]) / (2 * step)
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.01 * abs(expected).max())


def test_an_optimiser_finds_the_light_of_a_photo(saved):
    scene = scene_of(saved)
    parameters = mi.traverse(scene)
    photo = mi.TensorXf(mi.render(scene, seed=SEED, spp=64))
    optimiser = mi.ad.Adam(lr=0.05)
    optimiser["light"] = mi.Vector3f(0, 0, 1)
    for step in range(60):
        parameters[NAME] = optimiser["light"]
        parameters.update()
        shown = mi.render(scene, parameters, seed=step, spp=SPP)
        dr.backward(dr.mean(dr.square(shown - photo), axis=None))
        optimiser.step()
    found, true = np.array(optimiser["light"]).ravel(), np.array(LIGHT)
    cosine = found @ true / np.linalg.norm(found) / np.linalg.norm(true)
    assert np.degrees(np.arccos(min(cosine, 1))) < 2


def test_a_light_that_an_optimiser_spoilt_is_that_of_the_camera(saved):
    texture = mi.load_dict({"type": "gaussian_texture", "model": saved, "memory": "exact"})
    expected = picture(texture.eval_3(texel_centres(SIZE)), SIZE)
    parameters = mi.traverse(texture)
    for light in ([np.nan, 0, 1], [0, 0, 0]):
        parameters["light"] = mi.Vector3f(*light)
        parameters.update()
        np.testing.assert_array_equal(picture(texture.eval_3(texel_centres(SIZE)), SIZE), expected)


@pytest.mark.parametrize(
    ("light", "says"), [([0, 0, -1.0], "below the horizon"), ([0, 0, 0.0], "no direction")]
)
def test_lights_that_are_refused(saved, light, says):
    with pytest.raises(RuntimeError, match=says):
        mi.load_dict({"type": "gaussian_texture", "model": saved, "light": light})


# --- The material: its lights are those of the scene ---


def material(path, **properties):
    return {"type": "gaussian_relightable", "model": path, **properties}


def lit_scene(path, integrator, side):
    """A wall that fills the picture of a camera in front of it, under light of irradiance pi."""
    film = {"type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    film["rfilter"] = {"type": "box"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator},
            "lamp": directional(LIGHT),
            "wall": {"type": "rectangle", "bsdf": material(path)},
            "camera": {"type": "orthographic", "to_world": view, "film": film},
        }
    )


def directional(light):
    """Light of irradiance pi from a direction of photos, whose y is against v."""
    x, y, z = light
    value = {"type": "rgb", "value": np.pi}
    return {"type": "directional", "direction": [-x, y, -z], "irradiance": value}


def values_of(bsdf, light, size=SIZE, mirrored=False):
    """What a material reflects of a light in the axes of photos, at the centres of texels."""
    return picture(spectra_of(bsdf, light, size, mirrored), size)


def spectra_of(bsdf, light, size=SIZE, mirrored=False):
    si = texel_centres(size)
    si.sh_frame, si.wi = mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Vector3f(0, 0.6, 0.8)
    si.sh_frame.s, si.sh_frame.t = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, -1 if mirrored else 1, 0)
    x, y, z = (np.array(light) / np.linalg.norm(light)).tolist()
    wo = mi.Vector3f(x, y if mirrored else -y, z)
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(550)
    return bsdf.eval(mi.BSDFContext(), si, wo)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("light", [LIGHT, [0, 0, 1], [-3.0, 2.0, 4.0]])
def test_a_material_has_the_values_of_the_model(saved, light, mirrored):
    """But for the interpolation between directions of the table."""
    bsdf = mi.load_dict(material(saved, scale=2))
    expected = eg.picture_of(eg.Relightable.load(saved, backend()).relight(light)).clip(0, 1)
    found = values_of(bsdf, light, mirrored=mirrored)
    np.testing.assert_allclose(found, 2 / np.pi * to_linear(expected), atol=5e-3)


@pytest.mark.parametrize("planes", [1, 2, 3])
def test_few_planes_are_planes(planes, tmp_path):
    """Two channels of another texture would be those of normals, and get a third."""
    lights = directions(8)
    model = eg.Relightable.fit(photos(lights), lights, gaussians=40, planes=planes, iterations=0)
    model.save(tmp_path / "m.npz")
    found = values_of(mi.load_dict(material(str(tmp_path / "m.npz"))), LIGHT)
    expected = eg.picture_of(model.relight(LIGHT)).clip(0, 1)
    np.testing.assert_allclose(found, to_linear(expected) / np.pi, atol=5e-3)


def test_a_wall_under_a_lamp_looks_like_a_photo(saved):
    scene = lit_scene(saved, "direct", SIDE)
    shown = mi.render(scene, spp=64).numpy()[::-1]  # row 0 lies at v = 0, the bottom of the wall
    model = eg.Relightable.load(saved, backend())
    expected = to_linear(eg.picture_of(model.relight(LIGHT)).clip(0, 1))
    assert eg.psnr(shown.clip(0, 1), expected) > 30


@in_variants(["llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"])
def test_a_material_depolarizes(saved):
    """The matrix of Mueller has one entry that is not 0."""
    bsdf = mi.load_dict(material(saved))
    matrix = np.array(spectra_of(bsdf, LIGHT))
    assert matrix[0, 0].min() > 0
    matrix[0, 0] = 0
    assert matrix.shape[:2] == (4, 4) and not matrix.any()
    stokes = mi.load_dict({"type": "stokes", "inner": {"type": "direct"}})
    seen = mi.render(lit_scene(saved, "direct", 8), integrator=stokes, spp=16, seed=1).numpy()
    shown, total, others = np.split(seen, [-12, -9], axis=2)  # three channels per parameter
    assert shown.mean() > 0.01 and not others.any()
    np.testing.assert_allclose(total, np.broadcast_to(shown, total.shape), rtol=1e-3, atol=1e-4)


def test_samples_of_a_material_have_their_density(saved):
    from mitsuba.chi2 import SphericalDomain

    bsdf = mi.load_dict(material(saved))

    def interaction(count):
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.uv, si.wi = mi.Point2f(0.4, 0.6), mi.Vector3f(0, 0.6, 0.8)
        si.sh_frame, si.dp_dv = mi.Frame3f(mi.Normal3f(0, 0, 1)), mi.Vector3f(0, 1, 0)
        return si

    def sample(numbers):
        first = mi.Float(dr.arange(mi.UInt32, dr.width(numbers)) % 1000) / 1000
        bs, _ = bsdf.sample(mi.BSDFContext(), interaction(dr.width(numbers)), first, numbers)
        return bs.wo

    def density(wo):
        return bsdf.pdf(mi.BSDFContext(), interaction(dr.width(wo)), wo)

    assert_density(sample, density, SphericalDomain(), 100_000, 32)


def test_samples_weigh_the_value(saved):
    bsdf, ctx, count = mi.load_dict(material(saved)), mi.BSDFContext(), 1000
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    rng = np.random.default_rng(0)
    si.uv = mi.Point2f(rng.uniform(0, 1, (2, count)))
    si.wi, si.sh_frame = mi.Vector3f(0, 0.6, 0.8), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_dv = mi.Vector3f(0, 1, 0)
    numbers = mi.Point2f(rng.uniform(0, 1, (2, count)))
    bs, weight = bsdf.sample(ctx, si, mi.Float(rng.uniform(0, 1, count)), numbers)
    value, density = bsdf.eval(ctx, si, bs.wo), bsdf.pdf(ctx, si, bs.wo)
    np.testing.assert_allclose(np.array(density), np.array(bs.pdf), rtol=1e-4)
    np.testing.assert_allclose(np.array(weight * density), np.array(value), atol=1e-5)
    behind = mi.Vector3f(bs.wo.x, bs.wo.y, -bs.wo.z)
    assert not np.array(bsdf.eval(ctx, si, behind)).any()
    assert not np.array(bsdf.pdf(ctx, si, behind)).any()


def test_planes_of_a_material_are_differentiable(saved):
    scene = lit_scene(saved, "prb", 8)
    parameters, key = mi.traverse(scene), "wall.bsdf.planes.background"
    start = mi.TensorXf(parameters[key])

    def rendered(change):
        parameters[key] = start + change
        parameters.update()
        return dr.mean(mi.render(scene, parameters, spp=SPP, seed=SEED), axis=None)

    change, step = dr.zeros(mi.TensorXf, start.shape), 1e-2
    dr.enable_grad(change)
    dr.backward(rendered(change))
    found = dr.grad(change).numpy().ravel()
    for k in range(len(found)):
        axis = mi.TensorXf(np.float32(np.arange(len(found)) == k) * step)
        ends = [float(rendered(sign * axis).array[0]) for sign in (1, -1)]
        assert found[k] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.03, abs=1e-4)


def test_mistakes_in_a_material_are_named(saved, tmp_path):
    for properties, words in (
        ({"model": str(tmp_path / "no.npz")}, "no.npz"),
        ({"scale": -1.0}, "scale is -1.0"),
        ({"light": LIGHT}, "has no property light"),
    ):
        with pytest.raises(RuntimeError, match=words):
            mi.load_dict(material(saved) | properties)
