"""The command line: results, reports, and one line and exit code 2 for every mistake."""

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from test_training import random_fields

import eigengs_dr as eg
from eigengs_dr import bases, cli_train
from eigengs_dr.backend import BackendError, select
from eigengs_dr.cli import main
from eigengs_dr.color import SPACES, YCBCR_TO_RGB
from eigengs_dr.eigengs import EigenGS
from eigengs_dr.starting import INITS


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def succeeded(result):
    assert result.exit_code == 0, result.output
    return result


def assert_refused(result, *words):
    """Check that a command ended with exit code 2 and one line that names what went wrong."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("eigengs-dr: error: ")
    assert result.stderr.count("\n") == 1
    for word in words:
        assert str(word) in result.stderr


def smooth_pixels(width, height, channels=3):
    """A picture of 8-bit waves."""
    y, x, c = np.mgrid[:height, :width, :channels]
    return (127 + 60 * np.sin(x / 5 + c) + 60 * np.cos(y / 7)).astype(np.uint8)


def previewed(path):
    """The parts of a preview of 32 pixels width: one of every 16 pixels, which repeat it."""
    return np.split(np.asarray(Image.open(path))[::16, ::16], 3, axis=1)


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.png"
    Image.fromarray(smooth_pixels(32, 32)).save(path)
    return path


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The outputs of one small fit; tests read them only."""
    folder = tmp_path_factory.mktemp("fitted")
    Image.fromarray(smooth_pixels(32, 24)).save(folder / "photo.png")
    outputs = ["-o", folder / "fit.npz", "--report", folder / "fit.json"]
    settings = ["--gaussians", 50, "--iterations", 5, "--preview", folder / "both.png"]
    result = succeeded(run("fit", folder / "photo.png", *outputs, *settings))
    return folder, result


def test_fit_says_what_it_did(fitted):
    folder, result = fitted
    for word in ("50 Gaussians", "5 iterations", "psnr_ycbcr", "psnr_rgb", folder / "both.png"):
        assert str(word) in result.stdout


def test_fit_report(fitted):
    folder, _ = fitted
    report = json.loads((folder / "fit.json").read_text())
    expected = {"gaussians": 50, "width": 32, "height": 24, "seed": 0, "stopped": "iterations"}
    assert {key: report[key] for key in expected} == expected
    assert report["input"] == str(folder / "photo.png")
    assert report["output"] == str(folder / "fit.npz")
    assert report["command"].startswith("eigengs-dr fit ")
    assert "--iterations 5" in report["command"]
    assert report["backend"] in ("llvm", "cuda")
    assert report["threads"] >= 1
    assert report["versions"]["drjit"]
    assert report["iterations"] == 5
    assert report["psnr_ycbcr"] > report["psnr_rgb"] > 15
    assert 0 < report["ssim"] <= 1
    assert 0 < report["ms_ssim"] <= 1
    assert 0 <= report["seconds_init"] <= report["seconds"]
    assert {"iteration", "seconds", "psnr_ycbcr", "psnr_rgb"} <= set(report["trace"][-1])


def test_fit_preview_is_photo_fit_and_outlines(fitted):
    folder, result = fitted
    photo, fit, outlines = previewed(folder / "both.png")
    assert photo.shape == fit.shape == outlines.shape == (24, 32, 3)
    assert np.array_equal(photo, smooth_pixels(32, 24))
    assert np.abs(fit.astype(int) - photo).mean() < 30
    assert outlines.mean() > fit.mean() + 20
    assert "both.png (photo, fit and outlines side by side)" in result.stdout


def test_quiet(photo, tmp_path):
    result = run(
        "fit", photo, "-o", tmp_path / "x.npz", "--gaussians", 9, "--iterations", 1, "--quiet"
    )
    assert succeeded(result).output == ""


