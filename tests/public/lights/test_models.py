"""Models of photos under known lights: quality on new lights, derivatives, files, what they say."""

import io
import json
import math
import re
from base64 import b64decode
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
from _helpers.lit_models import LitFormula, changed, to_light
from _helpers.lit_spheres import directions, photos
from _helpers.packed import few_groups

LIGHTS = directions(40)
LEFT_OUT = np.arange(40) % 8 == 4
OPTIONS = {"gaussians": 60, "planes": 6, "iterations": 50, "encoding": "srgb", "progress": False}


def textured(white=1.0):
    """Photos with grain in the albedo, which Gaussians miss, and with noise."""
    random = np.random.default_rng(1)
    images = photos(LIGHTS, 32) * (1 - 0.2 * random.random((32, 32, 1)))
    images += 0.02 * random.standard_normal(images.shape)
    return np.maximum(images * white, 0).astype(np.float32)


PHOTOS = textured()


def model_of(images, **options):
    return eg.Relightable.fit(images, LIGHTS[~LEFT_OUT], **OPTIONS | options)


@pytest.fixture(scope="module")
def model():
    """Of grainy photos."""
    return model_of(PHOTOS[~LEFT_OUT])


@pytest.fixture(scope="module")
def smooth():
    """Of photos without grain; the number of planes is found."""
    return model_of(photos(LIGHTS, 32)[~LEFT_OUT], planes=None)


def picture(model, light):
    return eg.picture_of(model.relight(light))


def real_psnr(model, images=PHOTOS):
    """psnr_rgb of photos that were left out by hand, from the lights of those."""
    pairs = zip(images[LEFT_OUT], LIGHTS[LEFT_OUT], strict=True)
    return np.mean([eg.psnr(image, picture(model, light)) for image, light in pairs])


def packed(model, path, drop):
    with few_groups():
        result = eg.pack(model, path, max_psnr_drop=drop)
    return result, eg.Relightable.load(path)


class TestFit:
    def test_new_lights_look_like_their_photos(self, smooth):
        new = directions(11, 0.45) @ np.diag([-1, 1, 1])
        pairs = zip(photos(new, 32), new, strict=True)
        psnrs = [eg.psnr(photo, picture(smooth, light)) for photo, light in pairs]
        assert np.mean(psnrs) > 35
        assert 25 < smooth.psnr_held_out < np.mean(psnrs) + 1  # some left-out lights lie outermost
        assert 2 <= smooth.planes.channels <= 20
        assert "60 Gaussians, 32x32 pixels" in repr(smooth) and "35 lights" in repr(smooth)
        assert '<img src="data:image/' in smooth._repr_html_()

    @pytest.mark.slow
    def test_photos_that_do_not_depend_on_the_light(self):
        same = np.repeat(photos(directions(30)[:1]), 8, axis=0)
        options = OPTIONS | {"gaussians": 80, "planes": None, "iterations": 20}
        found = eg.Relightable.fit(same, LIGHTS[:8], **options)
        # Compared before rounding, which adds 1/12 of a squared step: that of two such close
        # pictures is no noise of its own.
        error = np.square(picture(found, LIGHTS[20]) - same[0]).mean() + 1 / (12 * 255**2)
        assert found.planes.channels <= 3
        assert 50 < found.psnr_held_out == pytest.approx(-10 * np.log10(error), abs=1)

    def test_what_cannot_be_a_model_is_refused(self, tmp_path):
        few = PHOTOS[:8], LIGHTS[:8]
        for arguments, options, message in (
            ((PHOTOS,), {}, "photos need lights"),
            ((PHOTOS, LIGHTS[:-1]), {}, "40 photos, but 39 lights"),
            ((PHOTOS[:3], LIGHTS[:3]), {}, "at least 4"),
            ((tmp_path,), {}, "holds 0 files of lights"),
            ((tmp_path, LIGHTS), {}, "a folder needs an .lp file"),
            (([*PHOTOS[:5], PHOTOS[5, :20]], LIGHTS[:6]), {}, "photo 6: is 32x20"),
            ((np.full((8, 16, 16, 3), 0.5), LIGHTS[:8]), {}, "every photo is of one colour"),
            (few, {"gaussians": 0}, "gaussians is 0"),
            (few, {"planes": 22}, "planes is 22; 8 photos .* to 21"),
            ((PHOTOS, LIGHTS), {"planes": 65}, "planes is 65; 40 photos .* to 64"),
            (few, {"max_psnr_drop": 0}, "max_psnr_drop is 0; .* above 0"),
            (few, {"gaussians": 9, "planes": 3, "max_psnr_drop": 1}, "max_psnr_drop finds numbers"),
        ):
            with pytest.raises(ValueError, match=message):
                eg.Relightable.fit(*arguments, progress=False, **options)

    def test_has_as_few_gaussians_as_the_budget_allows(self):
        options = {"gaussians": None, "planes": 6, "iterations": 10}
        some, fewer = (
            model_of(PHOTOS[~LEFT_OUT], max_psnr_drop=drop, **options) for drop in (0.01, 20)
        )
        assert len(some.planes) == 64 and len(fewer.planes) < 16
        assert fewer.psnr_held_out < some.psnr_held_out

    @pytest.mark.slow
    def test_planes_show_best_what_other_lights_need(self):
        """Noise that no light repeats does not take the Gaussians from the object."""
        noisy = PHOTOS + 0.1 * np.random.default_rng(2).standard_normal(PHOTOS.shape)
        model = model_of(np.maximum(noisy, 0)[~LEFT_OUT].astype(np.float32), planes=12)
        energy = np.square(eg.picture_of(model.planes)).mean((0, 1))
        assert energy[:3].sum() > 5 * energy[3:].sum()

    def test_an_interrupted_fit_tells_how_far_it_came(self, model):
        def stop(done, total, row):
            raise KeyboardInterrupt

        with pytest.raises(eg.Interrupted) as error:
            model_of(PHOTOS[~LEFT_OUT], progress=stop, gaussians=12)
        partial = error.value.result
        assert partial.psnr_held_out < model.psnr_held_out - 0.5
        assert partial.psnr_held_out == pytest.approx(real_psnr(partial), abs=0.5)


