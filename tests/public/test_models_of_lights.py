"""What models of lights say of themselves: the PSNR of photos that they have never seen."""

import io
import json
import math
import re
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said
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


@pytest.fixture(scope="module")
def model():
    return eg.Relightable.fit(PHOTOS[~LEFT_OUT], LIGHTS[~LEFT_OUT], **OPTIONS)


def real_psnr(model, images=PHOTOS):
    """psnr_rgb of photos that were left out by hand, from the lights of those."""
    pairs = zip(images[LEFT_OUT], LIGHTS[LEFT_OUT], strict=True)
    return np.mean([eg.psnr(image, eg.picture_of(model.relight(light))) for image, light in pairs])


def packed(model, path, drop):
    with few_groups():
        result = eg.pack(model, path, max_psnr_drop=drop)
    return result, eg.Relightable.load(path)


def test_the_number_is_that_of_photos_left_out_by_hand(model):
    assert model.psnr_held_out == pytest.approx(real_psnr(model), abs=0.5)


@pytest.mark.parametrize("drop", [0.5, 3])
def test_after_packing_the_number_is_that_of_the_file(model, tmp_path, drop):
    result, loaded = packed(model, tmp_path / "model.egs", drop)
    assert 0.8 * drop < result.psnr_drop <= drop
    assert loaded.psnr_held_out == pytest.approx(model.psnr_held_out - result.psnr_drop)
    assert loaded.psnr_held_out == pytest.approx(real_psnr(loaded), abs=0.5)


def test_light_above_white_counts_too(tmp_path):
    images = textured(1.2)
    bright = eg.Relightable.fit(images[~LEFT_OUT], LIGHTS[~LEFT_OUT], **OPTIONS)
    assert bright.brightest > 1.05
    _, loaded = packed(bright, tmp_path / "bright.egs", 0.5)
    assert loaded.brightest == pytest.approx(bright.brightest)
    for fitted in (bright, loaded):
        assert fitted.psnr_held_out == pytest.approx(real_psnr(fitted, images), abs=0.5)


def test_an_interrupted_fit_tells_how_far_it_came(model):
    def stop(done, total, row):
        raise KeyboardInterrupt

    options = OPTIONS | {"gaussians": 12, "progress": stop}
    with pytest.raises(eg.Interrupted) as error:
        eg.Relightable.fit(PHOTOS[~LEFT_OUT], LIGHTS[~LEFT_OUT], **options)
    partial = error.value.result
    assert partial.psnr_held_out < model.psnr_held_out - 0.5
    assert partial.psnr_held_out == pytest.approx(real_psnr(partial), abs=0.5)


def test_what_is_unknown_stays_unknown(model, tmp_path):
    unknown = replace(model, psnr_held_out=math.nan)
    result, loaded = packed(unknown, tmp_path / "unknown.egs", 0.5)
    assert 0 < result.psnr_drop <= 0.5  # of 40 dB
    assert math.isnan(loaded.psnr_held_out)
    assert "psnr_held_out" not in said("info", tmp_path / "unknown.egs")
    assert "left-out" not in eg.view(unknown).html


def test_a_model_is_too_good_for_its_table_where_the_budget_is_tiny(model, tmp_path):
    with pytest.raises(ValueError, match="no rounding is fine enough"):
        eg.pack(replace(model, psnr_held_out=70.0), tmp_path / "x.egs", max_psnr_drop=0.1)


def test_commands_and_the_page_repeat_the_number(tmp_path):
    lines = ["8"]
    for k in range(8):
        eg.save_image(tmp_path / f"{k}.png", PHOTOS[5 * k])
        lines.append(f"{k}.png " + " ".join(map(str, LIGHTS[5 * k])))
    (tmp_path / "dirs.lp").write_text("\n".join(lines))
    output = tmp_path / "model.npz"
    told = said(
        "train", tmp_path, "-o", output, "--lights", tmp_path / "dirs.lp",
        "--gaussians", "40", "--iterations", "10", "--components", "4",
    )  # fmt: skip
    with few_groups():
        lost = said("pack", output, "-o", tmp_path / "model.egs")
    for name in ("model.npz", "model.egs"):
        number = eg.Relightable.load(tmp_path / name).psnr_held_out
        facts = json.loads(said("info", tmp_path / name, "--json"))
        assert facts["psnr_held_out"] == pytest.approx(number, abs=0.006)
        assert f"{number:.2f}" in said("info", tmp_path / name)
        said("view", tmp_path / name, "-o", tmp_path / "page.html")
        page = (tmp_path / "page.html").read_text()
        assert f"left-out lights: psnr_rgb {number:.2f} dB" in page
        assert f"left-out lights: psnr_rgb {number:.2f} dB" in (
            told if name == output.name else lost
        )


