"""What an image may be besides a regular file, and files that claim too much."""

import os
import re
import subprocess
import sys
import threading
import warnings
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import run, succeeded
from _helpers.errors import one_line
from _helpers.files import png, tiff
from _helpers.process import python_path, run_python
from eigengs_dr.image.folder import image_files
from eigengs_dr.image.formats import HAS_HEIF, HEIF_SUFFIXES, READ_SUFFIXES
from eigengs_dr.image.io import ImageError, check_image, load_image, save_image
from eigengs_dr.many.windows import image_size, open_source
from eigengs_dr.storage.memory import SETTING

PIXELS = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
posix = pytest.mark.skipif(sys.platform == "win32", reason="has no such files")


# --- PIL images ---


@pytest.mark.parametrize(
    "mode", ["1", "L", "P", "PA", "RGB", "RGBX", "CMYK", "YCbCr", "HSV", "I;16", "F"]
)
def test_a_pil_image_counts_by_its_mode(mode, tmp_path):
    if mode in ("I;16", "F"):
        pixels = PIXELS[..., 0].astype(np.uint16) * 257
        image = Image.fromarray(pixels if mode == "I;16" else (pixels / 65535).astype(np.float32))
        shown = np.repeat(PIXELS[..., :1], 3, axis=2)
    else:
        image = Image.fromarray(PIXELS).convert(mode)
        shown = np.asarray(image.convert("RGB"))
    np.testing.assert_allclose(check_image(image), shown / 255, atol=1e-6)
    np.testing.assert_allclose(
        open_source(image).window(*np.s_[:6, :8]).read(), shown / 255, atol=1e-6
    )
    if mode not in ("1", "L", "I;16", "F"):
        assert eg.psnr(image, shown) == np.inf
    save_image(tmp_path / "a.png", image)
    np.testing.assert_allclose(load_image(tmp_path / "a.png"), shown / 255, atol=0.002)


@pytest.mark.parametrize("mode", ["LA", "La", "RGBA", "RGBa"])
def test_a_transparent_pil_image_is_shown_over_white(mode):
    alpha = np.full((6, 8, 1), 51, np.uint8)
    image = Image.fromarray(np.concatenate([PIXELS, alpha], axis=2)).convert(mode.upper())
    straight = np.asarray(image.convert("RGBA"))[..., :3] / 255
    image = image.convert(mode)
    with pytest.warns(UserWarning, match="transparent pixels are shown over white"):
        found = check_image(image)
    np.testing.assert_allclose(found, 1 - 0.2 * (1 - straight), atol=0.02)


@pytest.mark.parametrize(("mode", "words"), [("I", "32-bit integers"), ("LAB", "CIELab")])
def test_a_pil_image_without_a_meaning_is_refused(mode, words):
    with pytest.raises(ImageError, match=f"image: holds .*{words}") as error:
        eg.fit(Image.new(mode, (8, 8)), 4, iterations=0)
    one_line(error)


# --- Pipes, devices, folders ---


@posix
def test_a_pipe_is_read_once(tmp_path, monkeypatch):
    save_image(tmp_path / "a.png", PIXELS)
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

    assert image_size(pipe) is None
    np.testing.assert_array_equal(through_pipe(lambda: load_image(pipe)), check_image(PIXELS))
    assert through_pipe(lambda: open_source(pipe)).width == 8
    fit = ("fit", pipe, "-o", tmp_path / "a.npz", "--gaussians", 4, "--iterations", 1)
    succeeded(through_pipe(lambda: run(*fit)))
    content += bytes(2 << 20)
    monkeypatch.setenv(SETTING, "1")
    with pytest.raises(ImageError, match=rf"pipe.png: has more than 1 MB; .*{SETTING}"):
        through_pipe(lambda: load_image(pipe))


@posix
def test_a_device_is_no_image():
    with pytest.raises(ImageError, match="/dev/zero: is a device; give an image file"):
        load_image("/dev/zero")


@pytest.mark.parametrize("suffix", [".jfif", ".avif", ".gif", ".tga", ".jp2", ".pgm", ".PNG"])
def test_a_folder_takes_what_a_file_may_be(suffix, tmp_path):
    kinds = {".jfif": "JPEG", ".jp2": "JPEG2000", ".pgm": "PPM"}
    image = Image.fromarray(PIXELS[..., 0])
    image.save(tmp_path / f"a{suffix}", format=kinds.get(suffix, suffix[1:].upper()))
    assert image_files(tmp_path) == [tmp_path / f"a{suffix}"]
    assert load_image(tmp_path / f"a{suffix}").shape == (6, 8, 3)


