"""What a bitmap does too: the texture in every slot of scenes, in other variants, and by name."""

from functools import partial

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.errors import refused
from _helpers.kernels import launches
from _helpers.light import to_coded, to_log
from _helpers.poster import camera
from _helpers.sets import COUNT, SIZE
from _helpers.texture import at, backend, gaussians, mi, small_scene, texture
from _helpers.variants import BOTH_RGB_AND_SLOW_SPECTRAL, in_variants, on_both
from eigengs_dr.plugins import bake_environment, texture_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant")]


FINER = 16
"""Texels of a bitmap for a pixel of its set."""


def fine_bitmap(g):
    """A bitmap of many texels that shows a set; z follows from x and y of normals."""
    shown = eg.render(g, g.width * FINER, g.height * FINER).numpy()
    if shown.shape[2] == 2:
        x, y = 2 * shown[..., 0] - 1, 2 * shown[..., 1] - 1
        z = 0.5 + 0.5 * np.sqrt(np.maximum(1 - x * x - y * y, 0))
        shown = np.concatenate([shown, z[..., None]], axis=2)
    return {"type": "bitmap", "data": mi.TensorXf(np.float32(shown)), "raw": True}


def slots(show):
    """BSDFs with a texture in each kind of place that asks for something else, by name.

    A colour, a number, an average, a cut-out, a share, a roughness, vectors and slopes. `show`
    makes the texture of a set.
    """
    colour, number = show(gaussians("linear")), show(gaussians("data", channels=1))
    normal, two = (show(gaussians("data", channels=channels)) for channels in (3, 2))
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    both = {"first": grey, "second": {"type": "roughconductor"}}
    return {
        "principled": {"type": "principled", "base_color": colour, "roughness": number},
        "roughplastic": {"type": "roughplastic", "diffuse_reflectance": colour},
        "mask": {"type": "mask", "opacity": number, "inner": grey},
        "blend": {"type": "blendbsdf", "weight": number, **both},
        "glass": {"type": "roughdielectric", "alpha": number},
        "normals": {"type": "normalmap", "normalmap": normal, "inner": grey},
        "two": {"type": "normalmap", "normalmap": two, "inner": grey},
        "bump": {"type": "bumpmap", "bump": number, "scale": 3.0, "inner": grey},
    }


COLUMNS, TILE = 4, 8
"""Walls in a row, and pixels along a wall."""


def gallery(show=texture_of):
    """A wall for each slot, in two rows, seen from the front in the light of a sky and a lamp
    behind the camera."""
    at = mi.ScalarTransform4f()
    walls = {
        name: {
            "type": "rectangle",
            "to_world": at.translate([2 * (k % COLUMNS) - 3, 1 - 2 * (k // COLUMNS), 0]),
            "bsdf": bsdf,
        }
        for k, (name, bsdf) in enumerate(slots(show).items())
    }
    view = at.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]).scale([COLUMNS, COLUMNS, 1])
    film = {"type": "hdrfilm", "width": COLUMNS * TILE, "height": 2 * TILE}
    film |= {"rfilter": {"type": "box"}, "pixel_format": "rgb"}
    light = {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": {"type": "orthographic", "to_world": view, "film": film},
            "lamp": {"type": "sphere", "center": [0, 0, 7], "emitter": light},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
            **walls,
        }
    )


