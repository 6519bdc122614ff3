"""The command `fit` of one image: results, reports, and one line for every mistake."""

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
from eigengs_dr.cli.fit import DEFAULT_BASIS
from eigengs_dr.cli.main import main
from eigengs_dr.eigenbasis.eigengs import SHIPPED
from eigengs_dr.storage.atomic import lock_output

QUICK = ("--gaussians", 20, "--iterations", 1)


def test_fit_says_what_it_did(fitted):
    folder, result = fitted
    for word in ("50 Gaussians", "5 iterations", "psnr_ycbcr", "psnr_rgb"):
        assert word in result.stdout
    photo, fit, outlines = previewed(folder / "both.png")
    assert photo.shape == fit.shape == outlines.shape == (24, 32, 3)
    assert np.array_equal(photo, smooth_pixels(32, 24))
    assert np.abs(fit.astype(int) - photo).mean() < 30
    assert outlines.mean() > fit.mean() + 20
    assert f"{folder / 'both.png'} (photo, fit and outlines side by side)" in result.stdout


def test_fit_report(fitted):
    folder, _ = fitted
    report = json.loads((folder / "fit.json").read_text())
    expected = {"gaussians": 50, "width": 32, "height": 24, "seed": 0, "stopped": "iterations"}
    expected |= {"input": str(folder / "photo.png"), "output": str(folder / "fit.npz")}
    assert {key: report[key] for key in expected} == expected
    assert report["command"].startswith("eigengs-dr fit ")
    assert "--iterations 5" in report["command"]
    assert report["backend"] in ("llvm", "cuda") and report["threads"] >= 1
    assert report["versions"]["drjit"] and report["iterations"] == 5
    assert report["psnr_ycbcr"] > report["psnr_rgb"] > 15
    assert 0 < report["ssim"] <= 1 and 0 < report["ms_ssim"] <= 1
    assert 0 <= report["seconds_init"] <= report["seconds"]
    assert report["seconds_load"] + report["seconds"] <= report["seconds_total"]
    assert {"iteration", "seconds", "psnr_ycbcr", "psnr_rgb"} <= set(report["trace"][-1])


def test_the_report_of_an_exact_fit_has_no_infinity(tmp_path):
    """Nor does a small image get more Gaussians than pixels, in the current folder by default."""
    Image.new("RGB", (6, 4)).save(tmp_path / "x.png")
    report = tmp_path / "r.json"
    command = ["fit", tmp_path / "x.png", "-o", tmp_path, "--iterations", 0, "--report", report]
    assert succeeded(run(*command, "--quiet")).output == ""
    assert json.loads(report.read_text())["psnr_rgb"] is None
    assert len(eg.Gaussians.load(tmp_path / "x.npz")) == 24


def test_a_note_is_one_line(tmp_path):
    Image.fromarray(smooth_pixels(20, 12, 4), "RGBA").save(tmp_path / "x.png")
    said = succeeded(run("fit", tmp_path / "x.png", "-o", tmp_path / "x.npz", *QUICK)).stderr
    assert said.startswith("eigengs-dr: note: ") and said.count("\n") == 1 and "white" in said