def test_fit_uses_at_most_one_gaussian_a_pixel_by_default(tmp_path):
    Image.fromarray(smooth_pixels(6, 4)).save(tmp_path / "small.png")
    arguments = ["-o", tmp_path / "x.npz", "--iterations", 0]
    succeeded(run("fit", tmp_path / "small.png", *arguments))
    info = json.loads(run("info", tmp_path / "x.npz", "--json").stdout)
    assert info["gaussians"] == 24


def test_fit_several_images_into_folders(photo, tmp_path):
    other = tmp_path / "other.png"
    Image.fromarray(smooth_pixels(20, 30)).save(other)
    settings = ["--gaussians", 20, "--iterations", 1, "--report", tmp_path / "r.json"]
    folders = ["-o", tmp_path / "fits", "--preview", tmp_path / "previews"]
    succeeded(run("fit", photo, other, *folders, *settings))
    assert sorted(path.name for path in (tmp_path / "fits").iterdir()) == ["other.npz", "photo.npz"]
    assert (tmp_path / "previews" / "other.png").exists()
    report = json.loads((tmp_path / "r.json").read_text())
    assert [row["width"] for row in report["images"]] == [32, 20]
    assert "versions" in report


@pytest.mark.parametrize(
    ("options", "size"),
    [([], (32, 24)), (["--scale", "2"], (64, 48)), (["--size", "10x7"], (10, 7))],
)
def test_render_sizes(fitted, tmp_path, options, size):
    folder, _ = fitted
    succeeded(run("render", folder / "fit.npz", "-o", tmp_path / "y.png", *options))
    assert Image.open(tmp_path / "y.png").size == size


def test_render_is_what_was_fitted(fitted, tmp_path):
    folder, _ = fitted
    succeeded(run("render", folder / "fit.npz", "-o", tmp_path / "y.png"))
    _, fit, _ = previewed(folder / "both.png")
    assert np.abs(fit.astype(int) - np.asarray(Image.open(tmp_path / "y.png"))).max() <= 1


@pytest.mark.parametrize(
    ("color", "channels", "modes"),
    [
        ("linear", 3, ("RGB", "RGB")),
        ("linear", 1, ("L", "RGB")),
        ("data", 3, ("RGB", "RGB")),
        ("data", 1, ("L", "L")),
    ],
)
def test_spaces_of_textures(tmp_path, color, channels, modes):
    """What `render` and `info` draw is the fit of the preview, as the report has it."""
    pixels = smooth_pixels(32, 32, channels)
    Image.fromarray(pixels if channels == 3 else pixels[..., 0]).save(tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").mode == modes[0]
    outputs = ["-o", tmp_path / "a.npz", "--preview", tmp_path / "both.png"]
    settings = ["--gaussians", 100, "--iterations", 20, "--report", tmp_path / "a.json"]
    result = succeeded(run("fit", tmp_path / "a.png", "--color", color, *outputs, *settings))
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["color"] == color
    assert ("psnr_data" if color == "data" else "psnr_ycbcr") in result.stdout
    assert report["psnr_rgb"] > 25 and 0.9 < report["ms_ssim"] <= 1
    info = json.loads(run("info", tmp_path / "a.npz", "--json").stdout)
    assert (info["space"], info["channels"]) == (color, 1 if modes[1] == "L" else 3)
    succeeded(run("info", tmp_path / "a.npz", "--preview", tmp_path / "info.png"))
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "y.png"))
    drawn, shown = (Image.open(tmp_path / n) for n in ("y.png", "info.png"))
    assert {image.mode for image in (drawn, shown)} == {modes[1]}
    _, fit, _ = previewed(tmp_path / "both.png")
    np.testing.assert_array_equal(fit, np.asarray(drawn.convert("RGB")))
    np.testing.assert_array_equal(fit, np.asarray(shown.convert("RGB")))
    error = (fit.astype(float) - pixels) / 255
    assert -10 * np.log10(np.mean(error**2)) == pytest.approx(report["psnr_rgb"], abs=0.02)


