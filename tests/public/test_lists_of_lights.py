"""Lists of lights as programs and people write them, read from a folder of photos."""

import os
import resource

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run
from _helpers.lit_spheres import directions, photos

LIGHTS = directions(8)
PHOTOS = np.uint8(np.rint(photos(LIGHTS, 16) * 255))
NAMES = [f"img {k}.png" for k in range(8)]


@pytest.fixture
def folder(tmp_path):
    for name, photo in zip(NAMES, PHOTOS, strict=True):
        eg.save_image(tmp_path / name, photo)
    return tmp_path


def text(names=NAMES, lights=LIGHTS, count="8", end="\n", prefix=""):
    pairs = zip(names, lights, strict=True)
    rows = [f"{prefix}{name} {x:.6f} {y:.6f} {z:.6f}" for name, (x, y, z) in pairs]
    return end.join([count, *rows, ""])


def fit(source, lights=None):
    return eg.Relightable.fit(source, lights, gaussians=8, iterations=0, planes=3, progress=False)


def read(folder, content):
    (folder / "dirs.lp").write_bytes(content)
    return fit(folder)


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf" + text(end="\r\n").encode(),
        text(end="\r\n").encode("utf-16"),
        text(end="\r").encode(),
        text(prefix="C:\\Users\\José\\coin\\").encode("cp1252"),
        text(prefix="../../jpeg-exports/").encode(),
        text(count="08 ").encode(),
    ],
    ids=["utf-8 with a mark", "utf-16", "cr", "code page of a folder", "parents", "08"],
)
def test_dialects_give_the_same_lights(folder, content):
    assert np.allclose(read(folder, content).lights, LIGHTS, atol=1e-5)


@pytest.mark.parametrize("written", ["Mu\u0308nze 3.png", "M\u00fcnze 3.png"])
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_names_are_found_however_a_system_spells_them(folder, written, encoding):
    if encoding == "cp1252" and len(written) > 11:
        pytest.skip("Windows composes letters")
    os.rename(folder / NAMES[3], folder / "M\u00fcnze 3.png")
    content = text([*NAMES[:3], written, *NAMES[4:]]).encode(encoding)
    assert np.allclose(read(folder, content).lights, LIGHTS, atol=1e-5)


@pytest.mark.parametrize("count", ["7", "9"])
def test_another_count_is_a_warning_if_every_photo_is_there(folder, count):
    with pytest.warns(UserWarning, match=f"first line is '{count}', but 8 photos follow"):
        model = read(folder, text(count=count).encode())
    assert len(model.lights) == 8
    (folder / NAMES[2]).unlink()
    with pytest.raises(ValueError, match=r"has no file img 2\.png"):
        read(folder, text(count=count).encode())
    with pytest.raises(ValueError, match="must hold their number"):
        fit(PHOTOS, folder / "dirs.lp")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (text([*NAMES[:7], NAMES[0]]).encode(), r"img 0\.png for several lights"),
        (text().replace(".", ",").encode(), "line 2 .* decimal points"),
        (text().encode("utf-16-le"), r"no text \(line 1\)"),
        (text().replace("img 3", "img\0 3").encode(), r"no text \(line 5\)"),
        (text(lights=np.tile(LIGHTS[:1], (8, 1))).encode(), "all come from one direction"),
        (b"\0" * ((16 << 20) + 1), "more than 16 MB"),
    ],
    ids=["twice", "commas", "wide", "zero byte", "one direction", "large"],
)
def test_what_cannot_be_right_is_refused_in_one_line(folder, content, message):
    with pytest.raises(ValueError, match=message) as caught:
        read(folder, content)
    assert "\n" not in str(caught.value)


def test_lights_on_an_arc_give_a_warning(folder):
    slant = np.linspace(-1, 1, 8)
    arc = np.stack([np.sin(slant), np.zeros(8), np.cos(slant)], 1)
    with pytest.warns(UserWarning, match="one arc over the object"):
        read(folder, text(lights=arc).encode())


def test_one_name_in_several_folders_is_several_photos(folder):
    names = [f"light{k}/shot.png" for k in range(8)]
    eg.save_image(folder / "shot.png", PHOTOS[0])
    content = text(names, prefix="D:\\coin\\").encode()
    with pytest.raises(ValueError, match=r"shot\.png for several lights"):
        read(folder, content)
    for name, moved in zip(NAMES, names, strict=True):
        (folder / moved).parent.mkdir()
        os.rename(folder / name, folder / moved)
    apart = read(folder, content)
    assert np.allclose(apart.table.values, fit(PHOTOS, LIGHTS).table.values, atol=0.05)


def test_hidden_files_are_no_lists(folder):
    (folder / "._dirs.lp").write_bytes(b"\0\5\26\7")
    (folder / "old.lp").mkdir()
    assert len(read(folder, text().encode()).lights) == 8


LOADERS = [eg.Gaussians.load, eg.Relightable.load, eg.EigenGS.load, eg.Eigenbasis.load]


@pytest.mark.parametrize("load", [*LOADERS, lambda path: fit(PHOTOS, path)])
def test_devices_and_pipes_are_refused(tmp_path, load):
    os.mkfifo(tmp_path / "pipe")
    for path in ("/dev/zero", tmp_path / "pipe"):
        with pytest.raises(ValueError, match=r"a device or a pipe|neither a file") as e:
            load(path)
        assert str(path) in str(e.value)


def test_the_command_refuses_a_device(folder):
    ended = run("train", folder, "--lights", "/dev/zero", "-o", folder / "m.npz")
    assert_refused(ended, "is a device")


def test_photos_and_components_that_do_not_fit_into_memory_are_refused(folder, monkeypatch):
    limit = (20_000, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: limit)
    with pytest.raises(ValueError, match=r"8 photos of 16x16 pixels take .* scale them down"):
        read(folder, text().encode())
    with pytest.raises(ValueError, match=r"components of images of 16x16 .* a smaller size"):
        eg.Eigenbasis.from_images(folder, (16, 16), 4, progress=False)
