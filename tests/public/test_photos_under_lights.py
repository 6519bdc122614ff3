"""Photos and their lights belong together: by name, by place, as files store them."""

import random

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.lit_spheres import directions, photos

LIGHTS = directions(12)
PHOTOS = np.uint8(np.rint(photos(LIGHTS, 16) * 255))
NAMES = [f"img{k + 1}.png" for k in range(12)]


def fit(source, lights=None):
    return eg.Relightable.fit(source, lights, gaussians=16, iterations=0, planes=4, progress=False)


@pytest.fixture
def folder(tmp_path):
    lines = [f"{name} {x} {y} {z}" for name, (x, y, z) in zip(NAMES, LIGHTS, strict=True)]
    (tmp_path / "dirs.lp").write_text("\n".join(["12", *lines]))
    for name, photo in zip(NAMES, PHOTOS, strict=True):
        eg.save_image(tmp_path / name, photo)
    return tmp_path


def assert_alike(model, other):
    assert np.allclose(model.lights, other.lights)
    assert model.psnr_held_out == pytest.approx(other.psnr_held_out, abs=1e-3)


def test_files_in_any_order_get_the_light_that_the_list_names(folder):
    files = sorted(folder.glob("*.png"))  # img1, img10, img11, img12, img2, ...
    expected = fit(folder)
    assert_alike(fit(files, folder / "dirs.lp"), expected)
    random.Random(1).shuffle(files)
    assert_alike(fit(map(str, files), folder / "dirs.lp"), expected)


def test_files_may_differ_from_the_list_in_case_and_suffix(folder):
    names, expected = (folder / "dirs.lp").read_text(), fit(folder)
    (folder / "dirs.lp").write_text(names.replace("img", "IMG").replace("png", "NEF"))
    files = sorted(folder.glob("*.png"))
    assert_alike(fit(files, folder / "dirs.lp"), expected)


def test_files_that_the_list_does_not_name_are_refused(folder):
    files = [folder / name for name in NAMES]
    for wrong, message in [
        (files[:-1], "there are 11 photos, but 12 lights"),
        ([*files[:-1], folder / "other.png"], "does not name .*other.png"),
        ([*files[:-1], files[0]], "img1.png is given for several lights"),
        ([*files[:-1], PHOTOS[11]], "give one kind of both"),
    ]:
        with pytest.raises(ValueError, match=message):
            fit(wrong, folder / "dirs.lp")


def test_an_iterator_of_photos_is_read(folder):
    assert_alike(fit((photo for photo in PHOTOS), LIGHTS), fit(PHOTOS, LIGHTS))


@pytest.mark.parametrize("wrong", [None, 3, {"a": 1}, Image.new("RGB", (8, 8))])
def test_what_is_no_sequence_of_photos_is_refused(wrong):
    with pytest.raises(TypeError, match="give a folder, or a list of files or images"):
        fit(wrong, LIGHTS)


@pytest.mark.parametrize("wrong", [iter(LIGHTS), [[0, 0, 1], [0, 1]], object(), LIGHTS.T])
def test_lights_of_other_shapes_are_refused(wrong):
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        fit(PHOTOS, wrong)


@pytest.mark.parametrize(
    "tags", [[1, 3] * 6, [6, 8, 1] * 4, [6] * 12], ids=["two ways", "three ways", "all"]
)
@pytest.mark.parametrize("suffix", ["jpg", "tif", "webp"])
def test_photos_are_read_as_stored(tmp_path, tags, suffix):
    """A camera that looks straight down writes any orientation; pixels and lights agree."""
    files = [tmp_path / f"{k:02}.{suffix}" for k in range(12)]
    codes = PHOTOS[:, :12]
    for file, image, tag in zip(files, codes, tags, strict=True):
        exif = Image.Exif()
        exif[0x0112] = tag
        Image.fromarray(image).save(file, exif=exif, quality=98)
    number = sum(tag != 1 for tag in tags)
    with pytest.warns(UserWarning, match=f"orientation is not applied, in {number} of 12"):
        model = fit(files, LIGHTS)
    expected = fit(codes, LIGHTS)
    assert (model.planes.width, model.planes.height) == (16, 12)
    assert model.psnr_held_out == pytest.approx(expected.psnr_held_out, abs=0.5)
    for file, image in zip(files, codes, strict=True):
        assert np.abs(eg.load_image(file, upright=False) * 255 - image).mean() < 3
