"""Photos as a loss: a wall under a sky of light, seen by three cameras."""

import json
import signal
import warnings
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.light import to_coded, to_linear
from _helpers.poster import camera
from _helpers.process import python_path, run_python
from _helpers.variants import in_variants
from eigengs_dr.plugins import photo_loss

mi = pytest.importorskip("mitsuba")

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.usefixtures("variant"),
    in_variants(["llvm_ad_rgb"]),
]

SIDE = 24
GREY = np.full((32, 32, 3), 0.5, np.float32)
NAME, LIGHT = "wall.bsdf.reflectance", "sky.radiance.value"


def wall(texture, light=1.0, normals=None, sky=None):
    """A diffuse wall under the same light from all sides: it looks like its texture."""
    cameras = {f"camera{k}": camera([k - 1, 0, 2.6], SIDE, fov=39) for k in range(3)}
    paint = texture
    if not isinstance(texture, dict):
        data = mi.TensorXf(np.ascontiguousarray(texture, np.float32))
        paint = {"type": "bitmap", "data": data, "raw": True}
    coat = {"type": "diffuse", "reflectance": paint}
    if normals is not None:
        relief = {"type": "bitmap", "data": mi.TensorXf(normals), "raw": True}
        coat = {"type": "normalmap", "normalmap": relief, "paint": coat}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2},
            "sky": sky or {"type": "constant", "radiance": light},
            "wall": {"type": "rectangle", "bsdf": coat},
            **cameras,
        }
    )


def true_texture():
    x, y = np.meshgrid(np.linspace(0, 1, 32), np.linspace(0, 1, 32))
    waves = 0.5 + 0.3 * np.sin(6 * x) * np.cos(5 * y)
    return np.stack([waves, 0.6 * waves, 0.8 - 0.5 * waves], axis=2).astype(np.float32)


def photos_of(scene, spp=64):
    return [mi.render(scene, sensor=k, spp=spp, seed=77).numpy() for k in range(3)]


BLANK = [GREY[:SIDE, :SIDE]] * 3
"""Photos that say nothing."""


def few(loss, **options):
    """A fit of a few Gaussians in a few steps."""
    options = {"size": (32, 32), "gaussians": 60, "iterations": 4} | options
    return eg.fit(loss=loss, progress=False, **options)


def differentiable_light(scene):
    """The light of a scene, by which the user differentiates."""
    values = mi.traverse(scene)
    dr.enable_grad(values[LIGHT])
    values.update()
    return values[LIGHT]