def test_info(fitted):
    folder, _ = fitted
    found = json.loads(succeeded(run("info", folder / "fit.npz", "--json")).stdout)
    expected = {"gaussians": 50, "width": 32, "height": 24, "channels": 3, "space": "ycbcr"}
    assert {key: found[key] for key in expected} == expected
    assert "gaussians  50" in run("info", folder / "fit.npz").stdout


def test_doctor():
    text = succeeded(run("doctor")).stdout
    assert "llvm" in text
    assert "libLLVM" in text
    found = json.loads(run("doctor", "--json").stdout)
    assert found["llvm"]["works"] or found["cuda"]["works"]


@pytest.mark.parametrize("command", [[], ["fit"], ["train"], ["render"], ["info"], ["doctor"]])
def test_help_has_an_example(command):
    text = succeeded(run(*command, "--help")).stdout
    assert "Example" in text
    assert "eigengs-dr " + " ".join(command) in text


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
        arrays = [file[key] for key in file.files]
    assert all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f")
    return result.stderr


@pytest.fixture
def existing(tmp_path):
    """An output file of an earlier run, which a refused run has to leave as it is."""
    path = tmp_path / "existing.npz"
    path.write_bytes(b"earlier")
    before = sorted(tmp_path.iterdir())
    yield path
    assert path.read_bytes() == b"earlier"
    assert set(before) <= set(tmp_path.iterdir())


def test_missing_image(tmp_path, existing):
    assert_refused(run("fit", tmp_path / "gone.png", "-o", existing), "gone.png")


def test_folder_as_image(tmp_path, existing):
    assert_refused(run("fit", tmp_path, "-o", existing), tmp_path)


@pytest.mark.parametrize("content", [b"", b"this is text, not a picture\n"])
def test_file_that_is_no_image(tmp_path, existing, content):
    (tmp_path / "x.png").write_bytes(content)
    assert_refused(run("fit", tmp_path / "x.png", "-o", existing), "x.png")


def test_truncated_image(photo, existing):
    photo.write_bytes(photo.read_bytes()[:300])
    assert_refused(run("fit", photo, "-o", existing), photo)


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [
        ("--gaussians", 0, "gaussians"),
        ("--gaussians", -5, "gaussians"),
        ("--gaussians", "many", "gaussians"),
        ("--gaussians", 1025, "1025"),
        ("--iterations", -1, "iterations"),
        ("--init", "nowhere", "init"),
        ("--seed", -1, "seed"),
    ],
)
def test_bad_settings(photo, existing, option, value, word):
    assert_refused(run("fit", photo, "-o", existing, option, value), word)


def test_cuda_without_gpu(photo, existing):
    try:
        select("cuda")
    except BackendError:
        assert_refused(run("fit", photo, "-o", existing, "--backend", "cuda"), "CUDA", "llvm")
    else:
        pytest.skip("this machine has a GPU")


def test_unwritable_outputs(photo, existing, tmp_path, monkeypatch):
    monkeypatch.setattr(eg, "fit", lambda *_, **__: pytest.fail("the work was started"))
    gone = tmp_path / "gone"
    assert_refused(run("fit", photo, "-o", gone / "x.npz"), gone)
    assert_refused(run("fit", photo, "-o", photo / "x.npz"), photo)
    assert_refused(run("fit", photo, "-o", existing, "--report", gone / "r.json"), gone)
    assert_refused(run("fit", photo, "-o", existing, "--report", tmp_path), tmp_path)
    assert_refused(run("fit", photo, "-o", existing, "--preview", gone / "p.png"), gone)


def test_outputs_of_the_wrong_kind(photo, existing, tmp_path):
    assert_refused(run("fit", photo, "-o", tmp_path / "x.png"), "x.png", ".npz")
    assert_refused(run("fit", photo, "-o", existing, "--preview", tmp_path / "p.txt"), ".png")


