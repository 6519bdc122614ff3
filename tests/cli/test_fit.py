"""The command `fit`: results, reports, and one line and exit code 2 for every mistake."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, previewed, run, smooth_pixels, succeeded
from _helpers.halves import picture
from eigengs_dr.backend.selection import BackendError, select
from eigengs_dr.fitting import fit as fit_module


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
    assert sorted(path.name for path in (tmp_path / "fits").glob("*.npz")) == [
        "other.npz",
        "photo.npz",
    ]
    assert (tmp_path / "previews" / "other.png").exists()
    report = json.loads((tmp_path / "r.json").read_text())
    assert [row["width"] for row in report["images"]] == [32, 20]
    assert "versions" in report


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
    assert_refused(run("fit", photo, "-o", existing, "--overwrite", option, value), word)


def test_cuda_without_gpu(photo, existing):
    try:
        select("cuda")
    except BackendError:
        command = ["fit", photo, "-o", existing, "--overwrite", "--backend", "cuda"]
        assert_refused(run(*command), "CUDA", "llvm")
    else:
        pytest.skip("this machine has a GPU")


def test_interrupted_fit_is_kept(photo, tmp_path, monkeypatch):
    complete = fit_module.fit_image

    def interrupted(*arguments, **settings):
        result = complete(*arguments, **settings)
        raise eg.FitInterrupted(replace(result, stopped="interrupted"))

    monkeypatch.setattr(fit_module, "fit_image", interrupted)
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

    monkeypatch.setattr(fit_module, "fit_image", interrupted)
    result = run("fit", photo, "-o", existing, "--overwrite")
    assert result.exit_code == 130
    assert result.stderr.strip() == "eigengs-dr: interrupted"


def test_command_finds_few_or_says_that_it_cannot(tmp_path):
    image, out, report = tmp_path / "a.png", tmp_path / "a.npz", tmp_path / "a.json"
    eg.save_image(image, picture())
    base = ["fit", image, "-o", out, "--overwrite", "--quiet", "--iterations", 40]
    base += ["--report", report]
    assert run(*base, "--target-psnr", 26).exit_code == 0
    told = json.loads(report.read_text())
    assert told["stopped"] == "met" and told["psnr_rgb"] >= 26
    assert told["gaussians"] == len(eg.Gaussians.load(out))

    result = run(*base, "--target-psnr", 60, "--max-gaussians", 50)
    assert result.exit_code == 1
    assert "60 dB psnr_rgb are out of reach: 50 Gaussians have" in result.stderr
    assert len(eg.Gaussians.load(out)) == 50

    assert run(*base, "--target-psnr", 26, "--target-space", "ycbcr").exit_code == 0
    assert json.loads(report.read_text())["psnr_ycbcr"] >= 26

    for option in (
        ("--target-space", "ycbcr"),
        ("--max-gaussians", 50),
        ("--levels", 2, "--target-space", "ycbcr"),
    ):
        alone = run(*base, *option)
        assert alone.exit_code == 2 and "belong to target_psnr" in alone.stderr

    both = run(*base, "--target-psnr", 30, "--gaussians", 9)
    assert both.exit_code == 2
    assert "exclude each other" in both.stderr


# --- What one would try first -------------------------------------------------------------------

QUICK = ("--gaussians", 20, "--iterations", 1)


def test_without_output_the_current_folder_is_used(photo, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    succeeded(run("fit", photo, *QUICK))
    assert len(eg.Gaussians.load(tmp_path / "here" / "photo.npz")) == 20


def test_a_folder_is_fitted(photo, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a.png", "b.png"):
        shutil.copy(photo, folder / name)
    succeeded(run("fit", folder, "-o", tmp_path / "fits", *QUICK))
    assert sorted(p.name for p in (tmp_path / "fits").iterdir()) == [
        "a.npz",
        "b.npz",
        "manifest.jsonl",
    ]


def test_a_folder_of_one_image_is_fitted(photo, tmp_path):
    folder, report = tmp_path / "photos", tmp_path / "r.json"
    folder.mkdir()
    shutil.copy(photo, folder / "a.png")
    outputs = ["-o", tmp_path / "fits", "--preview", tmp_path / "previews", "--report", report]
    succeeded(run("fit", folder, *outputs, *QUICK))
    assert sorted(p.name for p in (tmp_path / "fits").iterdir()) == ["a.npz", "manifest.jsonl"]
    assert [p.name for p in (tmp_path / "previews").iterdir()] == ["a.png"]
    assert len(json.loads(report.read_text())["images"]) == 1


def test_several_images_are_not_written_to_a_file(photo, tmp_path):
    other = tmp_path / "other.png"
    shutil.copy(photo, other)
    assert_refused(run("fit", photo, other, "-o", tmp_path / "out.npz", *QUICK), "need a folder")
    assert not (tmp_path / "out.npz").exists()


def test_the_report_has_all_of_the_time(fitted):
    report = json.loads((fitted[0] / "fit.json").read_text())
    assert report["seconds_init"] <= report["seconds"] <= report["seconds_total"]
    assert report["seconds_load"] + report["seconds"] <= report["seconds_total"]


def test_a_bad_image_does_not_end_a_folder(photo, tmp_path):
    """It is named at once, and in the report; the others are fitted."""
    folder, report = tmp_path / "photos", tmp_path / "r.json"
    folder.mkdir()
    for name in ("a.png", "c.png"):
        shutil.copy(photo, folder / name)
    (folder / "b.png").write_text("no image")
    result = run("fit", folder, "-o", tmp_path / "fits", "--report", report, *QUICK)
    assert result.exit_code == 2
    assert "b.png" in result.stderr and result.stderr.count("\n") == 1
    assert sorted(p.name for p in (tmp_path / "fits").iterdir()) == [
        "a.npz",
        "c.npz",
        "manifest.jsonl",
    ]
    images = json.loads(report.read_text())["images"]
    assert [image["stopped"] for image in images] == ["iterations", "failed", "iterations"]
    assert "b.png" in images[1]["error"]


@pytest.mark.parametrize("options", [[], ["-o", "photo.npz"], ["--overwrite"], ["--blocks", 32]])
def test_a_model_is_never_replaced(trained, photo, tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    shutil.copy(trained[0] / "m.npz", tmp_path / "photo.npz")
    before = (tmp_path / "photo.npz").read_bytes()
    reason = "photo.npz: exists and is no set of Gaussians; choose another name with -o"
    assert_refused(run("fit", photo, *options, *QUICK), reason)
    assert (tmp_path / "photo.npz").read_bytes() == before


@pytest.mark.parametrize("options", [[], ["-o", "photo.npz"], ["--blocks", 32]])
def test_a_result_is_kept(photo, tmp_path, monkeypatch, options):
    """As those of several images are; nothing else is written either."""
    monkeypatch.chdir(tmp_path)
    command = ["fit", photo, *options, "--gaussians", 20, "--iterations"]
    succeeded(run(*command, 1))
    before = (tmp_path / "photo.npz").read_bytes()
    again = succeeded(run(*command, 2, "--report", "r.json"))
    line = "eigengs-dr: photo.npz: exists and is kept; --overwrite fits it again\n"
    assert (again.stdout, again.stderr) == ("", line)
    assert succeeded(run(*command, 2, "--quiet")).output == ""
    assert (tmp_path / "photo.npz").read_bytes() == before
    assert not (tmp_path / "r.json").exists()
    succeeded(run(*command, 2, "--overwrite"))
    assert (tmp_path / "photo.npz").read_bytes() != before
