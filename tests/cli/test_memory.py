"""The memory of a fit, said or refused by the command `fit` before it reads the image."""

import struct
import zlib

import pytest
from PIL import Image

from _helpers.command import assert_refused, run, succeeded
from eigengs_dr.blocks.windows import ORIENTATION, image_size
from eigengs_dr.fitting import memory


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
    preview = ["--preview", tmp_path / "p.png"]  # blocks have none
    result = run("fit", photo, "-o", output, "--gaussians", 5_000_000, *preview)
    count = "5,000,000 Gaussians on 8192x8192 pixels"
    assert_refused(result, photo, count, "this process may use 2.0 GB", "scale the image down")
    assert not output.exists()


def test_large_fit_says_its_memory(tmp_path):
    """Before it finds that no pixels follow the header."""
    photo, output = header(tmp_path / "large.png", 8000, 8000), tmp_path / "x.npz"
    command = ["fit", photo, "-o", output, "--preview", tmp_path / "p.png"]
    line = "eigengs-dr: 5,000 Gaussians on 8000x8000 pixels take about 4."
    assert run(*command).stderr.startswith(line)
    assert not run(*command, "--quiet").stderr.startswith(line)


def test_small_fit_says_nothing(photo, tmp_path):
    arguments = ["-o", tmp_path / "x.npz", "--gaussians", 9, "--iterations", 1]
    assert succeeded(run("fit", photo, *arguments)).stderr == ""


@pytest.mark.parametrize(
    ("grey", "options", "expected"),
    [
        (False, [], (3, "5,000")),
        (False, ["--gaussians", 70], (3, "70")),
        (False, ["--target-psnr", 30], (3, "500,000")),
        (True, [], (3, "5,000")),
        (True, ["--space", "data"], (1, "5,000")),
    ],
)
def test_size_and_count(tmp_path, monkeypatch, grey, options, expected):
    """Grey becomes RGB, and a search starts with one Gaussian for 64 pixels."""
    monkeypatch.setattr(memory, "usable_memory", lambda: 1)
    path = header(tmp_path / "large.png", 8000, 4000, grey)
    outputs = ["-o", tmp_path / "x.npz", "--preview", tmp_path / "p.png"]
    channels, count = expected
    needed = memory.estimate_memory(8000, 4000, channels, int(count.replace(",", "")))
    words = f"{count} Gaussians on 8000x4000 pixels take about {needed / 1e9:.1f} GB"
    assert_refused(run("fit", path, *outputs, *options), words)


def test_photo_that_its_header_turns(tmp_path):
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.new("RGB", (40, 30)).save(tmp_path / "photo.jpg", exif=exif)
    assert image_size(tmp_path / "photo.jpg") == (40, 30, 3)


def test_file_that_is_no_image_has_no_size(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    assert image_size(tmp_path / "text.png") is None