def test_the_page_has_buttons_for_lights(model):
    html = eg.view(model).html
    buttons = dict(re.findall(r'<button data-light="([^"]*)">([^<]*)</button>', html))
    lights = {name: np.array(light.split(","), float) for light, name in buttons.items()}
    assert set(lights) == {"Raking, left", "Raking, top", "From the camera"}
    assert lights["Raking, left"][0] < -0.9 and lights["Raking, top"][1] > 0.9
    assert lights["Raking, left"][2] == pytest.approx(LIGHTS[:, 2].min(), abs=1e-3)
    assert lights["From the camera"].tolist() == [0, 0, 1]


def test_a_notebook_shows_the_model(model):
    assert '<img src="data:image/' in model._repr_html_()


def facts_of(html):
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', html, re.S)[1])
    photo = facts["photo"] and Image.open(io.BytesIO(b64decode(facts["photo"].partition(",")[2])))
    return facts, photo and np.asarray(photo.convert("RGB")) / 255


def test_a_photo_is_compared_under_its_light_and_as_it_is_stored(model, tmp_path):
    exif = Image.Exif()
    exif[274] = 6  # turned by a quarter
    stored = np.rint(PHOTOS[4].clip(0, 1) * 255).astype(np.uint8)
    path = tmp_path / "photo.png"
    Image.fromarray(stored).save(path, exif=exif)
    model.save(tmp_path / "model.npz")
    x, y, z = LIGHTS[4]
    said(
        "view", tmp_path / "model.npz", "--image", path, "--light", f"{2 * x},{2 * y},{2 * z}",
        "-o", tmp_path / "page.html",
    )  # fmt: skip
    pages = [(tmp_path / "page.html").read_text(), eg.view(model, path, light=LIGHTS[4]).html]
    for html in pages:
        facts, photo = facts_of(html)
        assert np.abs(photo - stored / 255).mean() < 0.02  # a JPEG
        np.testing.assert_allclose(facts["lights"]["start"], LIGHTS[4], atol=1e-6)
        shown = model.relight(LIGHTS[4]).to_arrays()["background"]
        np.testing.assert_allclose(facts["set"]["background"], shown, atol=1e-6)
        assert "As in the photo</button>" in html
        assert re.search(r'id="follows" type="checkbox">', html)  # the pointer leaves the light


def test_a_photo_without_its_light_is_refused(model, tmp_path):
    with pytest.raises(ValueError, match="under its own light; give it as light"):
        eg.view(model, PHOTOS[4])
    with pytest.raises(ValueError, match="below the horizon"):
        eg.view(model, PHOTOS[4], light=(0, 0.5, -0.5))
    with pytest.raises(ValueError, match="light is for a model of lights"):
        eg.view(model.relight((0, 0, 1)), light=(0, 0, 1))
    model.save(tmp_path / "model.npz")
    model.relight((0, 0, 1)).save(tmp_path / "set.npz")
    eg.save_image(tmp_path / "photo.png", PHOTOS[4])
    command = ["view", "-o", tmp_path / "page.html"]
    photo = ["--image", tmp_path / "photo.png"]
    assert_refused(run(*command, tmp_path / "model.npz", *photo), "--light X,Y,Z", "photo.png")
    assert_refused(run(*command, tmp_path / "set.npz", "--light", "0,0,1"), "--light", "set.npz")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.slow
def test_the_number_holds_where_left_out_lights_are_outermost():
    """Each eighth of few lights is left out in turn, so that some are extrapolated."""
    lights, options = LIGHTS[::2], OPTIONS | {"gaussians": 36, "planes": 10}
    images, psnrs = photos(lights), []
    for part in range(8):
        out = np.arange(len(lights)) % 8 == part
        model = eg.Relightable.fit(images[~out], lights[~out], **options)
        pairs = zip(images[out], lights[out], strict=True)
        psnrs += [eg.psnr(image, eg.picture_of(model.relight(light))) for image, light in pairs]
    assert eg.Relightable.fit(images, lights, **options).psnr_held_out == pytest.approx(
        np.mean(psnrs), abs=0.4
    )