class TestFits:
    def test_a_texture_is_recovered(self):
        scene, photos = wall(GREY), photos_of(wall(true_texture()))
        loss = photo_loss(scene, NAME, photos)
        assert len(repr(loss)) < 300 and "\n" not in repr(loss)
        found = few(loss, iterations=60)
        inner = np.s_[4:-4, 4:-4]
        assert np.mean((found.image[inner] - to_coded(true_texture())[inner]) ** 2) < 1e-3
        assert found.gaussians.space == "linear" and found.iterations == 60

    @pytest.mark.slow
    def test_a_map_of_normals_starts_flat(self):
        """Its name says what it is, as that of `eigengs-dr fit --map`."""
        scene = wall(GREY, normals=GREY)
        result = few(photo_loss(scene, {"normal": "wall.bsdf.normalmap"}, photos_of(wall(GREY))))
        assert result.gaussians.maps[0].space == "normal"
        mean = result.image["normal"].mean((0, 1))
        np.testing.assert_allclose(mean, [0.5, 0.5, 1], atol=0.05)

    @pytest.mark.slow
    def test_photos_of_few_pixels_get_few_gaussians(self):
        """One for 3 pixels that steps see, and one for 4 texels if these are fewer."""
        for number, expected in ((1, SIDE**2 // 3), (3, 32**2 // 4)):
            cameras = range(number)
            loss = photo_loss(wall(GREY), NAME, BLANK[:number], sensors=cameras)
            assert len(few(loss, gaussians=None).gaussians) == expected

    def test_a_light_is_found_along(self):
        """Of which the photos say nothing but the product with the texture; where that is known."""
        photos = photos_of(wall(true_texture(), light=1.5))
        light = mi.ad.Adam(lr=0.03, params={LIGHT: mi.Float(1.0)})
        loss = photo_loss(wall(GREY), NAME, photos, parameters=light)
        known = photo_loss(wall(GREY), NAME, photos_of(wall(true_texture())))
        start = few(known, iterations=60).gaussians
        method = eg.COARSE_TO_FINE.at_rates(0.01)
        few(loss, gaussians=None, start=start, iterations=60, method=method)
        assert light[LIGHT][0] == pytest.approx(1.5, abs=0.05)

    @pytest.mark.slow
    def test_an_environment_map_is_recovered(self):
        """The light of a matt ball: the mean over half of the directions is all that it shows."""
        y, x = np.mgrid[:32, :32]
        up = np.clip(np.cos(np.pi * y / 31), 0, 1)[..., None]
        light = 0.2 + up * [0.5, 0.8, 1.5] + 3.0 * ((abs(x - 9) < 3) & (abs(y - 10) < 4))[..., None]

        def lit(pixels):
            places = [(4 * np.sin(k), 1, 4 * np.cos(k)) for k in (0, 2, 4)]
            cameras = {f"camera{k}": camera(p, SIDE, fov=35) for k, p in enumerate(places)}
            sky = {"type": "envmap", "bitmap": mi.Bitmap(np.float32(pixels))}
            path = {"type": "prb", "max_depth": 2}
            scene = {"type": "scene", "integrator": path, "ball": {"type": "sphere"}, "sky": sky}
            return mi.load_dict({**scene, **cameras})

        photos, scene = photos_of(lit(light), 256), lit(np.full((32, 32, 3), 0.5))
        before = np.mean([(a - b) ** 2 for a, b in zip(photos_of(scene), photos, strict=True)])
        loss = photo_loss(scene, "sky", photos, spp=16)
        found = few(loss, iterations=60, space="log")
        after = np.mean([(a - b) ** 2 for a, b in zip(photos_of(scene), photos, strict=True)])
        assert after < 0.05 * before
        seen = eg.render(found.gaussians).numpy()
        area = np.sin(np.pi * y / 31)[..., None]
        assert (seen * area).sum() == pytest.approx((light * area).sum(), rel=0.1)
        data = mi.traverse(scene)["sky.data"]
        # The columns of the envmap beyond the seam are those of the other side.
        np.testing.assert_allclose(np.array(data)[:, 0], np.array(data)[:, -2], rtol=1e-4)


class TestDerivatives:
    def test_are_a_forward_difference(self):
        """Along a random direction, through a scene; the renderings have other random numbers."""
        scene, photos = wall(GREY), photos_of(wall(true_texture()))
        loss = photo_loss(scene, NAME, [mi.TensorXf(photo) for photo in photos], spp=256)
        random = np.random.default_rng(1)
        texture, along = random.uniform(0.3, 0.7, (2, 32, 32, 3)).astype(np.float32)
        picture = mi.TensorXf(texture)
        dr.enable_grad(picture)
        dr.backward(loss.function(picture, 1))
        slope = float(np.sum(dr.grad(picture).numpy() * along))
        ends = [loss.function(mi.TensorXf(texture + h * along), 1) for h in (0, 1e-2)]
        low, high = (float(np.ravel(end.numpy())[0]) for end in ends)
        assert slope == pytest.approx((high - low) / 1e-2, rel=0.1)

    @pytest.mark.parametrize(
        "integrator", ["prb", pytest.param("direct_projective", marks=pytest.mark.slow)]
    )
    def test_of_frozen_steps_are_those_of_plain_ones(self, integrator):
        """Though other programs run between them, and the memory of the recording is gone."""
        scene, photos = wall(GREY), photos_of(wall(true_texture()))
        tool = mi.load_dict({"type": integrator})
        loss = photo_loss(scene, NAME, photos, integrator=tool, spp=16)
        values = mi.traverse(scene)
        for step in range(9):
            texels = np.random.default_rng(step).random((32, 32, 3), np.float32)
            picture, plain = mi.TensorXf(texels), mi.TensorXf(texels)
            dr.enable_grad(picture, plain)
            number = loss.function(picture, step)
            dr.backward(number)
            values.update({f"{NAME}.data": plain})
            shown = mi.render(scene, values, step % 3, tool, step, spp=16)
            expected = dr.mean(dr.square(shown - mi.TensorXf(photos[step % 3])), axis=None)
            dr.backward(expected)
            np.testing.assert_allclose(number.numpy(), expected.numpy(), rtol=1e-5)
            np.testing.assert_allclose(
                dr.grad(picture).numpy(), dr.grad(plain).numpy(), rtol=1e-3, atol=1e-8
            )
            if step == 5:  # all recordings are made
                eg.render(eg.fit(true_texture(), 60, 1, space="linear"))
                dr.sync_thread()
                dr.flush_malloc_cache()

    def test_of_the_user_stay_as_they_are(self):
        """Parameters of the scene that the user differentiates get nothing from a fit."""
        scene = wall(GREY)
        light = differentiable_light(scene)
        few(photo_loss(scene, NAME, BLANK))
        assert dr.grad_enabled(light) and dr.grad(light)[0] == 0

    def test_seeds_of_any_size_differ(self):
        """Also those that fill the 32 bits of a renderer's seed, and numbers of NumPy."""
        scene, picture = wall(GREY), mi.TensorXf(true_texture())

        def value(seed, step=0):
            numbers = {"seed": seed, "spp": np.int64(1), "sensors": np.arange(3)}
            loss = photo_loss(scene, NAME, BLANK, **numbers)
            return float(loss.function(picture, step).array[0])

        seeds = (0, 1, 65_535, 65_536, 70_000, 2**31, 2**32 - 1)
        assert len({value(seed) for seed in seeds}) == len(seeds)
        assert value(np.int64(70_000)) == value(70_000) == value(70_000 + 2**32)
        value(2**32 - 1, step=3 * 2**16)  # beyond the largest seed of a rendering


class Foreign:
    """A tensor of another library, as NumPy sees one of PyTorch."""

    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.array, dtype)


class TestInputs:
    def test_photos_are_light_or_codes(self, tmp_path):
        """Of floats, of 8 bits, or of a file, of any library: the first value is the same."""
        from PIL import Image

        scene, picture = wall(GREY), mi.TensorXf(GREY)
        codes = np.full((SIDE, SIDE, 3), 128, np.uint8)
        coded = codes.astype(np.float32) / 255
        light = to_linear(coded)
        Image.fromarray(codes).save(tmp_path / "photo.png")

        def value(photo, encoding=None):
            loss = photo_loss(scene, NAME, [photo], sensors=[0], encoding=encoding)
            return float(loss.function(picture, 0).array[0])

        expected = value(light)
        for photo in (
            codes,
            tmp_path / "photo.png",
            Image.fromarray(codes),
            mi.Bitmap(light),
            mi.TensorXf(light),
            light.tolist(),
            Foreign(light),
            Foreign(codes),
        ):
            assert value(photo) == pytest.approx(expected, rel=1e-4)
        for photo in (coded, coded.tolist(), codes, Foreign(coded)):
            assert value(photo, "srgb") == pytest.approx(expected, rel=1e-4)
        assert value(codes, "linear") == pytest.approx(value(coded), rel=1e-4) != expected

    def test_bounds_are_those_of_textures_or_none(self):
        scene, photos = wall(GREY), BLANK
        assert photo_loss(scene, NAME, photos).bounds == (0, 1)
        scene = wall(GREY, sky={"type": "envmap", "bitmap": mi.Bitmap(GREY)})
        assert photo_loss(scene, "sky", photos).bounds is None
        both = {"color": NAME, "light": "sky"}
        with pytest.raises(ValueError, match="an envmap has none; give bounds=None"):
            photo_loss(scene, both, photos)
        assert photo_loss(scene, both, photos, bounds=None).bounds is None

    def test_what_does_not_fit_is_refused(self):
        scene, photos = wall(GREY), BLANK
        blind = np.full_like(photos[0], np.nan)
        for name, given, message in (
            ("wall.bsdf.reflektance", photos, "reflektance'; it has wall.bsdf.ref"),
            (NAME, photos + photos, "6 photos, but the scene has 3 sensors; give sensors="),
            (NAME, [], "there are no photos"),
            (NAME, [*photos[:2], GREY], r"photo 2 has shape \(32, 32, 3\), but its film has 24x24"),
            (NAME, [*photos[:2], blind], "photo_loss: photo 2: .*finite"),
            (NAME, [photos[0], [[0.5], [0.5, 1]], photos[0]], "photo_loss: photo 1: "),
            (NAME, ["no.png", *photos[1:]], r"photo_loss: photo 0 \(no.png\): "),
        ):
            with pytest.raises(ValueError, match=message):
                photo_loss(scene, name, given)
        light = mi.ad.Adam(lr=0.1, params={"sky.radiance": mi.Float(1)})
        for error, options, message in (
            (ValueError, {"sensors": [0, 1]}, "3 photos, but 2 sensors"),
            (ValueError, {"spp": 0}, "spp is 0"),
            (ValueError, {"bounds": (0, np.inf)}, "bounds are"),
            (ValueError, {"encoding": "sRGB"}, "encoding 'sRGB' is unknown"),
            (ValueError, {"parameters": light}, "did you mean 'sky.radiance.value'"),
            (TypeError, {"integrator": "path"}, "integrator is 'path'; give a loaded one"),
            (TypeError, {"sensors": 5}, "sensors is 5; give a list"),
            (TypeError, {"pictures": 5}, "pictures name 5"),
            (TypeError, {"photos": "p/"}, "photos is 'p/'; give a list"),
            (TypeError, {"parameters": {}.items()}, "give an optimiser"),
        ):
            with pytest.raises(error, match=message):
                photo_loss(scene, **{"pictures": NAME, "photos": photos} | options)
        loss = photo_loss(scene, NAME, photos)
        for space, message in (("data", "channels 3, .* fit 1"), ({"a": "linear"}, "fit a 3")):
            with pytest.raises(ValueError, match=message):
                few(loss, space=space)

    def test_bitmaps_of_bytes_are_refused(self, tmp_path):
        """Mitsuba keeps a file of 8 bits as bytes, which have no derivative."""
        eg.save_image(tmp_path / "grey.png", GREY)
        paint = {"type": "bitmap", "filename": str(tmp_path / "grey.png"), "raw": True}
        with pytest.raises(ValueError, match=f"{NAME}' holds bytes.*variant"):
            photo_loss(wall(paint), NAME, BLANK)
        few(photo_loss(wall(paint | {"format": "variant"}), NAME, BLANK))

    def test_a_size_below_two_texels_leaves_the_scene_as_it_is(self):
        """Mitsuba takes a bitmap of one row once, and then no other one."""
        scene = wall(GREY)
        differentiable_light(scene)
        loss = photo_loss(scene, NAME, BLANK)
        for size in ((9, 1), (1, 9)):
            message = f"size of the fit is {size[0]}x{size[1]}; .* 2x2"
            with pytest.raises(ValueError, match=message):
                few(loss, size=size, gaussians=1)
        assert mi.traverse(scene)[f"{NAME}.data"].shape == GREY.shape
        loss.function(mi.TensorXf(GREY[:2, :2]), 0)
        few(loss)
        assert np.isfinite(mi.render(scene, spp=1).numpy()).all()
        assert dr.grad_enabled(mi.traverse(scene)[LIGHT])
        with pytest.raises(ValueError, match="has 32x1 texels"):
            photo_loss(wall(GREY[:1]), NAME, BLANK)

    def test_colours_of_a_spectral_variant_are_refused(self):
        """Where texels are coefficients, on which a descent gains nothing."""
        mi.set_variant("llvm_ad_spectral")
        paint = {"type": "bitmap", "data": mi.TensorXf(GREY)}
        with pytest.raises(ValueError, match="spectra in llvm_ad_spectral; load the scene in"):
            photo_loss(wall(paint), NAME, BLANK)


# --- Errors of a rendering are told or passed on, and none takes the recordings away ---

STEPS = 7
AT_EACH = range(1, 100)


def failing(kind, error, at):
    """An integrator whose derivatives fail at some of its calls, and that counts these."""

    class Failing(type(mi.load_dict({"type": kind}))):
        calls = 0

        def render_backward(self, *arguments, **options):
            self.calls += 1
            if self.calls in at:
                error()
            return super().render_backward(*arguments, **options)

    return Failing(mi.Properties(kind))


def throwing(error):
    def throw():
        raise error

    return throw


def fit(error=None, at=(), kind="prb", scene=None):
    """The fit of a grey wall, the calls of the integrator, and the warnings."""
    integrator, photos = failing(kind, error, at), [0.6 * photo for photo in BLANK]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loss = photo_loss(scene or wall(GREY), NAME, photos, integrator=integrator)
        result = few(loss, iterations=STEPS)
    return result, integrator.calls, [str(warning.message) for warning in caught]


RECORDED = """
import json, sys
sys.path[:0] = [{folder!r}]
from test_photo_loss import eg, fit, mi, throwing
mi.set_variant("llvm_ad_rgb")
eg.register_plugins()
error = throwing(RuntimeError("jit_malloc(): out of memory!"))
for calls in ((), (1,), (2,)):
    result, count, texts = fit(error, calls)
    print(json.dumps([result.loss, count, texts]))
"""


def test_a_passing_error_is_told_once_and_the_next_steps_are_replayed():
    """In a process of its own: where several threads were, nothing is recorded."""
    code = RECORDED.format(folder=str(Path(__file__).parent))
    process = run_python(code, PYTHONPATH=python_path())
    rows = [json.loads(line) for line in process.stdout.splitlines()]
    [loss, calls, texts], *failed = rows
    assert calls < STEPS and not texts and len(failed) == 2
    for other, calls, texts in failed:
        assert calls < STEPS
        assert len(texts) == 1 and "\n" not in texts[0]
        begin = "photo_loss: a recording failed, its step renders anew: jit_malloc"
        assert texts[0].startswith(begin)
        assert other == pytest.approx(loss, rel=1e-5)


@pytest.mark.parametrize("kind", [RuntimeError, TypeError])
def test_a_lasting_error_is_passed_on_and_the_derivatives_of_the_user_stay(kind):
    scene = wall(GREY)
    differentiable_light(scene)
    with pytest.raises(kind, match=r"^the lamp is out$"):
        fit(throwing(kind("the lamp is out")), AT_EACH, scene=scene)
    assert dr.grad_enabled(mi.traverse(scene)[LIGHT])


def test_integrators_that_dr_jit_cannot_record_render_every_step_in_silence():
    result, calls, texts = fit(kind="direct_projective")
    assert calls > STEPS and not texts
    assert result.loss == pytest.approx(fit()[0].loss, rel=0.05)


@pytest.mark.parametrize(("call", "press"), [(1, throwing(KeyboardInterrupt())), (2, None)])
def test_ctrl_c_in_a_rendering_ends_the_fit_with_its_result(call, press):
    press = press or (lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(eg.Interrupted) as caught:
        fit(press, [call])
    result = caught.value.result
    assert result.stopped == "interrupted" and result.iterations < STEPS
    assert len(result.gaussians) == 60