def test_outputs_that_would_overwrite_each_other(photo, existing, tmp_path):
    assert_refused(run("fit", photo, "-o", existing, "--report", existing), existing)
    pixels = photo.read_bytes()
    assert_refused(run("fit", photo, "-o", existing, "--preview", photo), photo)
    assert photo.read_bytes() == pixels
    (tmp_path / "sub").mkdir()
    shutil.copy(photo, tmp_path / "sub" / "photo.png")
    assert_refused(
        run("fit", photo, tmp_path / "sub" / "photo.png", "-o", tmp_path / "out"), "name"
    )


def test_several_images_into_a_file(photo, existing):
    assert_refused(run("fit", photo, photo, "-o", existing), existing, "folder")


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.95])
def test_truncated_model(fitted, existing, tmp_path, keep):
    folder, _ = fitted
    content = (folder / "fit.npz").read_bytes()
    model = tmp_path / "cut.npz"
    model.write_bytes(content[: keep if isinstance(keep, int) else int(keep * len(content))])
    assert_refused(run("info", model), "cut.npz")
    assert_refused(run("render", model, "-o", tmp_path / "y.png"), "cut.npz")
    assert not (tmp_path / "y.png").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--scale", "2", "--size", "10x10"],
        ["--scale", "0"],
        ["--scale", "-1"],
        ["--scale", "nan"],
        ["--scale", "inf"],
        ["--scale", "1e9"],
        ["--size", "10"],
        ["--size", "0x10"],
        ["--size", "10x-1"],
        ["--size", "99999999999x10"],
    ],
)
def test_bad_render_sizes(fitted, tmp_path, options):
    folder, _ = fitted
    assert_refused(run("render", folder / "fit.npz", "-o", tmp_path / "y.png", *options))
    assert not (tmp_path / "y.png").exists()


def test_interrupted_fit_is_kept(photo, tmp_path, monkeypatch):
    complete = eg.fit

    def interrupted(*arguments, **settings):
        result = complete(*arguments, **settings)
        return result._replace(stopped="interrupted")

    monkeypatch.setattr(eg, "fit", interrupted)
    settings = ["--gaussians", 20, "--iterations", 1, "--report", tmp_path / "r.json"]
    result = run("fit", photo, "-o", tmp_path / "x.npz", *settings)
    assert result.exit_code == 130
    assert result.stderr.count("\n") == 1
    assert "interrupted" in result.stderr
    assert json.loads((tmp_path / "r.json").read_text())["stopped"] == "interrupted"
    assert succeeded(run("info", tmp_path / "x.npz"))


def test_interrupted_before_there_is_a_fit(photo, existing, monkeypatch):
    def interrupted(*arguments, **settings):
        raise KeyboardInterrupt

    monkeypatch.setattr(eg, "fit", interrupted)
    result = run("fit", photo, "-o", existing)
    assert result.exit_code == 130
    assert result.stderr.strip() == "eigengs-dr: interrupted"


