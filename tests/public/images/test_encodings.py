"""What pixels are: codes or light, through every door that reads photos or families of images."""

import warnings

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run
from _helpers.errors import refused
from _helpers.light import to_coded, to_linear
from _helpers.lit_spheres import directions, photos
from _helpers.variants import in_variants, variant  # noqa: F401

mi = pytest.importorskip("mitsuba", reason="renderings are tensors and bitmaps of Mitsuba")

pytestmark = [pytest.mark.mitsuba, pytest.mark.usefixtures("variant"), in_variants(["llvm_ad_rgb"])]

LIGHTS = directions(12)
SMALL = {"gaussians": 100, "planes": 8, "iterations": 30, "progress": False}


@pytest.fixture(scope="module")
def codes():
    return photos(LIGHTS, 16)


@pytest.fixture(scope="module")
def light(codes):
    """Renderings, three times as bright as white in places."""
    return 3 * to_linear(codes)


@pytest.fixture(scope="module")
def family():
    return np.random.default_rng(2).uniform(0, 0.95, (14, 16, 16, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def model(family):
    basis = eg.Eigenbasis.from_images(family, size=(16, 16), components=6, progress=False)
    return basis, eg.EigenGS.fit(basis, gaussians=60)


def warned(call, *arguments, **options):
    """The result of a call, and the texts of its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = call(*arguments, **options)
    return result, [str(warning.message) for warning in caught]


def shown(model):
    return eg.render(model.relight(LIGHTS[3])).numpy()


KINDS = {
    "tensors": lambda light: [mi.TensorXf(photo) for photo in light],
    "one tensor": lambda light: mi.TensorXf(light),
    "bitmaps": lambda light: [mi.Bitmap(photo) for photo in light],
    "an array": lambda light: light,
    "lists": lambda light: light.tolist(),
}


@pytest.mark.parametrize("kind", KINDS)
def test_renderings_under_lights_are_light_also_above_white(light, kind):
    model, texts = warned(eg.Relightable.fit, KINDS[kind](light), LIGHTS, **SMALL)
    assert texts == []
    assert shown(model).max() > 1.2
    assert np.abs(shown(model) - to_coded(light[3])).mean() < 0.02


def test_files_of_light_keep_what_is_above_white(light, tmp_path):
    for k, photo in enumerate(light):
        eg.save_image(tmp_path / f"{k:02}.exr", photo, encoding="linear")
    files = sorted(tmp_path.glob("*.exr"))
    model = eg.Relightable.fit(files, LIGHTS, **SMALL)
    assert np.abs(shown(model) - to_coded(light[3])).mean() < 0.02
    eg.save_image(tmp_path / "shown.exr", eg.render(model.relight(LIGHTS[3])), encoding="srgb")
    assert eg.load_image(tmp_path / "shown.exr").max() > 1.5


def test_codes_under_lights_are_named(codes):
    model = eg.Relightable.fit(codes, LIGHTS, encoding="srgb", **SMALL)
    assert np.abs(shown(model) - codes[3]).mean() < 0.02
    assert np.isfinite(model.psnr_held_out)
    with refused(ValueError, "whole numbers up to"):
        eg.Relightable.fit(np.rint(255 * codes), LIGHTS, **SMALL)
    with refused(ValueError, "encoding 'light'"):
        eg.Relightable.fit(codes, LIGHTS, encoding="light", **SMALL)


@pytest.mark.parametrize("kind", ["one tensor", "bitmaps"])
def test_families_of_renderings_are_light(family, model, kind):
    light = KINDS[kind](to_linear(family))
    basis, texts = warned(
        eg.Eigenbasis.from_images, light, size=(16, 16), components=6, progress=False
    )
    assert texts == []
    np.testing.assert_allclose(basis.mean, model[0].mean, atol=1e-5)


def test_a_family_takes_an_encoding(family, model):
    light, (basis, fitted) = to_linear(family), model
    given = {"size": (16, 16), "components": 6, "progress": False, "encoding": "linear"}
    np.testing.assert_allclose(
        eg.Eigenbasis.from_images(light, **given).mean, basis.mean, atol=1e-5
    )
    curves = basis.truncation_curve(light[:3], "linear"), basis.truncation_curve(family[:3])
    np.testing.assert_allclose(curves[0].psnr, curves[1].psnr, atol=1e-3)
    [row] = fitted.encode_many([light[0]], encoding="linear")
    want = eg.render(fitted.encode(family[0])).numpy()
    for image, options in ((light[0], {"encoding": "linear"}), (mi.TensorXf(light[0]), {})):
        np.testing.assert_allclose(
            eg.render(fitted.encode(image, **options)).numpy(), want, atol=1e-4
        )
        for owner in (basis, fitted):
            pairs = zip(owner.project(image, **options), owner.project(family[0]), strict=True)
            assert all(np.allclose(a, b, atol=1e-3) for a, b in pairs)
    np.testing.assert_allclose(eg.render(row.result).numpy(), want, atol=1e-4)
    assert row.psnr_rgb == pytest.approx(eg.psnr(want, family[0]), abs=0.01)


def test_light_above_white_in_a_family_gets_a_word(family, model):
    bright = [4 * to_linear(image) for image in family[:3]]
    word = "light above white"
    for call in (model[0].project, model[1].project, model[1].encode):
        assert [word in text for text in warned(call, bright[0], encoding="linear")[1]] == [True]
    rows, texts = warned(model[1].encode_many, bright, encoding="linear")
    assert len(texts) == 1 and word in texts[0] and "2 more" in texts[0]
    assert eg.render(rows[0].result).numpy().max() > 1.2


def test_numbers_in_a_tensor_have_no_encoding(family):
    data = mi.TensorXf(family[0])
    fit, texts = warned(eg.fit, data, gaussians=8, iterations=1, space="data")
    assert texts == []
    assert fit.gaussians.space == "data"


def test_an_encoding_without_pixels_is_refused(model, tmp_path):
    basis, fitted = model
    calls = {
        "eigenvalues": lambda: basis.truncation_curve(encoding="linear"),
        "view": lambda: eg.view(fitted, encoding="linear"),
        "pack": lambda: eg.pack(fitted.gaussians, tmp_path / "a.egs", encoding="srgb"),
    }
    for call in calls.values():
        with refused(ValueError, "encoding is for the pixels"):
            call()


@pytest.fixture
def noted(family, tmp_path):
    """A folder of twelve photos whose EXIF data, alone, say that they are Adobe RGB."""
    for k, image in enumerate(family[:12]):
        exif = Image.Exif()
        exif[0x8769] = {0xA001: 2}
        Image.fromarray(np.uint8(255 * image)).save(tmp_path / f"{k:02}.png", exif=exif)
    return tmp_path


def test_a_colour_space_in_exif_gets_one_word_for_a_series(noted, model):
    files = sorted(noted.glob("*.png"))
    few = {"gaussians": 20, "iterations": 0, "progress": False}
    calls = {
        "fit_many": lambda: eg.fit_many(noted, **few),
        "encode_many": lambda: model[1].encode_many(noted),
        "Relightable": lambda: eg.Relightable.fit(files, LIGHTS, **SMALL),
        "Eigenbasis": lambda: eg.Eigenbasis.from_images(noted, size=(16, 16), components=3),
    }
    for name, call in calls.items():
        [text] = warned(call)[1]
        assert text.startswith(str(files[0])) and "Adobe RGB" in text, name
        assert "11 more" in text, name


def test_train_says_a_note_once_and_keeps_its_encoding(noted):
    few = ["--size", "16x16", "--components", "2", "--gaussians", "20"]
    told = run("train", noted, "-o", noted / "m.npz", "--encoding", "linear", *few)
    assert told.exit_code == 0 and told.stderr.count("Adobe RGB") == 1
    light = eg.EigenGS.load(noted / "m.npz").mean_image.mean()
    run("train", noted, "-o", noted / "codes.npz", *few)
    assert light > eg.EigenGS.load(noted / "codes.npz").mean_image.mean() + 0.05
    bad = run("train", noted, "-o", noted / "x.npz", "--encoding", "light", *few)
    assert_refused(bad, "--encoding")


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"
  xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/">
<rdf:Description hdrgm:Version="1.0" hdrgm:GainMapMax="2" hdrgm:HDRCapacityMax="2"/>
</rdf:RDF></x:xmpmeta>"""


def test_a_jpeg_with_a_gain_map_stays_codes(tmp_path):
    """The map is a second JPEG behind the first."""
    y, x = np.mgrid[:32, :48]
    pixels = np.stack([5 * x, 7 * y, 3 * (x + y)], -1).astype(np.uint8)
    path, gain = tmp_path / "phone.jpg", tmp_path / "gain.jpg"
    Image.fromarray(pixels).save(path, quality=95, xmp=XMP.encode())
    with Image.open(path) as picture:
        expected = np.asarray(picture) / 255
    Image.new("L", (24, 16), 200).save(gain, xmp=XMP.encode())
    path.write_bytes(path.read_bytes() + gain.read_bytes())
    image, [text] = warned(eg.load_image, path)
    np.testing.assert_allclose(image, expected, atol=2 / 255)
    assert "gain map" in text
