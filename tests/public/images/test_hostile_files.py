"""Files that are cut, damaged, no images, or claim more than they hold."""

import io
import os
import sys
import threading
import zlib
from contextlib import suppress

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import eigengs_dr as eg
from _helpers.command import run, succeeded
from _helpers.errors import one_line, refused
from _helpers.files import png, tiff
from _helpers.process import python_path, run_python

PIXELS = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
SETTING = "EIGENGS_DR_MAX_FILE_MB"
FLOATS = [".exr", ".hdr", ".pfm", ".tif"]
posix = pytest.mark.skipif(sys.platform == "win32", reason="has no such files")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        (b"", "empty"),
        (b"some text\n", "not an image"),
        (b"hi\n", "not an image"),  # shorter than what some decoders unpack to recognise a file
        ("/", "is a folder"),
    ],
)
def test_files_that_are_no_images(tmp_path, content, words):
    path = tmp_path if content == "/" else tmp_path / "a.png"
    if isinstance(content, bytes):
        path.write_bytes(content)
    with pytest.raises(eg.ImageError, match=words) as error:
        eg.load_image(path)
    assert str(path) in one_line(error)


@pytest.mark.parametrize("suffix", [*FLOATS, ".png", ".jpg", ".gif", ".webp", ".bmp", ".ppm"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_files_cut_off(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    if suffix in FLOATS:
        eg.save_image(path, PIXELS / 255, bits=32)
    else:
        Image.fromarray(PIXELS).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: max(40, int(share * len(content)))])
    with pytest.raises(eg.ImageError) as error:
        eg.load_image(path)
    assert str(path) in one_line(error)


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=40)
@given(st.data())
def test_damaged_files_load_or_say_so(tmp_path_factory, data):
    file, path = io.BytesIO(), tmp_path_factory.mktemp("damaged") / "a.png"
    kind = data.draw(st.sampled_from(["PNG", "JPEG", "GIF", "TIFF"]))
    Image.fromarray(PIXELS[:8, :8]).save(file, kind)
    content = bytearray(file.getvalue())
    for place in data.draw(st.lists(st.integers(0, min(200, len(content) - 1)), max_size=4)):
        content[place] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        image = eg.load_image(path)
    except eg.ImageError as error:
        assert "\n" not in str(error)
    else:
        assert image.dtype == np.float32 and image.shape[2] == 3


@pytest.mark.parametrize("suffix", [".exr", ".pfm", ".tif"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_pixels_that_are_not_finite(tmp_path, suffix, bad):
    light, path = np.ones((5, 7, 3), np.float32), tmp_path / f"a{suffix}"
    light[2, 4, 1] = bad
    image = oiio.ImageBuf(light)
    image.set_write_format("float")
    assert image.write(str(path))
    with pytest.raises(eg.ImageError, match=r"1 of 35 pixels are not finite.*\[2, 4\]") as error:
        eg.load_image(path)
    assert str(path) in one_line(error)


def test_a_suffix_that_opens_no_file_is_refused(tmp_path):
    """OpenImageIO makes a picture of a file whose suffix is .null, whatever it holds."""
    eg.save_image(tmp_path / "a.png", PIXELS)
    (tmp_path / "a.png").rename(tmp_path / "a.null")
    with refused(eg.ImageError, r"a\.null: its suffix \.null is that of other files; rename it"):
        eg.load_image(tmp_path / "a.null")


# --- Pipes and devices ---


@posix
def test_a_pipe_is_read_once(tmp_path, monkeypatch):
    eg.save_image(tmp_path / "a.png", PIXELS[:6, :8])
    content, pipe = (tmp_path / "a.png").read_bytes(), tmp_path / "pipe.png"
    os.mkfifo(pipe)

    def through_pipe(read):
        def write():
            with suppress(BrokenPipeError):  # the reader has read enough
                pipe.write_bytes(content)

        writer = threading.Thread(target=write)
        writer.start()
        try:
            return read()
        finally:
            writer.join()

    image = through_pipe(lambda: eg.load_image(pipe))
    np.testing.assert_array_equal(image, PIXELS[:6, :8] / np.float32(255))
    fit = ("fit", pipe, "-o", tmp_path / "a.npz", "--gaussians", 4, "--iterations", 1)
    succeeded(through_pipe(lambda: run(*fit)))
    content += bytes(2 << 20)
    monkeypatch.setenv(SETTING, "1")
    with pytest.raises(eg.ImageError, match=rf"pipe.png: has more than 1 MB; .*{SETTING}"):
        through_pipe(lambda: eg.load_image(pipe))


@posix
def test_a_device_is_no_image():
    with pytest.raises(eg.ImageError, match="/dev/zero: is a device; give an image file"):
        eg.load_image("/dev/zero")


# --- Files that claim or hold too much ---


def claims(path, width, height):
    """A file of few bytes that claims many pixels."""
    if path.suffix == ".png":
        return png(width, height, 8, 2, [])
    if path.suffix == ".ppm":
        return f"P6\n{width} {height}\n255\n".encode()
    if path.suffix == ".pfm":
        return f"PF\n{width} {height}\n-1\n".encode()
    return tiff(width, height, zlib.compress(bytes(1000)))


@pytest.mark.parametrize("suffix", [".png", ".tif", ".ppm", ".pfm"])
def test_a_claim_is_refused_before_anything_is_allocated(suffix, tmp_path, monkeypatch):
    path = tmp_path / f"a{suffix}"
    large = 9000 if suffix == ".pfm" else 15_000  # OpenImageIO refuses more than a gigabyte
    words = f"MB in memory, the limit is 537 MB; .*{SETTING}="
    for side, match in ((large, words), (60_000, "header claims a|image size .* exceeds")):
        path.write_bytes(claims(path, side, side))
        for read in (eg.load_image, eg.fit_large):
            with pytest.raises(eg.ImageError, match=match) as error:
                read(path)
            assert one_line(error).startswith(str(path))
    path.write_bytes(claims(path, 500, 700))
    monkeypatch.setenv(SETTING, "1")
    with pytest.raises(eg.ImageError, match=r"takes 4 MB in memory, the limit is 1 MB; .*=5"):
        eg.load_image(path)


@pytest.mark.skipif(sys.platform != "linux", reason="measures by /proc")
def test_a_strip_that_unfolds_to_more_than_its_size_is_cut(tmp_path):
    for name, size in (("a.tif", 144), ("b.tif", 80 << 20)):
        (tmp_path / name).write_bytes(tiff(8, 6, zlib.compress(bytes(size), 1)))
    code = f"""
import eigengs_dr as eg
for name in ("a.tif", "b.tif"):
    eg.load_image({str(tmp_path)!r} + "/" + name)
    [peak] = [line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")]
    print(int(peak) >> 10)
"""
    small, large = run_python(code, PYTHONPATH=python_path()).stdout.split()
    assert int(large) - int(small) < 20