class TestRelight:
    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["thin_plate", "hsh"])
    def test_the_derivative_by_the_direction_is_that_of_finite_differences(self, kind):
        """In float64, and for any length of the direction."""
        lit = LitFormula().model(kind=kind, smoothing=1e-3)
        data = eg.Gaussians.from_data(lit.planes.data(), dtype=np.float64)
        exact = replace(lit, planes=data)
        vectors = dr.llvm.ad.Array3f64
        light, step = np.array([0.3, -0.2, 0.7]), 1e-5

        def brightness(vector):
            return dr.sum(dr.square(eg.render(exact.relight(vector)).array))

        vector = vectors(*light.tolist())
        dr.enable_grad(vector)
        dr.backward(brightness(vector))
        for axis in range(3):
            shifts = [light + sign * step * np.eye(3)[axis] for sign in (1, -1)]
            high, low = (brightness(vectors(*shift.tolist())).numpy()[0] for shift in shifts)
            found = vector.grad[axis].numpy()[0]
            assert found == pytest.approx((high - low) / (2 * step), rel=1e-4)
        plain = eg.render(exact.relight([3, -2, 7])).numpy()
        np.testing.assert_allclose(eg.render(exact.relight(vector)).numpy(), plain, atol=1e-9)

    def test_an_environment_with_one_bright_side_lights_from_there(self, smooth):
        """The first row of an environment is up, and columns left of the middle are at x > 0."""
        sky = np.zeros((16, 32, 3), np.float32)
        sky[8, 11:13] = 20
        x = np.sin(2 * np.pi * 12 / 32)
        rendered = type(eg.render(smooth.planes))(sky)  # a tensor, as of Mitsuba
        lit = picture(smooth, rendered).mean(axis=2)
        side, other = (picture(smooth, [s * x, -0.1, 0.75]).mean(axis=2) for s in (1, -1))
        alike = [np.corrcoef(lit.ravel(), image.ravel())[0, 1] for image in (side, other)]
        assert alike[0] > 0.9 > alike[1]

    @pytest.mark.parametrize(
        "light, error, says",
        [
            ((0, 0, 0), ValueError, "light"),
            ((0.5, 0, -0.5), ValueError, "light"),
            ((np.nan, 0, 1), ValueError, "light"),
            (LIGHTS, ValueError, "one direction.*environment"),
            ([[0, 0, 1.0]], ValueError, "one direction"),
            (np.ones((8, 16)), ValueError, r"image \(h, w, 3\)"),
            ([0, 1], ValueError, "shape"),
            (None, TypeError, "type NoneType"),
            (["0", "0", "1"], TypeError, "type list"),
            (b"sky.exr", TypeError, "type bytes"),
            ([[0, 0], [1]], TypeError, "type list"),
            (-np.ones((8, 16, 3)), ValueError, "light is -1 somewhere"),
            (np.full((8, 16, 3), np.nan), ValueError, "not finite"),
        ],
    )
    def test_what_is_neither_a_direction_nor_an_environment(self, model, light, error, says):
        with pytest.raises(error, match=says) as caught:
            model.relight(light)
        assert "\n" not in str(caught.value)