MISTAKES = {
    "few": (["--gaussians", 0], ["gaussians"]),
    "many": (["--gaussians", 1025], ["photo.png: gaussians is 1025"]),
    "init": (["--init", "nowhere"], ["init"]),
    "both": (
        ["--target-psnr", 30, "--gaussians", 9],
        ["--gaussians and --target-psnr exclude each other"],
    ),
    "space alone": (["--target-space", "ycbcr"], ["need --target-psnr"]),
    "most alone": (["--max-gaussians", 50], ["need --target-psnr"]),
    "levels": (["--gaussians", 64, "--levels", 9], ["photo.png: levels is 9"]),
    "levels, init": (["--levels", 2, "--init", "grid"], ["levels"]),
    "levels, target": (["--levels", 2, "--target-psnr", 30], ["levels"]),
    "counts": (["--gaussians", 65, "--levels", "16,40,64"], ["16"]),
    "signs": (["--levels", "16;40"], ["16;40: expected a number, or several"]),
    "cluster": (["--cluster", "local"], ["--cluster takes several images"]),
    "blocks, target": (["--blocks", 64, "--target-psnr", 30], ["--blocks needs", "--target-psnr"]),
    "blocks, preview": (["--blocks", 64, "--preview", "x.png"], ["--blocks needs", "--preview"]),
    "blocks, init": (["--blocks", 64, "--init", "random"], ["--blocks needs"]),
    "small blocks": (["--blocks", 5], ["at least 32"]),
    "no blocks": (["--blocks", 0], ["--blocks"]),
    "blocks, basis": (["--blocks", 64, "--basis", "natural"], ["--blocks needs", "--basis"]),
    "basis": (["--basis", "nowhere"], ["'nowhere'", "natural"]),
    "basis, folder": (["--basis", "."], ["neither a file"]),
    "no folder": (["-o", "gone/x.npz"], ["gone"]),
    "no folder, report": (["--report", "gone/r.json"], ["gone"]),
    "no folder, preview": (["--preview", "gone/p.png"], ["gone"]),
    "a folder": (["--report", "."], ["is a folder"]),
    "suffix": (["-o", "x.png"], ["x.png", ".npz"]),
    "packed": (["-o", "x.egs"], ["must end in .npz; 'eigengs-dr pack' writes .egs files"]),
    "suffix of a picture": (["--preview", "p.txt"], [".png"]),
    "twice": (["--report", "existing.npz"], ["existing.npz", "is written"]),
    "the image": (["--preview", "photo.png"], ["photo.png", "is read"]),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(photo, existing, case, monkeypatch):
    monkeypatch.chdir(existing.parent)
    pixels = photo.read_bytes()
    options, words = MISTAKES[case]
    assert_refused(run("fit", "photo.png", "-o", existing, "--overwrite", *options), *words)
    assert photo.read_bytes() == pixels


def test_a_file_that_is_no_image(tmp_path, existing):
    (tmp_path / "x.png").write_text("this is text, not a picture")
    assert_refused(run("fit", tmp_path / "x.png", "-o", existing, "--overwrite"), "x.png")


def test_cuda_without_gpu(photo, existing):
    try:
        select("cuda")
    except BackendError:
        command = ["fit", photo, "-o", existing, "--overwrite", "--backend", "cuda"]
        assert_refused(run(*command), "CUDA", "llvm")
    else:
        pytest.skip("this machine has a GPU")


@pytest.fixture
def interrupts(photo, tmp_path):
    """What Ctrl-C raises: functions of the library, their errors and what the command says."""
    kept = replace(eg.fit(photo, 20, iterations=1), stopped="interrupted")
    rows = eg.fit_many([smooth_pixels(32, 32)] * 2, gaussians=20, iterations=1)
    out = tmp_path / "x.npz"
    return {
        "early": ("fit", KeyboardInterrupt(), "interrupted"),
        "whole": ("fit", eg.Interrupted(kept, ""), f"interrupted; the best fit so far is in {out}"),
        "many": ("fit_many", eg.Interrupted(rows[:1], ""), "interrupted; 1 of 2 images are done"),
        "blocks": (
            "fit_large",
            eg.Interrupted(rows[0], ""),
            f"interrupted; finished blocks are in {out}",
        ),
    }


@pytest.mark.parametrize("case", ["early", "whole", "many", "blocks"])
def test_interrupts(photo, tmp_path, interrupts, case, monkeypatch):
    function, error, words = interrupts[case]

    def interrupted(*arguments, **settings):
        raise error

    monkeypatch.setattr(eg, function, interrupted)
    shutil.copy(photo, tmp_path / "b.png")
    images, out = [photo], tmp_path / "x.npz"
    if case == "many":
        images, out = [photo, tmp_path / "b.png"], tmp_path / "out"
    blocks = ["--blocks", 32] if case == "blocks" else []
    told = run("fit", *images, "-o", out, *blocks, "--report", tmp_path / "r.json")
    assert told.exit_code == 130
    assert told.stderr.strip().startswith(f"eigengs-dr: {words}")
    assert told.stderr.strip().count("\n") == 0
    if case == "whole":
        assert json.loads((tmp_path / "r.json").read_text())["stopped"] == "interrupted"
        assert len(eg.Gaussians.load(out)) == 20
    if case == "blocks":
        assert json.loads((tmp_path / "r.json").read_text())["stopped"] == "interrupted"
    if case == "many":
        assert len(json.loads((tmp_path / "r.json").read_text())["images"]) == 1


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
    assert "psnr_rgb of 60 dB is out of reach: 50 Gaussians reach" in result.stderr
    assert len(eg.Gaussians.load(out)) == 50
    assert run(*base, "--target-psnr", 26, "--target-space", "ycbcr").exit_code == 0
    assert json.loads(report.read_text())["psnr_ycbcr"] >= 26


@pytest.mark.parametrize("options", [[], ["-o", "photo.npz"], ["--overwrite"], ["--blocks", 32]])
def test_a_model_is_never_replaced(trained, photo, tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    shutil.copy(trained[0] / "m.npz", tmp_path / "photo.npz")
    before = (tmp_path / "photo.npz").read_bytes()
    reason = "photo.npz: exists and is not a set of Gaussians; choose another name with -o"
    assert_refused(run("fit", photo, *options, *QUICK), reason)
    assert_refused(run("fit", photo, "--basis", "photo.npz"), "photo.npz: is read too")
    assert (tmp_path / "photo.npz").read_bytes() == before


@pytest.mark.parametrize("options", [[], ["-o", "photo.npz", "--overwrite"], ["--blocks", 32]])
def test_a_result_is_written_anew(photo, tmp_path, monkeypatch, options):
    """As `render`, `pack` and `train` do; so a killed run is repeated by the same command."""
    monkeypatch.chdir(tmp_path)
    command = ["fit", photo, *options, "--gaussians", 20, "--iterations"]
    succeeded(run(*command, 1))
    before = (tmp_path / "photo.npz").read_bytes()
    succeeded(run(*command, 2, "--report", "r.json"))
    assert (tmp_path / "photo.npz").read_bytes() != before
    assert json.loads((tmp_path / "r.json").read_text())["iterations"] == 2
    assert {path.name for path in tmp_path.iterdir()} == {"photo.png", "photo.npz", "r.json"}


def test_a_second_run_into_one_file_says_who_writes(photo, existing):
    with lock_output(existing):
        told = run("fit", photo, "-o", existing, *QUICK)
    assert_refused(told, "existing.npz: process", "writes into this file; wait for its end")


# --- From an eigenbasis ---


def test_fit_from_an_eigenbasis(trained, photo, tmp_path):
    file, report = trained[0] / "m.npz", tmp_path / "r.json"
    command = ["fit", photo, "-o", tmp_path / "x.npz", "--basis", file, "--report", report]
    succeeded(run(*command, "--iterations", 30))
    told, image = json.loads(report.read_text()), eg.load_image(photo)
    assert (told["gaussians"], told["basis"]) == (60, str(file))
    model = eg.EigenGS.load(file)
    encoded = eg.psnr(image, eg.render(model.encode(image)).numpy(), space="ycbcr")
    assert told["trace"][0]["psnr_ycbcr"] == pytest.approx(encoded, abs=0.1)
    assert told["psnr_ycbcr"] > encoded
    for options, words in (
        (["--gaussians", 50], ["50", "60"]),
        (["--space", "rgb"], ["'rgb'", "'ycbcr'"]),
        (["--init", "grid"], ["--init and --basis"]),
        (["--basis", tmp_path / "x.npz"], ["eigengs_dr.gaussians"]),
    ):
        assert_refused(run(*command, "--overwrite", *options), *words)
    [option] = [p for p in main.commands["fit"].params if p.name == "basis"]
    assert DEFAULT_BASIS in SHIPPED and DEFAULT_BASIS in option.help


def test_the_papers_form_lacks_the_mean_image(trained, photo, tmp_path):
    folder, _ = trained
    options = ["--preset", "eigengs", "--basis", folder / "m.npz", "--iterations", 2]
    outputs = ["-o", tmp_path / "x.npz", "--preview", tmp_path / "both.png"]
    result = succeeded(run("fit", photo, *outputs, *options))
    assert result.stderr.count("\n") == 1 and "note: " in result.stderr
    assert "mean image stays in the basis" in result.stderr
    _, fit, _ = previewed(tmp_path / "both.png")
    saved = eg.render(eg.Gaussians.load(tmp_path / "x.npz")).numpy()
    assert np.abs(np.clip(saved, 0, 1) * 255 - fit).mean() > 20  # the preview has it


# --- Levels of detail ---


def test_levels(photo, tmp_path):
    fitted, small, report = (tmp_path / f"a.{end}" for end in ("npz", "egs", "json"))
    base = ["fit", photo, "-o", fitted, "--overwrite", "--quiet", "--iterations", 5]
    succeeded(run(*base, "--gaussians", 64, "--levels", 2))
    succeeded(run("pack", fitted, "-o", small, "--levels", 2))
    assert json.loads(run("info", small, "--json").stdout)["sections"] == [16, 48]
    out = tmp_path / "b.png"
    succeeded(run("render", fitted, "-o", out, "--first", 16))
    expected = eg.picture_of(eg.Gaussians.load(fitted)[:16]).clip(0, 1)
    assert np.abs(eg.load_image(out) - expected).max() < 0.003
    said = "--first is 65; the file has 64 Gaussians"
    assert_refused(run("render", fitted, "-o", out, "--first", 65), said)

    succeeded(run(*base, "--levels", "16,40,64", "--report", report))
    assert json.loads(report.read_text())["levels"] == [16, 40, 64]
    succeeded(run("pack", fitted, "-o", small, "--levels", "16,40,64"))
    assert json.loads(run("info", small, "--json").stdout)["sections"] == [16, 24, 24]
    assert_refused(run("pack", fitted, "-o", small, "--levels", "16,40"), "levels 16, 40")