@pytest.mark.parametrize("texels", [0, pytest.param(FINER * SIZE[0], marks=pytest.mark.slow)])
def test_every_slot_shows_what_a_bitmap_of_the_same_picture_shows(texels):
    """Slopes of a bitmap are those of its texels, and random normals point behind a surface."""
    shows = partial(texture_of, texels=texels), fine_bitmap
    images = [np.array(mi.render(gallery(show), spp=64, seed=1)) for show in shows]
    most = {} if texels else {"bump": 0.02, "normals": 0.05}
    for k, name in enumerate(slots(texture_of)):
        row, column = TILE * (k // COLUMNS), TILE * (k % COLUMNS)
        seen, expected = (i[row : row + TILE, column : column + TILE] for i in images)
        apart = np.sqrt(np.mean((seen - expected) ** 2)) / expected.mean()
        assert apart < most.get(name, 5e-4), name
        assert seen.std() > 1e-3, name


@in_variants(BOTH_RGB_AND_SLOW_SPECTRAL)
def test_every_slot_has_derivatives(variant):
    scene = gallery()
    parameters = mi.traverse(scene)
    keys = [k for k, _ in parameters if k.endswith((".color", ".mean"))]
    for key in keys:
        dr.enable_grad(parameters[key])
    parameters.update()
    image = mi.render(scene, params=parameters, spp=4)
    assert np.isfinite(np.array(image)).all()
    dr.backward(dr.mean(dr.square(image)))
    for key in keys:
        gradient = np.array(dr.grad(parameters[key]))
        assert np.isfinite(gradient).all()
        assert np.abs(gradient).max() > 0, key


@pytest.mark.slow
@in_variants(["llvm_ad_spectral_polarized"])
def test_polarized_light(variant):
    """All parameters of Stokes, of light off white: spectra of a colour differ in both models."""
    images = []
    for show in (texture_of, fine_bitmap):
        reflectance = show(gaussians("linear"))
        if "data" in reflectance:  # there, raw values are no colours
            bitmap = mi.Bitmap(np.array(reflectance["data"]))
            reflectance = {"type": "bitmap", "bitmap": bitmap}
        scene = small_scene({"type": "roughplastic", "diffuse_reflectance": reflectance})
        stokes = mi.load_dict({"type": "stokes", "inner": {"type": "path", "max_depth": 3}})
        images.append(np.array(mi.render(scene, integrator=stokes, spp=16, seed=1)))
    seen, expected = images
    assert np.sqrt(np.mean((seen - expected) ** 2)) < 0.05 * expected.mean()


@in_variants([*on_both("rgb"), *on_both("spectral")])
def test_no_method_is_missing(variant):
    """All of `mitsuba.Texture` but what Python inherits from `mitsuba.Object`."""
    tex = texture(gaussians("linear"), id="bark")
    si = at(mi.Float([0.2, 0.7]), mi.Float([0.4, 0.1]))
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(400.0, 500.0, 600.0, 700.0)
    sample = si.wavelengths * 0 + 0.5 if mi.is_spectral else mi.Color0f()
    for value in (
        tex.eval(si),
        tex.eval_1(si),
        tex.eval_3(si),
        tex.eval_1_grad(si),
        tex.mean(),
        tex.max(),
        tex.sample_position(mi.Point2f(0.3, 0.6)),
        tex.pdf_position(mi.Point2f(0.3, 0.6)),
        tex.sample_spectrum(si, sample),
        tex.pdf_spectrum(si),
        tex.spectral_resolution(),
    ):
        for part in value if isinstance(value, tuple) else (value,):
            assert np.isfinite(np.array(part)).all()
    assert tuple(tex.resolution()) == SIZE
    assert tuple(tex.wavelength_range()) == (mi.MI_CIE_MIN, mi.MI_CIE_MAX)
    assert tex.is_spatially_varying() and tex.id() == "bark" and tex.variant_name() == variant


@in_variants(on_both("spectral"))
def test_sampled_wavelengths_have_their_density(variant):
    tex = texture(gaussians("rgb"))
    si = at(0.3, 0.6)
    wavelengths, weight = tex.sample_spectrum(si, type(si.wavelengths)(0.1, 0.4, 0.6, 0.9))
    si.wavelengths = wavelengths
    expected = np.array(tex.eval(si)) / np.array(tex.pdf_spectrum(si))
    np.testing.assert_allclose(np.array(weight), expected, rtol=1e-5)
    si.wavelengths = type(si.wavelengths)(359.0, 831.0, 360.5, 829.0)
    np.testing.assert_allclose(np.ravel(tex.pdf_spectrum(si)), [0, 0, 1 / 470, 1 / 470], rtol=1e-6)


def test_what_it_says_of_itself(tmp_path):
    gaussians("rgb").save(tmp_path / "bark.npz")
    bark = {"type": "gaussian_texture", "filename": str(tmp_path / "bark.npz"), "raw": True}
    turned = {"wrap_mode": "mirror", "to_uv": mi.ScalarTransform4f().scale([2, 3, 1])}
    tex = mi.load_dict(bark | turned)
    with launches() as launched:
        shown = str(tex)
    assert not launched  # to print a scene computes nothing
    for part in (
        'name = "bark.npz"',
        f"gaussians = {COUNT}",
        f"resolution = [{SIZE[0]}, {SIZE[1]}]",
        "raw = 1",
        "wrap_mode = mirror",
        "matrix=[[2, 0, 0],",
        "[0, 3, 0],",
    ):
        assert part in shown
    assert 'name = ""' in str(texture(gaussians()))


def test_first_so_many_of_a_file(tmp_path):
    gaussians().save(tmp_path / "x.npz")
    plain = {"type": "gaussian_texture", "filename": str(tmp_path / "x.npz")}
    assert mi.traverse(mi.load_dict({**plain, "first": 7}))["mean"].shape == (7, 2)
    assert mi.traverse(mi.load_dict(plain))["mean"].shape == (COUNT, 2)
    for wrong in (-1, True, 2.5):
        with pytest.raises(RuntimeError, match="must be a number of Gaussians"):
            mi.load_dict({**plain, "first": wrong})
    more = f"first is {COUNT + 1}; the file has {COUNT} Gaussians"
    with pytest.raises(RuntimeError, match=more):
        mi.load_dict({**plain, "first": COUNT + 1})


BRIGHT = np.array([7.0, 5.0, 3.0])


def even(space, value, size=(32, 16)):
    """A set that is the same everywhere."""
    return eg.Gaussians.from_arrays(
        [[4, 4]], [[0.5, 0, 0.5]], [[0, 0, 0]], value, size=size, space=space, backend=backend()
    )


@pytest.mark.parametrize(
    ("space", "value"), [("log", to_log(BRIGHT)), ("rgb", to_coded(BRIGHT / 10))]
)
def test_sky_of_a_set(space, value):
    light = BRIGHT / 10 if space == "rgb" else BRIGHT
    mi.load_dict({"type": "scene"})  # without OptiX this test ends here, before the bitmap
    emitter = bake_environment(even(space, value), width=16, scale=2.0)
    scene = mi.load_dict({"type": "scene", "sky": emitter, "integrator": {"type": "path"}})
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0.3, 0.4, 0.5))
    seen = scene.environment().eval(scene.ray_intersect(ray))
    np.testing.assert_allclose(np.array(seen).ravel(), 2 * light, rtol=1e-3)


