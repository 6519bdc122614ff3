"""The command `fit` on unusual images, and on files that are none."""

import json

import numpy as np
import pytest
from PIL import Image

from _helpers.command import assert_refused, run, smooth_pixels, succeeded

SMALL_IMAGES = {
    "one-pixel": lambda: Image.fromarray(smooth_pixels(1, 1)),
    "one-row": lambda: Image.fromarray(smooth_pixels(17, 1)),
    "one-column": lambda: Image.fromarray(smooth_pixels(1, 17)),
    "grey": lambda: Image.fromarray(smooth_pixels(20, 12, 1)[..., 0]),
    "16-bit": lambda: Image.fromarray(smooth_pixels(20, 12, 1)[..., 0].astype(np.uint16) * 257),
    "palette": lambda: Image.fromarray(smooth_pixels(20, 12)).quantize(16),
    "constant": lambda: Image.new("RGB", (20, 12), (10, 200, 90)),
    "black": lambda: Image.new("RGB", (20, 12)),
}


@pytest.mark.parametrize("kind", SMALL_IMAGES)
def test_unusual_images_fit(kind, tmp_path):
    SMALL_IMAGES[kind]().save(tmp_path / "x.png")
    fits_without_nan(tmp_path / "x.png", notes=0)


def test_cmyk_fits(tmp_path):
    Image.fromarray(smooth_pixels(20, 12)).convert("CMYK").save(tmp_path / "x.jpg")
    fits_without_nan(tmp_path / "x.jpg", notes=0)


def test_alpha_fits_with_a_note(tmp_path):
    Image.fromarray(smooth_pixels(20, 12, 4), "RGBA").save(tmp_path / "x.png")
    assert "white" in fits_without_nan(tmp_path / "x.png", notes=1)


def test_animated_fits_with_a_note(tmp_path):
    first, second = (Image.fromarray(smooth_pixels(20, n)) for n in (12, 12))
    second.putpixel((0, 0), (0, 0, 0))
    first.save(tmp_path / "x.gif", save_all=True, append_images=[second])
    assert "2 frames" in fits_without_nan(tmp_path / "x.gif", notes=1)


def fits_without_nan(path, notes):
    """Fit an image in a few iterations; return what was said on standard error."""
    output, report = path.parent / "out.npz", path.parent / "out.json"
    result = succeeded(run("fit", path, "-o", output, "--iterations", 3, "--report", report))
    assert result.stderr.count("\n") == result.stderr.count("eigengs-dr: note: ") == notes
    figures = json.loads(report.read_text())
    # Null stands for infinity, which equal images have.
    assert figures["psnr_rgb"] is None or figures["psnr_rgb"] > 5
    with np.load(output, allow_pickle=False) as file:
        # The figures of equal images are infinite.
        arrays = [file[key] for key in file.files if key != "figures"]
        assert not np.isnan(file["figures"]).any()
    assert all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f")
    return result.stderr


def test_missing_image(tmp_path, existing):
    assert_refused(run("fit", tmp_path / "gone.png", "-o", existing), "gone.png")


def test_folder_as_image(tmp_path, existing):
    assert_refused(run("fit", tmp_path, "-o", existing), tmp_path)


@pytest.mark.parametrize("content", [b"", b"this is text, not a picture\n"])
def test_file_that_is_no_image(tmp_path, existing, content):
    (tmp_path / "x.png").write_bytes(content)
    assert_refused(run("fit", tmp_path / "x.png", "-o", existing, "--overwrite"), "x.png")


def test_truncated_image(photo, existing):
    photo.write_bytes(photo.read_bytes()[:300])
    assert_refused(run("fit", photo, "-o", existing, "--overwrite"), photo)
