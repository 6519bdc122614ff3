"""The memory of a fit, said or refused by the command `fit` before it reads the image."""

import struct
import zlib

import pytest
from PIL import Image

from _helpers.command import assert_refused, run, succeeded
from eigengs_dr.cli import fit_large as announced
from eigengs_dr.cli.fit_large import announce_memory
from eigengs_dr.fitting import memory
from eigengs_dr.fitting.options import FitOptions


def header(path, width, height, grey=False):
    """Write a PNG file of any size that ends after its header."""
    kind = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0 if grey else 2, 0, 0, 0)
    data = b"IDAT"  # no pixels follow
    chunks = [
        struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        for chunk in (kind, data)
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    return path


def test_fit_that_does_not_fit_is_refused_before_the_image_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "usable_memory", lambda: 2_000_000_000)
    photo, output = header(tmp_path / "large.png", 8192, 8192), tmp_path / "x.npz"
    result = run("fit", photo, "-o", output, "--gaussians", 5_000_000)
    count = "5,000,000 Gaussians on 8192x8192 pixels"
    assert_refused(result, photo, count, "this process may use 2.0 GB", "scale the image down")
    assert not output.exists()


def test_large_fit_says_its_memory(photo, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "usable_memory", lambda: None)
    monkeypatch.setattr(announced, "NOTABLE", 1)
    arguments = ["fit", photo, "-o", tmp_path / "x.npz", "--gaussians", 9, "--iterations", 1]
    line = "eigengs-dr: 9 Gaussians on 32x32 pixels take about 0.1 GB of memory\n"
    assert succeeded(run(*arguments)).stderr == line
    assert succeeded(run(*arguments, "--quiet")).stderr == ""


def test_small_fit_says_nothing(photo, tmp_path):
    arguments = ["-o", tmp_path / "x.npz", "--gaussians", 9, "--iterations", 1]
    assert succeeded(run("fit", photo, *arguments)).stderr == ""


@pytest.mark.parametrize(
    ("grey", "options", "expected"),
    [
        (False, {}, (8000, 4000, 3, 5000)),
        (False, {"gaussians": 70}, (8000, 4000, 3, 70)),
        (False, {"target_psnr": 30.0}, (8000, 4000, 3, 500_000)),
        (True, {}, (8000, 4000, 3, 5000)),
        (True, {"space": "data"}, (8000, 4000, 1, 5000)),
    ],
)
def test_size_and_count(tmp_path, monkeypatch, grey, options, expected):
    """Grey becomes RGB, and a search starts with one Gaussian for 64 pixels."""
    asked = []
    monkeypatch.setattr(announced, "check_memory", lambda *size: asked.append(size) or "")
    path = header(tmp_path / "large.png", 8000, 4000, grey)
    announce_memory(path, FitOptions(**options), quiet=True)
    assert asked == [expected]


def test_photo_that_its_header_turns(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(announced, "check_memory", lambda *size: asked.append(size) or "")
    exif = Image.Exif()
    exif[announced.ORIENTATION] = 6
    Image.new("RGB", (40, 30)).save(tmp_path / "photo.jpg", exif=exif)
    announce_memory(tmp_path / "photo.jpg", FitOptions(), quiet=True)
    assert asked == [(30, 40, 3, 1200)]


def test_file_that_is_no_image_is_left_to_the_loader(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    announce_memory(tmp_path / "text.png", FitOptions(), quiet=False)