class TestFindLight:
    def test_finds_lights_within_the_angle_that_it_tells(self, model):
        for k in np.flatnonzero(LEFT_OUT):
            light, angle = model.find_light(PHOTOS[k], encoding="srgb")
            wrong = np.degrees(np.arccos(min(light @ LIGHTS[k], 1)))
            assert np.linalg.norm(light) == pytest.approx(1)
            assert wrong < 4 and wrong < 2.5 * angle and angle < 8

    def test_of_a_flat_object_is_a_guess_and_says_so(self):
        """Brightness tells how high the light is, and nothing where from."""
        flat = 0.5 * LIGHTS[:, 2, None, None, None] * np.linspace(0.5, 1, 16)[:, None, None]
        photos = np.broadcast_to(flat, (40, 16, 16, 3)).astype(np.float32)
        guess = model_of(photos[~LEFT_OUT], gaussians=20, planes=1, iterations=0)
        _, angle = guess.find_light(photos[20], encoding="srgb")
        assert angle > 20

    def test_reads_a_file_as_it_is_stored_and_light_as_codes(self, model, tmp_path):
        exif = Image.Exif()
        exif[274] = 6  # turned by a quarter
        codes = np.rint(PHOTOS[4].clip(0, 1) * 255).astype(np.uint8)
        Image.fromarray(codes).save(tmp_path / "photo.png", exif=exif)
        expected = model.find_light(codes)
        for photo in (tmp_path / "photo.png", to_light(codes / 255)):
            light, angle = model.find_light(photo)
            np.testing.assert_allclose(light, expected[0], atol=1e-3)
            assert angle == pytest.approx(expected[1], rel=1e-2)

    def test_refuses_a_photo_of_another_size(self, model):
        with pytest.raises(ValueError, match="is 32x20, but those of the model are 32x32"):
            model.find_light(PHOTOS[4, :20])