SMALL = ["--size", "32x32", "--components", 6, "--gaussians", 60]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with images, a model of them and all that was said of it; tests read them only."""
    folder = tmp_path_factory.mktemp("trained")
    random_fields(folder / "photos", 12)
    outputs = ["-o", folder / "m.npz", "--report", folder / "m.json", "--preview", folder / "m.png"]
    result = run("train", folder / "photos", *outputs, *SMALL, "--frequency-aware", "yes")
    return folder, succeeded(result)


def test_train_says_what_it_did(trained):
    folder, result = trained
    words = ("11 images", "6+6+6 components", "60 Gaussians", "psnr_pca", "psnr_init", "m.png")
    assert all(word in result.stdout for word in words)
    assert result.stdout.count("\n") == 3
    assert result.stderr == ""
    assert not (folder / "m.npz.checkpoint").exists()


def test_train_report(trained):
    folder, _ = trained
    report = json.loads((folder / "m.json").read_text())
    expected = {
        "input": str(folder / "photos"),
        "output": str(folder / "m.npz"),
        "size": [32, 32],
        "components": [6, 6, 6],
        "most_components": 6,
        "gaussians": 60,
        "frequency_aware": True,
        "energy": None,
        "preset": "default",
        "color": "ycbcr",
        "seed": 0,
        "resumed": False,
    }
    assert {key: report[key] for key in expected} == expected
    assert report["command"].startswith("eigengs-dr train ")
    assert report["versions"]["drjit"]
    for key in ("seconds", "pca_seconds", "shape_seconds", "weight_seconds", "peak_rss_mb"):
        assert report[key] > 0
    assert report["psnr_solved"] > report["psnr_init"] > 15
    assert report["psnr_init"] == pytest.approx(report["psnr_pca"], abs=1.5)


def test_train_without_images_to_hold_out(tmp_path):
    folder = random_fields(tmp_path / "few", 5)
    outputs = ["-o", tmp_path / "m.npz", "--report", tmp_path / "m.json"]
    result = succeeded(run("train", folder, *outputs, *SMALL))
    assert "no image was held out" in result.stdout
    assert "note: 5 images give at most 4 components" in result.stderr
    report = json.loads((tmp_path / "m.json").read_text())
    assert [report[key] for key in ("psnr_pca", "psnr_init", "psnr_solved")] == [None] * 3


def test_train_options(trained, tmp_path):
    folder, _ = trained
    options = ["--energy", 0.5, "--color", "rgb", "--seed", 3, "--preset", "eigengs", "--steps", 2]
    size = ["--size", "16x16", "--components", "6,5,4", "--quiet"]
    outputs = ["-o", tmp_path / "m.npz", "--report", tmp_path / "m.json"]
    result = succeeded(run("train", folder / "photos", *outputs, *size, *options))
    assert result.stdout == ""
    report = json.loads((tmp_path / "m.json").read_text())
    expected = {"energy": 0.5, "color": "rgb", "seed": 3, "preset": "eigengs", "steps": 2}
    assert {key: report[key] for key in expected} == expected
    assert report["gaussians"] == 256  # one a pixel
    assert report["most_components"] == [6, 5, 4]
    assert max(report["components"]) < 6


def test_train_interrupted_goes_on(trained, tmp_path, monkeypatch):
    folder, _ = trained

    @contextmanager
    def presses(quiet):
        def show(stage, done, total):
            if stage == "weights":
                os.kill(os.getpid(), signal.SIGINT)

        yield show

    command = ["train", folder / "photos", "-o", tmp_path / "m.npz", *SMALL]
    with monkeypatch.context() as patched:
        patched.setattr(cli_train, "progress_bar", presses)
        result = run(*command)
    assert result.exit_code == 130
    assert result.stderr == "eigengs-dr: interrupted; the same command goes on from here\n"
    assert result.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == ["m.npz.checkpoint"]

    assert_refused(run(*command, "--seed", 1), "m.npz.checkpoint", "seed 0", "delete")
    succeeded(run(*command, "--report", tmp_path / "m.json"))
    assert json.loads((tmp_path / "m.json").read_text())["resumed"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.json", "m.npz"]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--gaussians", 1025, "--size", "32x32"], "gaussians is 1025"),
        (["--gaussians", 0], "gaussians"),
        (["--components", "3,4"], "3,4: expected a number above 0, or three such as 230,60,60"),
        (["--components", "many"], "many: expected a number"),
        (["--components", 0], "components"),
        (["--energy", 0], "energy"),
        (["--energy", 1.01], "energy"),
        (["--size", "32"], "such as 1024x768"),
        (["--size", "0x32"], "0x32"),
        (["--size", "99999x99999"], "99999x99999"),
        (["--steps", -1], "steps"),
        (["--frequency-aware", "perhaps"], "frequency-aware"),
        (["--preset", "gaussianimage"], "preset"),
        (["--color", "lab"], "color"),
    ],
)
def test_train_with_bad_settings(trained, existing, options, word):
    folder, _ = trained
    before = sorted(existing.parent.iterdir())
    assert_refused(run("train", folder / "photos", "-o", existing, *options), word)
    assert sorted(existing.parent.iterdir()) == before


def test_train_with_bad_paths(trained, existing, tmp_path):
    folder, _ = trained
    photos = folder / "photos"
    assert_refused(run("train", tmp_path / "gone", "-o", existing), "gone")
    assert_refused(run("train", photos / "000.png", "-o", existing), "000.png")
    (tmp_path / "empty").mkdir()
    assert_refused(run("train", tmp_path / "empty", "-o", existing), "holds no images")
    assert_refused(run("train", photos, "-o", tmp_path / "m.png"), ".npz")
    assert_refused(run("train", photos, "-o", tmp_path / "gone" / "m.npz"), "gone")
    assert_refused(run("train", photos, "-o", existing, "--report", tmp_path / "gone" / "r"), "r")
    assert_refused(run("train", photos, "-o", existing, "--preview", tmp_path / "p.txt"), ".png")
    over = run("train", photos, "-o", existing, "--preview", photos / "000.png")
    assert_refused(over, "000.png", "is read")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "x.png").write_bytes(b"no picture")
    assert_refused(run("train", tmp_path / "bad", "-o", existing, *SMALL), "none of 1", "x.png")
    assert not (existing.parent / "existing.npz.checkpoint").exists()


def test_info_of_a_model(trained, tmp_path):
    folder, _ = trained
    preview = tmp_path / "sheet.png"
    found = json.loads(
        succeeded(run("info", folder / "m.npz", "--json", "--preview", preview)).stdout
    )
    expected = {
        "kind": "model",
        "gaussians": 60,
        "width": 32,
        "height": 32,
        "space": "ycbcr",
        "components": [6, 6, 6],
        "frequency_aware": True,
        "low_gaussians": 6,
        "high_gaussians": 54,
        "low_components": 3,
    }
    assert {key: found[key] for key in expected} == expected
    assert found["bytes"] == (folder / "m.npz").stat().st_size
    assert Image.open(preview).width < Image.open(folder / "m.png").width + 1 < 2001
    assert "low_components   3" in run("info", folder / "m.npz").stdout


def test_info_of_the_basis_that_ships(tmp_path):
    found = json.loads(succeeded(run("info", "natural", "--json")).stdout)
    assert found["file"] == str(bases.SHIPPED["natural"])
    assert found["components"] == found["fall"][-1]["components"] == [230, 60, 60]
    assert found["split_reason"]
    assert_refused(run("info", tmp_path / "natural"), tmp_path / "natural", "No such file")
    assert_refused(run("info", tmp_path), tmp_path, "Is a directory")


def test_info_preview_of_an_image(fitted, tmp_path):
    folder, _ = fitted
    succeeded(run("info", folder / "fit.npz", "--preview", tmp_path / "info.png"))
    succeeded(run("render", folder / "fit.npz", "-o", tmp_path / "render.png"))
    assert (tmp_path / "info.png").read_bytes() == (tmp_path / "render.png").read_bytes()
    gone = run("info", folder / "fit.npz", "--preview", tmp_path / "gone" / "x.png")
    assert_refused(gone, "gone")


def test_info_of_something_else(trained, tmp_path):
    folder, _ = trained
    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    assert_refused(run("info", tmp_path / "x.npz"), "x.npz", "format")
    np.savez(tmp_path / "x.npz", format=np.array("something.else"))
    assert_refused(run("info", tmp_path / "x.npz"), "something.else", "eigengs_dr.model")
    assert_refused(run("info", folder / "m.png"), "m.png")
    assert_refused(run("render", folder / "m.npz", "-o", tmp_path / "y.png"), "eigengs_dr.model")


def test_fit_from_an_eigenbasis(trained, photo, tmp_path):
    folder, _ = trained
    start = ["--init", "eigen", "--basis", folder / "m.npz", "--report", tmp_path / "r.json"]
    succeeded(run("fit", photo, "-o", tmp_path / "x.npz", *start, "--iterations", 30))
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["gaussians"] == 60
    assert report["basis"] == str(folder / "m.npz")
    model = EigenGS.load(folder / "m.npz")
    image = eg.load_image(photo)
    encoded = eg.psnr(image, eg.render(model.encode(image)).numpy(), space="ycbcr")
    assert report["trace"][0]["psnr_ycbcr"] == pytest.approx(encoded, abs=0.1)
    assert report["psnr_ycbcr"] > encoded


def test_the_basis_is_read_once(trained, photo, tmp_path, monkeypatch):
    folder, _ = trained
    loaded = []
    load = EigenGS.load
    monkeypatch.setattr(EigenGS, "load", lambda *given: loaded.append(given) or load(*given))
    start = ["--init", "eigen", "--basis", folder / "m.npz", "--iterations", 0]
    shutil.copy(photo, tmp_path / "other.png")
    succeeded(run("fit", photo, tmp_path / "other.png", "-o", tmp_path / "fits", *start))
    assert len(loaded) == 1


def test_the_papers_form_lacks_the_mean_image(trained, photo, tmp_path):
    folder, _ = trained
    options = ["--preset", "eigengs", "--basis", folder / "m.npz", "--iterations", 2]
    outputs = ["-o", tmp_path / "x.npz", "--preview", tmp_path / "both.png"]
    result = succeeded(run("fit", photo, *outputs, *options))
    assert result.stderr.count("\n") == 1
    assert "note: " in result.stderr
    assert "mean image is kept in the basis" in result.stderr
    _, fit, _ = previewed(tmp_path / "both.png")
    model = EigenGS.load(folder / "m.npz")
    added = model.dense_mean(32, 32) @ YCBCR_TO_RGB.T
    saved = eg.render(eg.Gaussians.load(tmp_path / "x.npz")).numpy()
    shown = np.clip(saved + added, 0, 1) * 255
    assert np.abs(shown - fit).max() < 1.5


def test_bases_that_do_not_fit(trained, fitted, photo, existing, tmp_path):
    folder, _ = trained
    eigen = ["fit", photo, "-o", existing, "--init", "eigen"]
    model = folder / "m.npz"
    assert_refused(run(*eigen, "--basis", "nowhere"), "'nowhere'", "natural")
    assert_refused(run(*eigen, "--basis", fitted[0] / "fit.npz"), "eigengs_dr.gaussians")
    assert_refused(run(*eigen, "--basis", tmp_path), "basis")
    assert_refused(run(*eigen, "--basis", model, "--gaussians", 50), photo, "50", "60")
    assert_refused(run(*eigen, "--basis", model, "--color", "rgb"), photo, "'rgb'", "'ycbcr'")


def test_the_names_of_inits_and_bases():
    [option] = [p for p in main.commands["fit"].params if p.name == "init"]
    assert tuple(option.type.choices) == INITS
    [option] = [p for p in main.commands["fit"].params if p.name == "color"]
    assert tuple(option.type.choices) == SPACES
    [option] = [p for p in main.commands["fit"].params if p.name == "basis"]
    assert option.default in bases.SHIPPED


def test_help_loads_nothing_heavy():
    script = (
        "import sys; from eigengs_dr.cli import main\n"
        "try: main(['train', '--help'])\n"
        "except SystemExit: print(*(n for n in ('drjit', 'scipy', 'PIL') if n in sys.modules))"
    )
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert process.stdout.splitlines()[-1] == ""
