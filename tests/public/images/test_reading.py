"""What `load_image` makes of a file beside its kind: bits, turns, alpha, names; `PIL.Image`s."""

import os
import re
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image

import eigengs_dr as eg
from _helpers.errors import refused
from _helpers.files import png
from _helpers.process import python_path, run_python

PIXELS = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


# --- Bits, turns, alpha ---


@pytest.mark.parametrize(("kind", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_16_bits_of_a_png_keep_their_precision(tmp_path, kind, channels):
    rows = (np.arange(2 * 3 * channels) * 2600 + 77).astype(">u2").reshape(2, 3, channels)
    alpha = channels % 2 == 0
    if alpha:
        rows[..., -1] = 65535
    (tmp_path / "a.png").write_bytes(png(3, 2, 16, kind, rows))
    colors = np.broadcast_to(rows[..., : channels - alpha], (2, 3, 3))
    np.testing.assert_allclose(eg.load_image(tmp_path / "a.png"), colors / 65535, atol=1e-7)


def test_a_big_endian_pfm_file(tmp_path):
    light = 5000 * np.random.default_rng(0).random((5, 7, 3)).astype(np.float32)
    (tmp_path / "a.pfm").write_bytes(b"PF\n7 5\n1.0\n" + light[::-1].astype(">f4").tobytes())
    np.testing.assert_array_equal(eg.load_image(tmp_path / "a.pfm"), light)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientations_of_tiff_are_those_of_pillow(tmp_path, orientation):
    values = (np.arange(5 * 7 * 3) % 256).reshape(5, 7, 3)
    tags = [(274, "H", 1, orientation, True)]
    tifffile.imwrite(tmp_path / "a.tif", values.astype(np.uint8), extratags=tags)
    deep = (values * 257).astype(np.uint16)
    tifffile.imwrite(tmp_path / "b.tif", deep, extratags=tags, photometric="rgb")
    turned, stored = (eg.load_image(tmp_path / "b.tif", upright=up) for up in (True, False))
    np.testing.assert_allclose(turned, eg.load_image(tmp_path / "a.tif"))
    np.testing.assert_allclose(stored, values / 255, atol=1e-6)


@pytest.mark.parametrize(("mode", "channels"), [("1", 1), ("L", 1), ("P", 3), ("RGBA", 3)])
def test_grey_may_stay_one_channel_and_opaque_alpha_is_no_news(tmp_path, mode, channels):
    grey = np.array([[0, 255, 0], [255, 255, 0]], np.uint8)
    Image.fromarray(grey).convert(mode).save(tmp_path / "a.png")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = eg.load_image(tmp_path / "a.png", keep_grey=True)
    np.testing.assert_array_equal(kept, np.repeat(grey[..., None], channels, axis=2) / 255)


def test_an_exr_file_of_another_channel(tmp_path):
    image, path = oiio.ImageBuf(np.zeros((2, 3, 1), np.float32)), tmp_path / "a.exr"
    image.specmod().channelnames = ("Z",)
    assert image.write(str(path))
    with refused(eg.ImageError, r"a\.exr: holds one channel, not R, G and B"):
        eg.load_image(path)
    assert eg.load_image(path, keep_grey=True).shape == (2, 3, 1)


# --- Names ---


@pytest.mark.parametrize(
    ("name", "other"),
    [("a.png", "b.jpg"), ("a.hdr", "b.png"), ("a.exr", "b.hdr"), ("a.tif", "b.jpg")],
)
def test_a_file_is_decoded_by_its_content(tmp_path, name, other):
    bits = 16 if name in ("a.png", "a.tif") else None
    eg.save_image(tmp_path / name, PIXELS / 255, bits=bits, encoding="srgb")
    expected = eg.load_image(tmp_path / name)
    (tmp_path / name).rename(tmp_path / other)
    np.testing.assert_array_equal(eg.load_image(tmp_path / other), expected)


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="has names of text alone")
def test_a_name_that_is_no_text(tmp_path):
    eg.save_image(tmp_path / "a.png", PIXELS)
    path = (tmp_path / "a.png").rename(tmp_path / os.fsdecode(b"\xff.png"))
    assert eg.load_image(path).shape == (6, 8, 3)


def test_samples_need_no_download():
    with refused(eg.ImageError, "use one of astronaut, ") as error:
        eg.sample("lena")
    names = re.search(r"use one of (.*)", str(error.value))[1].split(", ")
    for name in names:
        image = eg.sample(name)
        assert image.dtype == np.float32 and image.shape[2] == 3
        assert min(image.shape[:2]) >= 300
        assert image.min() >= 0 and image.max() <= 1 and np.ptp(image) > 0.4


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
    """A module that stands for pillow-heif: the folder's photo is found, read and warned of."""
    (tmp_path / "pillow_heif.py").write_text(HEIF)
    eg.save_image(tmp_path / "a.png", PIXELS)
    photos = tmp_path / "photos"
    photos.mkdir()
    content = b"\0\0\0\x1cftypheic\0\0\0\0" + (tmp_path / "a.png").read_bytes()
    (photos / "a.HEIC").write_bytes(content)
    code = (
        f"import eigengs_dr as eg\nprint(eg.fit_many({str(photos)!r}, gaussians=4, iterations=0))"
    )
    result = run_python(code, PYTHONPATH=os.pathsep.join([str(tmp_path), python_path()]))
    assert result.returncode == 0 and "status='done'" in result.stdout
    assert "a.HEIC: keeps 8 of its 10 bits" in result.stderr
    if find_spec("pillow_heif") is None:
        with pytest.raises(eg.ImageError, match=r"a.HEIC: needs pillow-heif; type: pip install"):
            eg.load_image(photos / "a.HEIC")


# --- Folders ---


def test_the_manual_names_the_suffixes_of_folders(tmp_path):
    """Of files of all those suffixes a folder takes all; HEIC needs pillow-heif."""
    page = Path(__file__).parents[3] / "docs/reference/image-files.md"
    listed = page.read_text(encoding="utf-8").split("; a warning names")[0]
    suffixes = set(re.findall(r"[`\s](\.\w+)", listed))
    with pytest.raises(eg.ImageError, match="holds no images; expected files ending in") as error:
        eg.Eigenbasis.from_images(tmp_path, (4, 4))
    known = set(re.findall(r"\.\w+", str(error.value).split("ending in")[1]))
    assert known - {".heic", ".heif", ".hif"} == suffixes


def test_folders_take_images_by_their_names(tmp_path):
    """In their order; not what is hidden; unknown kinds and images in subfolders get a word."""
    for name in ("b.JPG", "a.png", "notes.txt", ".hidden.png", "c.dng", "c.JXL", "sub.png/d.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with pytest.warns(UserWarning) as caught:
        rows = eg.fit_many(tmp_path, gaussians=4, iterations=0)
    assert [row.input.name for row in rows] == ["a.png", "b.JPG"]
    texts = [str(warning.message) for warning in caught]
    assert any(re.search(r"left out, such as sub\.png.d\.png; .*recursive=True", t) for t in texts)
    assert any(re.search(r"2 files of .* left out: c\.JXL, c\.dng", text) for text in texts)


# --- PIL images ---


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "CMYK", "YCbCr", "HSV", "I;16", "F"])
def test_a_pil_image_counts_by_its_mode(mode, tmp_path):
    if mode in ("I;16", "F"):
        pixels = PIXELS[..., 0].astype(np.uint16) * 257
        image = Image.fromarray(pixels if mode == "I;16" else (pixels / 65535).astype(np.float32))
        shown = np.repeat(PIXELS[..., :1], 3, axis=2)
    else:
        image = Image.fromarray(PIXELS).convert(mode)
        shown = np.asarray(image.convert("RGB"))
    if mode not in ("1", "L", "I;16", "F"):
        assert eg.psnr(image, shown) == np.inf
    eg.save_image(tmp_path / "a.png", image)
    np.testing.assert_allclose(eg.load_image(tmp_path / "a.png"), shown / 255, atol=0.002)


@pytest.mark.parametrize("mode", ["LA", "La", "RGBA", "RGBa"])
def test_a_transparent_pil_image_is_shown_over_white(mode, tmp_path):
    alpha = np.full((6, 8, 1), 51, np.uint8)
    image = Image.fromarray(np.concatenate([PIXELS, alpha], axis=2)).convert(mode.upper())
    straight = np.asarray(image.convert("RGBA"))[..., :3] / 255
    with pytest.warns(UserWarning, match="transparent pixels are shown over white"):
        eg.save_image(tmp_path / "a.png", image.convert(mode))
    found = eg.load_image(tmp_path / "a.png")
    np.testing.assert_allclose(found, 1 - 0.2 * (1 - straight), atol=0.02)


@pytest.mark.parametrize(("mode", "words"), [("I", "32-bit integers"), ("LAB", "CIELab")])
def test_a_pil_image_without_a_meaning_is_refused(mode, words):
    with refused(eg.ImageError, f"image: holds .*{words}"):
        eg.fit(Image.new(mode, (8, 8)), 4, iterations=0)