class TestFiles:
    def test_a_file_gives_the_same_pictures(self, model, tmp_path):
        model.save(tmp_path / "model.npz")
        loaded = eg.Relightable.load(tmp_path / "model.npz")
        found, expected = (picture(m, [0.1, 0.3, 0.9]) for m in (loaded, model))
        np.testing.assert_allclose(found, expected, atol=1e-4)
        assert loaded.psnr_held_out == model.psnr_held_out
        assert loaded.table.kind == model.table.kind

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("kind", np.array("spline"), "kind is 'spline'"),
            ("values", np.zeros((3, 3, 3), np.float32), "values have shape"),
            ("smoothing", np.array(-1.0), "smoothing is -1"),
            ("lights", np.zeros((35, 3), np.float32), "no direction"),
            ("color", np.zeros((60, 2), np.float32), "background has shape"),
            ("format", np.array("eigengs_dr.model"), "format is"),
        ],
    )
    def test_a_damaged_file_is_refused(self, model, key, value, message):
        with pytest.raises(ValueError, match=f"m.npz: .*{message}"):
            changed(model, **{key: value})

    def test_a_set_is_not_read_as_a_model(self, model, tmp_path):
        model.planes.save(tmp_path / "set.npz")
        with pytest.raises(ValueError, match=r"format is 'eigengs_dr\.gaussians'"):
            eg.Relightable.load(tmp_path / "set.npz")
        command = "render", tmp_path / "set.npz", "-o", tmp_path, "--light", "0,0,1"
        assert_refused(run(*command), "holds no model of lights; leave out --light")
        with pytest.raises(ValueError, match=r"only eigengs_dr\.pack writes"):
            model.save(tmp_path / "set.egs")

    @few_groups()
    def test_packed_files_that_are_no_models_are_refused(self, model, tmp_path):
        path = tmp_path / "set.egs"
        eg.pack(model.relight([0, 0, 1]), path, max_psnr_drop=60)
        with pytest.raises(ValueError, match="without a table of lights"):
            eg.Relightable.load(path)
        eg.pack(model, path)
        content = path.read_bytes()
        path.write_bytes(content[:200] + bytes([content[200] ^ 1]) + content[201:])
        with pytest.raises(ValueError, match="damaged"):
            eg.Relightable.load(path)
        with pytest.raises(ValueError, match="takes no image"):
            eg.pack(model, path, np.zeros((24, 24, 3)))


class TestNumber:
    """The PSNR of photos that the model has never seen."""

    def test_is_that_of_photos_left_out_by_hand(self, model):
        assert (len(model.planes), model.planes.channels) == (60, 6)
        assert model.psnr_held_out == pytest.approx(real_psnr(model), abs=0.5)

    def test_after_packing_is_that_of_the_file(self, model, tmp_path):
        model.save(tmp_path / "model.npz")
        result, loaded = packed(model, tmp_path / "model.egs", 0.5)
        assert 0.4 < result.psnr_drop <= 0.5
        assert result.bytes < 0.4 * (tmp_path / "model.npz").stat().st_size
        assert loaded.psnr_held_out == pytest.approx(model.psnr_held_out - result.psnr_drop)
        assert loaded.psnr_held_out == pytest.approx(real_psnr(loaded), abs=0.5)
        planes = eg.Gaussians.load(tmp_path / "model.egs")
        assert planes.channels == model.planes.channels

    def test_counts_light_above_white_too(self, tmp_path):
        images = textured(1.2)
        bright = model_of(images[~LEFT_OUT])
        assert 1.05 < bright.brightest == pytest.approx(images[~LEFT_OUT].max(), rel=1e-5)
        bright.save(tmp_path / "bright.npz")
        assert eg.Relightable.load(tmp_path / "bright.npz").brightest == bright.brightest
        _, loaded = packed(bright, tmp_path / "bright.egs", 0.5)
        assert loaded.brightest == pytest.approx(bright.brightest)
        for fitted in (bright, loaded):
            assert fitted.psnr_held_out == pytest.approx(real_psnr(fitted, images), abs=0.5)

    def test_that_is_unknown_stays_unknown(self, model, tmp_path):
        unknown = replace(model, psnr_held_out=math.nan)
        result, loaded = packed(unknown, tmp_path / "unknown.egs", 0.5)
        assert 0 < result.psnr_drop <= 0.5  # of 40 dB
        assert math.isnan(loaded.psnr_held_out)
        assert "psnr_held_out" not in said("info", tmp_path / "unknown.egs")
        assert "left-out" not in eg.view(unknown).html

    def test_that_is_good_takes_a_finer_table(self, model, tmp_path):
        tables = []
        for psnr in (30.0, 60.0, 90.0):
            sure = replace(model, psnr_held_out=psnr)
            result, loaded = packed(sure, tmp_path / "x.egs", 0.5)
            assert 0.2 < result.psnr_drop <= 0.5
            tables.append(np.abs(loaded.table.values - model.table.values).max())
        assert tables[2] < 0.05 * tables[1] < 0.0025 * tables[0]

    def test_is_repeated_by_commands_and_the_page(self, tmp_path):
        lines = ["8"]
        for k in range(8):
            eg.save_image(tmp_path / f"{k}.png", PHOTOS[5 * k])
            lines.append(f"{k}.png " + " ".join(map(str, LIGHTS[5 * k])))
        (tmp_path / "dirs.lp").write_text("\n".join(lines))
        output = tmp_path / "model.npz"
        options = ("--gaussians", 60, "--iterations", 10, "--components", 6)
        told = said("train", tmp_path, "-o", output, "--lights", tmp_path / "dirs.lp", *options)
        with few_groups():
            lost = said("pack", output, "-o", tmp_path / "model.egs")
        for name, words in (("model.npz", told), ("model.egs", lost)):
            number = eg.Relightable.load(tmp_path / name).psnr_held_out
            facts = json.loads(said("info", tmp_path / name, "--json"))
            assert facts["psnr_held_out"] == pytest.approx(number, abs=0.006)
            assert f"{number:.2f}" in said("info", tmp_path / name)
            said("view", tmp_path / name, "-o", tmp_path / "page.html")
            for shown in ((tmp_path / "page.html").read_text(), words):
                assert f"left-out lights: psnr_rgb {number:.2f} dB" in shown


