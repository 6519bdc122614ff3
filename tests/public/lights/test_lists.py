"""Photos and their lights belong together: lists as programs write them, names, orientations."""

import os
import random

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.lit_spheres import directions, photos
from _helpers.process import run_python

LIGHTS = directions(12)
PHOTOS = np.uint8(np.rint(photos(LIGHTS, 16) * 255))
NAMES = [f"img {k + 1}.png" for k in range(12)]


@pytest.fixture
def folder(tmp_path):
    for name, photo in zip(NAMES, PHOTOS, strict=True):
        eg.save_image(tmp_path / name, photo)
    (tmp_path / "dirs.lp").write_text(text())
    return tmp_path


def text(names=NAMES, lights=LIGHTS, count="12", end="\n", prefix=""):
    pairs = zip(names, lights, strict=True)
    rows = [f"{prefix}{name} {x:.6f} {y:.6f} {z:.6f}" for name, (x, y, z) in pairs]
    return end.join([count, *rows, ""])


def fit(source, lights=None):
    return eg.Relightable.fit(source, lights, gaussians=8, iterations=0, planes=3, progress=False)


def read(folder, content):
    (folder / "dirs.lp").write_bytes(content)
    return fit(folder)


def assert_alike(model, other):
    assert np.allclose(model.lights, other.lights, atol=1e-5)
    assert model.psnr_held_out == pytest.approx(other.psnr_held_out, abs=1e-2)


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf" + text(end="\r\n").encode(),
        text(end="\r\n").encode("utf-16"),
        text(end="\r").encode(),
        text(prefix="C:\\Users\\José\\coin\\").encode("cp1252"),
        text(prefix="../../jpeg-exports/").encode(),
        text(count="012 ").encode(),
    ],
    ids=["utf-8 with a mark", "utf-16", "cr", "code page of a folder", "parents", "012"],
)
def test_dialects_give_the_same_lights(folder, content):
    assert np.allclose(read(folder, content).lights, LIGHTS, atol=1e-5)


@pytest.mark.parametrize(
    ("written", "encoding"),
    [
        ("Mu\u0308nze 3.png", "utf-8"),
        ("M\u00fcnze 3.png", "utf-8"),
        ("M\u00fcnze 3.png", "cp1252"),
    ],
)
def test_names_are_found_however_a_system_spells_them(folder, written, encoding):
    os.rename(folder / NAMES[3], folder / "M\u00fcnze 3.png")
    content = text([*NAMES[:3], written, *NAMES[4:]]).encode(encoding)
    assert np.allclose(read(folder, content).lights, LIGHTS, atol=1e-5)


@pytest.mark.parametrize("count", ["11", "13"])
def test_another_count_is_a_warning_if_every_photo_is_there(folder, count):
    with pytest.warns(UserWarning, match=f"first line is '{count}', but 12 photos follow"):
        model = read(folder, text(count=count).encode())
    assert len(model.lights) == 12
    (folder / NAMES[2]).unlink()
    with pytest.raises(ValueError, match=r"has no file img 3\.png"):
        read(folder, text(count=count).encode())
    with pytest.raises(ValueError, match="must hold their number"):
        fit(PHOTOS, folder / "dirs.lp")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "first line is ''"),
        ("1\na.jpg 0 0\n", "line 2 is 'a.jpg 0 0'"),
        ("1\na.jpg 0 0 up\n", "line 2"),
        ("1\na.jpg 0 0 0\n", "no direction"),
        ("1\na.jpg 0 0 nan\n", "no direction"),
        ("1\na.jpg 0.6 0 -0.8\n", "light 1 is 0.6, 0, -0.8, below the horizon"),
        (text([*NAMES[:11], NAMES[0]]), r"img 1\.png for several lights"),
        (text().replace(".", ","), "line 2 .* decimal points"),
        (text().encode("utf-16-le"), r"no text \(line 1\)"),
        (text().replace("img 4", "img\0 4"), r"no text \(line 5\)"),
        (b"\x89PNG\r\n\x1a\n\x00\x00photo", "no text"),
        (b"\0" * ((16 << 20) + 1), "more than 16 MB"),
    ],
)
def test_what_cannot_be_right_is_refused_in_one_line(folder, content, message):
    with pytest.raises(ValueError, match=message) as caught:
        read(folder, content if isinstance(content, bytes) else content.encode())
    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