def test_a_folder_names_images_that_it_leaves_out(tmp_path):
    for name in ("a.png", "b.dng", "c.JXL", ".d.psd", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    with pytest.warns(UserWarning, match=r"2 files of .* left out: b\.dng, c\.JXL"):
        assert len(image_files(tmp_path)) == 1


HEIF = """
from PIL import Image, PngImagePlugin

class Heif(PngImagePlugin.PngImageFile):
    format = "HEIF"

    def _open(self):
        self.fp.read(16)  # "....ftypheic", then a PNG
        super()._open()
        self.info["bit_depth"] = 10

def register_heif_opener():
    Image.register_open("HEIF", Heif, lambda prefix: prefix[4:12] == b"ftypheic")
"""


def test_heic_is_read_where_pillow_heif_is_installed(tmp_path):
    (tmp_path / "pillow_heif.py").write_text(HEIF)
    Image.fromarray(PIXELS).save(tmp_path / "a.png")
    photos = tmp_path / "photos"
    photos.mkdir()
    content = b"\0\0\0\x1cftypheic\0\0\0\0" + (tmp_path / "a.png").read_bytes()
    (photos / "a.HEIC").write_bytes(content)
    words = ["fit", str(photos / "a.HEIC"), "-o", str(tmp_path / "x.npz"), "--gaussians", "4"]
    code = f"""
from eigengs_dr.image.folder import image_files
print(image_files({str(photos)!r}))
from eigengs_dr.cli.main import main
main({[*words, "--iterations", "1"]!r})
"""
    path = os.pathsep.join([str(tmp_path), python_path()])
    found = run_python(code, PYTHONPATH=path)
    assert found.returncode == 0 and "a.HEIC" in found.stdout.splitlines()[0]
    assert "a.HEIC: keeps 8 of its 10 bits" in found.stderr
    if not HAS_HEIF:
        with pytest.raises(ImageError, match=r"a.HEIC: needs pillow-heif; type: pip install"):
            load_image(photos / "a.HEIC")


def test_the_manual_names_the_suffixes_of_folders():
    page = Path(__file__).parents[2] / "docs/reference/image-files.md"
    words = set(
        re.findall(r"[`\s](\.\w+)", page.read_text(encoding="utf-8").split("; a warning names")[0])
    )
    assert words == set(READ_SUFFIXES) - set(HEIF_SUFFIXES)


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="shows no open files")
@pytest.mark.filterwarnings("ignore")
def test_files_are_closed(tmp_path):
    names = [
        f"a{suffix}" for suffix in (".png", ".tif", ".exr", ".hdr", ".pfm", ".jpg", ".gif", ".ppm")
    ]
    for name in names:
        if name.endswith(".gif"):
            Image.fromarray(PIXELS).save(tmp_path / name)
        else:
            save_image(tmp_path / name, PIXELS)
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n no image")
    before = set(os.listdir("/proc/self/fd"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        for name in names:
            load_image(tmp_path / name)
            open_source(tmp_path / name).window(*np.s_[1:3, 1:3]).read()
        with pytest.raises(ImageError):
            load_image(tmp_path / "bad.png")
    assert len(set(os.listdir("/proc/self/fd"))) <= len(before)


# --- Files that claim or hold too much ---


def claims(path, width, height):
    """A file of few bytes that claims many pixels."""
    if path.suffix == ".png":
        return png(width, height, 8, 2, [])
    if path.suffix == ".ppm":
        return f"P6\n{width} {height}\n255\n".encode()
    if path.suffix == ".pfm":
        return f"PF\n{width} {height}\n-1\n".encode()
    return tiff(width, height, 8, 3, 2, zlib.compress(bytes(1000)), compression=8)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".ppm", ".pfm"])
def test_a_claim_is_refused_before_anything_is_allocated(suffix, tmp_path, monkeypatch):
    path = tmp_path / f"a{suffix}"
    large = 9000 if suffix == ".pfm" else 15_000  # OpenImageIO refuses more than a gigabyte
    words = f"MB in memory, the limit is 537 MB; .*{SETTING}="
    for side, match in ((large, words), (60_000, "header claims a|image size .* exceeds")):
        path.write_bytes(claims(path, side, side))
        for read in (load_image, open_source):
            with pytest.raises(ImageError, match=match) as error:
                read(path)
            assert one_line(error).startswith(str(path))
    path.write_bytes(claims(path, 500, 700))
    monkeypatch.setenv(SETTING, "1")
    with pytest.raises(ImageError, match=r"takes 4 MB in memory, the limit is 1 MB; .*=5"):
        load_image(path)


@pytest.mark.skipif(sys.platform != "linux", reason="measures by /proc")
def test_a_strip_that_unfolds_to_more_than_its_size_is_cut(tmp_path):
    peaks = []
    for size in (144, 80 << 20):
        data = zlib.compress(bytes(size), 1)
        (tmp_path / "a.tif").write_bytes(tiff(8, 6, 8, 3, 2, data, compression=8))
        line = [sys.executable, "-W", "ignore", "-c", MEASURE, str(tmp_path / "a.tif")]
        found = subprocess.run(line, check=True, capture_output=True, text=True).stdout
        peaks.append(int(found))
    assert peaks[1] - peaks[0] < 20


MEASURE = """
import sys
from eigengs_dr.image.io import load_image
load_image(sys.argv[1])
[peak] = [line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")]
print(int(peak) >> 10)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measures by /proc")
@pytest.mark.parametrize(
    ("suffix", "width", "height"), [(".png", 5500, 5700), (".tif", 6600, 6700)]
)
def test_the_largest_file_that_is_read_takes_less_than_a_gigabyte(suffix, width, height, tmp_path):
    path = tmp_path / f"a{suffix}"  # just within the limit
    if suffix == ".png":
        path.write_bytes(png(width, height, 8, 6, [np.zeros(4 * width, np.uint8)] * height))
    else:
        data = zlib.compress(bytes(6 * width * height), 9)
        path.write_bytes(tiff(width, height, 16, 3, 2, data, compression=8))
    line = [sys.executable, "-W", "ignore", "-c", MEASURE, str(path)]
    peak = subprocess.run(line, check=True, capture_output=True, text=True).stdout
    assert int(peak) < 1000