class TestPage:
    def test_has_buttons_for_lights(self, model):
        html = eg.view(model).html
        buttons = dict(re.findall(r'<button data-light="([^"]*)">([^<]*)</button>', html))
        lights = {name: np.array(light.split(","), float) for light, name in buttons.items()}
        assert set(lights) == {"Raking, left", "Raking, top", "From the camera"}
        assert lights["Raking, left"][0] < -0.9 and lights["Raking, top"][1] > 0.9
        assert lights["Raking, left"][2] == pytest.approx(LIGHTS[:, 2].min(), abs=1e-3)
        assert lights["From the camera"].tolist() == [0, 0, 1]

    def test_compares_a_photo_under_its_light_and_as_it_is_stored(self, model, tmp_path):
        exif = Image.Exif()
        exif[274] = 6  # turned by a quarter
        stored = np.rint(PHOTOS[4].clip(0, 1) * 255).astype(np.uint8)
        path, page = tmp_path / "photo.png", tmp_path / "page.html"
        Image.fromarray(stored).save(path, exif=exif)
        model.save(tmp_path / "model.npz")
        light = ",".join(map(str, 2 * LIGHTS[4]))
        said("view", tmp_path / "model.npz", "--image", path, "--light", light, "-o", page)
        for html in (page.read_text(), eg.view(model, path, light=LIGHTS[4]).html):
            facts = json.loads(re.search(r'id="facts">(.*?)</script>', html, re.S)[1])
            photo = Image.open(io.BytesIO(b64decode(facts["photo"].partition(",")[2])))
            assert np.abs(np.asarray(photo.convert("RGB")) / 255 - stored / 255).mean() < 0.02
            np.testing.assert_allclose(facts["lights"]["start"], LIGHTS[4], atol=1e-6)
            shown = model.relight(LIGHTS[4]).to_arrays()["background"]
            np.testing.assert_allclose(facts["set"]["background"], shown, atol=1e-6)
            assert "As in the photo</button>" in html
            assert re.search(r'id="follows" type="checkbox">', html)  # the light stays

    def test_refuses_a_photo_without_its_light(self, model, tmp_path):
        flat = model.relight((0, 0, 1))
        for arguments, light, message in (
            ((model, PHOTOS[4]), None, "under its own light; give it as light"),
            ((model, PHOTOS[4]), (0, 0.5, -0.5), "below the horizon"),
            ((flat,), (0, 0, 1), "light is for a model of lights"),
        ):
            with pytest.raises(ValueError, match=message):
                eg.view(*arguments, light=light)
        model.save(tmp_path / "model.npz")
        flat.save(tmp_path / "set.npz")
        eg.save_image(tmp_path / "photo.png", PHOTOS[4])
        command, photo = ["view", "-o", tmp_path / "page.html"], ["--image", tmp_path / "photo.png"]
        told = run(*command, tmp_path / "model.npz", *photo)
        assert_refused(told, "--light X,Y,Z", "photo.png")
        told = run(*command, tmp_path / "set.npz", "--light", "0,0,1")
        assert_refused(told, "--light", "set.npz")
        assert not (tmp_path / "page.html").exists()