def test_data_is_no_sky():
    with refused(ValueError, "bake_environment: the set has 3 channels"):
        bake_environment(even("data", BRIGHT))


class TestPeers:
    """Scenes of other packages, where they are installed, show what a bitmap shows in them."""

    @staticmethod
    def check(render):
        g = gaussians("linear")
        bitmap = fine_bitmap(g)
        for seen, expected in zip(render(texture_of(g)), render(bitmap), strict=True):
            seen, expected = np.array(seen), np.array(expected)
            assert np.isfinite(seen).all() and expected.mean() > 0.01
            assert np.sqrt(np.mean((seen - expected) ** 2)) < 0.02 * expected.mean()

    @pytest.mark.slow
    def test_a_transient_path(self):
        """Of mitransient: the steady picture, and one for each time of flight."""
        pytest.importorskip("mitransient", reason="mitransient is not installed")
        film = {"type": "transient_hdr_film", "width": 16, "height": 16}
        film |= {"temporal_bins": 8, "start_opl": 3.0, "bin_width_opl": 2.0}

        def render(reflectance):
            wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
            integrator = {"type": "transient_path", "max_depth": 3}
            sensor = {**camera([0, 0, 3.0]), "film": film | {"rfilter": {"type": "box"}}}
            lamp = {"type": "point", "position": [0, 1, 3], "intensity": 10.0}
            scene = {"integrator": integrator, "sensor": sensor, "wall": wall, "lamp": lamp}
            return mi.render(mi.load_dict({"type": "scene", **scene}), spp=32, seed=1)

        self.check(render)

    def test_a_scene_of_typed_parts(self):
        """Of mitsuba-scene-description: the dictionary stands where a plugin would."""
        msd = pytest.importorskip("mitsuba_scene_description", reason="it is not installed")

        def render(reflectance):
            view = msd.Transform().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
            material = msd.SmoothDiffuseMaterial(reflectance=reflectance)
            scene = msd.Scene(
                integrator=msd.PathTracer(max_depth=2),
                sensors=msd.PerspectivePinholeCamera(fov=40, to_world=view),
                shapes={"wall": msd.Rectangle(bsdf=material)},
                emitters={"sky": msd.ConstantEnvironmentEmitter()},
            )
            return [mi.render(mi.load_dict(scene.to_dict()), spp=4, seed=1)]

        self.check(render)