def test_lights_on_an_arc_give_a_warning(folder):
    slant = np.linspace(-1, 1, 12)
    arc = np.stack([np.sin(slant), np.zeros(12), np.cos(slant)], 1)
    with pytest.warns(UserWarning, match="one arc over the object"):
        read(folder, text(lights=arc).encode())
    with pytest.raises(ValueError, match="all come from one direction"):
        read(folder, text(lights=np.tile(LIGHTS[:1], (12, 1))).encode())


def test_one_name_in_several_folders_is_several_photos(folder):
    names = [f"light{k}/shot.png" for k in range(12)]
    eg.save_image(folder / "shot.png", PHOTOS[0])
    content = text(names, prefix="D:\\coin\\").encode()
    with pytest.raises(ValueError, match=r"shot\.png for several lights"):
        read(folder, content)
    for name, moved in zip(NAMES, names, strict=True):
        (folder / moved).parent.mkdir()
        os.rename(folder / name, folder / moved)
    assert_alike(read(folder, content), fit(PHOTOS, LIGHTS))


def test_hidden_files_are_no_lists(folder):
    (folder / "._dirs.lp").write_bytes(b"\0\5\26\7")
    (folder / "old.lp").mkdir()
    assert len(fit(folder).lights) == 12


def test_files_in_any_order_get_the_light_that_the_list_names(folder):
    files, expected = sorted(folder.glob("*.png")), fit(folder)  # img 1, img 10, img 11, ...
    assert_alike(fit(files, folder / "dirs.lp"), expected)
    random.Random(1).shuffle(files)
    assert_alike(fit(map(str, files), folder / "dirs.lp"), expected)
    other = text().replace("img", "IMG").replace("png", "NEF")  # another case and suffix
    (folder / "dirs.lp").write_text(other)
    assert_alike(fit(files, folder / "dirs.lp"), expected)


def test_files_that_the_list_does_not_name_are_refused(folder):
    files = [folder / name for name in NAMES]
    for wrong, message in [
        (files[:-1], "there are 11 photos, but 12 lights"),
        ([*files[:-1], folder / "other.png"], "does not name .*other.png"),
        ([*files[:-1], files[0]], "img 1.png is given for several lights"),
        ([*files[:-1], PHOTOS[11]], "give one kind of both"),
    ]:
        with pytest.raises(ValueError, match=message):
            fit(wrong, folder / "dirs.lp")


def test_an_iterator_of_photos_is_read():
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
    ("tags", "suffix"), [([1, 3] * 6, "jpg"), ([6, 8, 1] * 4, "tif"), ([6] * 12, "webp")]
)
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


LOADERS = [eg.Gaussians.load, eg.Relightable.load, eg.EigenGS.load, eg.Eigenbasis.load]


@pytest.mark.parametrize("load", [*LOADERS, lambda path: fit(PHOTOS, path)])
def test_devices_and_pipes_are_refused(tmp_path, load):
    os.mkfifo(tmp_path / "pipe")
    for path in ("/dev/zero", tmp_path / "pipe"):
        with pytest.raises(ValueError, match=r"a device or a pipe|neither a file") as e:
            load(path)
        assert str(path) in str(e.value)


SMALL = """
import resource, eigengs_dr as eg
resource.setrlimit(resource.RLIMIT_AS, (1 << 32, resource.RLIM_INFINITY))
for call in (
    lambda: eg.Relightable.fit("FOLDER", progress=False),
    lambda: eg.Eigenbasis.from_images("FOLDER", (16000, 16000), 4, progress=False),
):
    try:
        call()
    except ValueError as error:
        print(error)
"""


def test_photos_and_components_that_do_not_fit_into_memory_are_refused(folder):
    """In a process that may have 4 GB."""
    for k, name in enumerate(NAMES):
        Image.new("L", (6000, 6000), k).save(folder / name)
    done = run_python(SMALL.replace("FOLDER", str(folder)))
    photos, components = done.stdout.splitlines()
    assert "12 photos of 6000x6000 pixels take" in photos and "scale them down" in photos
    assert "components of images of 16000x16000" in components and "smaller size" in components
