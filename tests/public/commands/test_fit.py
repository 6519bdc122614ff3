"""The command `fit` of one image: results, reports, blocks, and one line for every mistake."""

import json
import os
import shutil
import sys
import time

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, previewed, run, said, smooth_pixels, succeeded
from _helpers.files import png
from _helpers.process import python_path, run_python, start

QUICK = ("--gaussians", 64, "--iterations", 1)


def read(path):
    return json.loads(path.read_text())


def test_fit_says_what_it_did(fitted):
    folder, result = fitted
    for word in ("64 Gaussians", "5 iterations", "psnr_ycbcr", "psnr_rgb"):
        assert word in result.stdout
    photo, fit, outlines = previewed(folder / "both.png")
    assert photo.shape == fit.shape == outlines.shape == (32, 32, 3)
    assert np.array_equal(photo, smooth_pixels(32, 32))
    assert np.abs(fit.astype(int) - photo).mean() < 30
    assert outlines.mean() > fit.mean() + 20
    assert f"{folder / 'both.png'} (photo, fit and outlines side by side)" in result.stdout


def test_report(fitted):
    folder, _ = fitted
    report = read(folder / "fit.json")
    expected = {"gaussians": 64, "width": 32, "height": 32, "seed": 0, "stopped": "iterations"}
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


def test_report_of_an_exact_fit_has_no_infinity(tmp_path):
    """Nor does a small image get more Gaussians than pixels, in the current folder by default."""
    Image.new("RGB", (6, 4)).save(tmp_path / "x.png")
    report = tmp_path / "r.json"
    command = ["fit", tmp_path / "x.png", "-o", tmp_path, "--iterations", 0, "--report", report]
    assert succeeded(run(*command, "--quiet")).output == ""
    assert read(report)["psnr_rgb"] is None
    assert len(eg.Gaussians.load(tmp_path / "x.npz")) == 24


def test_a_note_is_one_line(tmp_path):
    Image.fromarray(smooth_pixels(32, 32, 4), "RGBA").save(tmp_path / "x.png")
    result = succeeded(run("fit", tmp_path / "x.png", "-o", tmp_path / "x.npz", *QUICK))
    assert result.stderr.startswith("eigengs-dr: note: ") and result.stderr.count("\n") == 1
    assert "white" in result.stderr


MISTAKES = {
    "many": (["--gaussians", 1025], ["photo.png: gaussians is 1025"]),
    "init": (["--init", "nowhere"], ["init"]),
    "both": (["--target-psnr", 30, "--gaussians", 9], ["--gaussians and --target-psnr exclude"]),
    "space alone": (["--target-space", "ycbcr"], ["need --target-psnr"]),
    "keep alone": (["--keep"], ["--keep is for the Gaussians of --start"]),
    "levels": (["--gaussians", 64, "--levels", 9], ["photo.png: levels is 9"]),
    "signs": (["--levels", "16;40"], ["16;40: expected a number, or several"]),
    "cluster": (["--cluster", "local"], ["--cluster takes several images"]),
    "recursive": (["--recursive"], ["--recursive takes a folder of images"]),
    "blocks, target": (
        ["--blocks", 64, "--target-psnr", 30],
        ["--target-psnr and --blocks exclude"],
    ),
    "small blocks": (["--blocks", 5], ["at least 32"]),
    "basis": (["--basis", "nowhere"], ["'nowhere'", "natural"]),
    "basis, init": (["--basis", "none.npz", "--init", "grid"], ["--init and --basis exclude"]),
    "preset, init": (["--preset", "eigengs", "--init", "grid"], ["--init and --basis", "preset"]),
    "no folder": (["-o", "gone/x.npz"], ["gone"]),
    "a folder": (["--report", "."], ["is a folder"]),
    "suffix": (["-o", "x.png"], ["x.png", ".npz"]),
    "packed": (["-o", "x.egs"], ["must end in .npz; 'eigengs-dr pack' writes .egs files"]),
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


@pytest.mark.slow
def test_command_finds_few_or_says_that_it_cannot(photo, tmp_path):
    out, report = tmp_path / "a.npz", tmp_path / "a.json"
    base = ["fit", photo, "-o", out, "--quiet", "--iterations", 20, "--report", report]
    succeeded(run(*base, "--target-psnr", 26, "--target-space", "ycbcr"))
    figures = read(report)
    assert figures["stopped"] == "met" and figures["psnr_ycbcr"] >= 26
    assert figures["gaussians"] == len(eg.Gaussians.load(out))
    result = run(*base, "--target-psnr", 60, "--max-gaussians", 50)
    assert result.exit_code == 1
    assert "psnr_rgb of 60 dB is out of reach: 50 Gaussians reach" in result.stderr
    assert len(eg.Gaussians.load(out)) == 50


@pytest.mark.parametrize("options", [[], ["-o", "photo.npz"], ["--overwrite"], ["--blocks", 32]])
def test_a_model_is_never_replaced(trained, photo, tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    shutil.copy(trained[0] / "m.npz", tmp_path / "photo.npz")
    before = (tmp_path / "photo.npz").read_bytes()
    reason = "photo.npz: exists and is not a set of Gaussians; choose another name with -o"
    assert_refused(run("fit", photo, *options, *QUICK), reason)
    assert_refused(run("fit", photo, "--basis", "photo.npz"), "photo.npz: is read too")
    assert (tmp_path / "photo.npz").read_bytes() == before


@pytest.mark.parametrize("options", [[], ["--blocks", 32]])
def test_a_result_is_written_anew(photo, tmp_path, monkeypatch, options):
    """As `render`, `pack` and `train` do; so a killed run is repeated by the same command."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / ".eigengs_dr-0123456789abcdef.npz").write_bytes(b"half")  # of a killed run
    command = ["fit", photo, *options, "--gaussians", 64, "--iterations"]
    succeeded(run(*command, 1))
    before = (tmp_path / "photo.npz").read_bytes()
    succeeded(run(*command, 2, "--report", "r.json"))
    assert (tmp_path / "photo.npz").read_bytes() != before
    assert read(tmp_path / "r.json")["iterations"] == 2
    assert {path.name for path in tmp_path.iterdir()} == {"photo.png", "photo.npz", "r.json"}


# --- From an eigenbasis, or from a set ---


def test_fit_from_an_eigenbasis(trained, photo, tmp_path):
    file, report = trained[0] / "m.npz", tmp_path / "r.json"
    command = ["fit", photo, "-o", tmp_path / "x.npz", "--basis", file, "--report", report]
    succeeded(run(*command, "--iterations", 20))
    figures, image = read(report), eg.load_image(photo)
    assert (figures["gaussians"], figures["basis"]) == (60, str(file))
    encoded = eg.render(eg.EigenGS.load(file).encode(image)).numpy()
    start = eg.psnr(encoded, image, space="ycbcr")
    assert figures["trace"][0]["psnr_ycbcr"] == pytest.approx(start, abs=0.1)
    assert figures["psnr_ycbcr"] > start
    for options, words in (
        (["--gaussians", 50], ["50", "60"]),
        (["--space", "rgb"], ["'rgb'", "'ycbcr'"]),
        (["--basis", tmp_path / "x.npz"], ["eigengs_dr.gaussians"]),
    ):
        assert_refused(run(*command, "--overwrite", *options), *words)


def test_the_papers_form_lacks_the_mean_image(trained, photo, tmp_path):
    options = ["--preset", "eigengs", "--basis", trained[0] / "m.npz", "--iterations", 2]
    outputs = ["-o", tmp_path / "x.npz", "--preview", tmp_path / "both.png"]
    result = succeeded(run("fit", photo, *outputs, *options))
    assert result.stderr.count("\n") == 1 and "mean image stays in the basis" in result.stderr
    _, fit, _ = previewed(tmp_path / "both.png")
    saved = eg.render(eg.Gaussians.load(tmp_path / "x.npz")).numpy()
    assert np.abs(np.clip(saved, 0, 1) * 255 - fit).mean() > 20  # the preview has it


def test_fit_from_a_set(fitted, photo, tmp_path):
    report = tmp_path / "r.json"
    command = ["fit", photo, "-o", tmp_path / "x.npz", "--start", fitted[0] / "fit.npz"]
    told = said(*command, "--keep", "--iterations", 5, "--report", report)
    assert "kept 64 of 64 Gaussians of the start" in told
    assert read(report)["psnr_ycbcr"] > read(fitted[0] / "fit.json")["psnr_ycbcr"]
    assert_refused(run(*command, "--basis", "natural"), "--start and --basis")


def test_outlines_of_a_preview(tmp_path, monkeypatch):
    """They are one standard deviation away, over a lighter picture; huge ones are not drawn."""
    monkeypatch.chdir(tmp_path)
    eg.save_image("grey.png", np.full((20, 30, 3), 0.5))
    factor = np.array([[0.3, -0.2], [0, 0.5]])
    shapes = [[*factor[0], factor[1, 1]], [1e-6, 0, 1e-6]]
    start = eg.Gaussians.from_arrays([[15, 10], [1e6, 5]], shapes, np.ones((2, 3)), size=(30, 20))
    start.save("start.npz")
    outputs = ["-o", "x.npz", "--preview", "p.png", "--iterations", 0]
    said("fit", "grey.png", *outputs, "--start", "start.npz", "--keep")
    _, fit, outlines = np.split(eg.load_image("p.png"), 3, axis=1)
    assert fit[0, 0, 0] == pytest.approx(0.5, abs=0.01)
    assert outlines[0, 0, 0] == pytest.approx(0.6 + 0.4 * 0.5, abs=0.01)
    y, x = np.nonzero(outlines[..., 0] < 0.35)
    away = np.stack([x + 0.5, y + 0.5], axis=1) / (len(fit) / 20) - [15, 10]
    assert len(x) > 100
    np.testing.assert_allclose(np.linalg.norm(away @ factor.T, axis=1), 1, atol=0.06)


def test_levels(photo, tmp_path):
    fitted, small, report = (tmp_path / f"a.{end}" for end in ("npz", "egs", "json"))
    base = ["fit", photo, "-o", fitted, "--quiet", "--iterations", 5]
    succeeded(run(*base, "--gaussians", 64, "--levels", 2))
    succeeded(run("pack", fitted, "-o", small, "--levels", 2))
    assert json.loads(said("info", small, "--json"))["sections"] == [16, 48]
    out = tmp_path / "b.png"
    succeeded(run("render", fitted, "-o", out, "--first", 16))
    expected = eg.picture_of(eg.Gaussians.load(fitted)[:16]).clip(0, 1)
    assert np.abs(eg.load_image(out) - expected).max() < 0.003
    too_many = run("render", fitted, "-o", out, "--first", 65)
    assert_refused(too_many, "--first is 65; the file has 64 Gaussians")
    succeeded(run(*base, "--levels", "16,40,64", "--report", report))
    assert read(report)["levels"] == [16, 40, 64]
    assert_refused(run("pack", fitted, "-o", small, "--levels", "16,40"), "levels is (16, 40)")


# --- By blocks; and memory, before the image is read ---


def test_fit_by_blocks(tmp_path):
    Image.fromarray(smooth_pixels(64, 64)).save(tmp_path / "photo.png")
    output, report = tmp_path / "x.npz", tmp_path / "x.json"
    options = ["-o", output, "--blocks", 32, "--report", report]
    told = said("fit", tmp_path / "photo.png", *options, "--gaussians", 256, "--iterations", 5)
    assert "64x64 in 4 blocks, 256 Gaussians" in told
    figures = read(report)
    expected = {"blocks": 4, "block": 32, "gaussians": 256, "stopped": "iterations", "width": 64}
    assert {key: figures[key] for key in expected} == expected
    assert figures["psnr_ycbcr"] > figures["psnr_rgb"] > 20
    shown = json.loads(said("info", output, "--json"))
    assert shown["psnr_rgb"] == pytest.approx(figures["psnr_rgb"], abs=0.01)
    assert (shown["iterations"], shown["source"]) == (5, "photo.png")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photo.png", "x.json", "x.npz"]


@pytest.mark.skipif(sys.platform != "linux", reason="it lowers the limit of a process")
def test_a_fit_that_does_not_fit_is_refused(tmp_path):
    """Grey becomes RGB, and a search starts with one Gaussian for 64 pixels."""
    for name, kind in (("color", 2), ("grey", 0)):
        (tmp_path / f"{name}.png").write_bytes(png(8000, 8000, 8, kind, []))
    expected = {
        ("color.png", "--gaussians", "70"): "70 Gaussians on 8000x8000 pixels take about 6.9",
        ("color.png", "--target-psnr", "30"): "1,000,000 Gaussians",
        ("grey.png",): "5,000 Gaussians on 8000x8000 pixels take about 6.9",
        ("grey.png", "--space", "data"): "5,000 Gaussians on 8000x8000 pixels take about 3.4",
    }
    code = f"""
import os, resource
from _helpers.command import run
os.chdir({str(tmp_path)!r})
resource.setrlimit(resource.RLIMIT_AS, (3_000_000_000, 3_000_000_000))
for words in {list(expected)}:
    print(run("fit", *words, "-o", "x.npz").stderr, end="")
"""
    lines = run_python(code, PYTHONPATH=python_path()).stdout.splitlines()
    for line, (words, text) in zip(lines, expected.items(), strict=True):
        assert line.startswith(f"eigengs-dr: error: {words[0]}: {text}")
        assert ", but this process may use 3.0 GB; " in line and "scale the image down" in line
        assert ("--blocks 1024" in line) == ("--target-psnr" not in words)


PEAK = """
from _helpers.command import run
print(run("fit", "large.png", "-o", "x.npz", "--iterations", 3).stderr)
status = open("/proc/self/status")  # getrusage counts the process that started this one too
print(next(1024 * int(line.split()[1]) for line in status if "VmHWM" in line))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Linux tells the peak of a process")
def test_the_memory_that_is_said_is_near_the_measured_one(tmp_path, monkeypatch):
    """If this fails after a change of the renderer, measure the constants again."""
    monkeypatch.chdir(tmp_path)
    photo = Image.fromarray(np.rint(255 * eg.sample("astronaut")).astype(np.uint8))
    photo.resize((2900, 2900)).save("large.png", compress_level=1)
    told, *_, measured = run_python(PEAK, PYTHONPATH=python_path()).stdout.splitlines()
    estimate = float(told.partition("take about ")[2].split()[0])
    assert int(measured) / 1e9 == pytest.approx(estimate, rel=0.4)


# --- Names ---


def test_a_second_run_into_one_file_says_who_writes(photo, tmp_path):
    output = tmp_path / "x.npz"
    with start("fit", photo, "-o", output, "--quiet", "--iterations", 10_000_000) as process:
        # The trial whether the file can be written has a lock before, of a longer name.
        while not any(path.stat().st_size for path in tmp_path.glob(".*-????????????????.lock")):
            assert process.poll() is None
            time.sleep(0.01)
        second = run("fit", photo, "-o", output, *QUICK)
        process.kill()
    assert_refused(second, "x.npz: process", "writes into this file; wait for its end")


def test_names_that_the_command_chooses_are_no_links(photo, tmp_path):
    """Names that the user gives may be; so may sets, which are looked at before."""
    precious = tmp_path / "thesis"
    precious.write_text("thesis")
    (tmp_path / "photo.png.npz").symlink_to(precious)
    (tmp_path / "drawn").mkdir()
    (tmp_path / "drawn" / "photo.png").symlink_to(precious)
    drawn = run("fit", photo, "-o", tmp_path, "--preview", tmp_path / "drawn", *QUICK)
    assert_refused(drawn, "photo.png: is a link, which is not followed")
    (tmp_path / "photo.npz").symlink_to(precious)
    assert_refused(run("fit", photo, "-o", tmp_path, *QUICK), "is not a set of Gaussians")
    assert precious.read_text() == "thesis"
    (tmp_path / "link.npz").symlink_to(tmp_path / "new.npz")
    succeeded(run("fit", photo, "-o", tmp_path / "link.npz", *QUICK))


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
def test_names_of_files_are_lines_of_text(photo, tmp_path):
    strange = photo.rename(tmp_path / "a\n\x1b[31mb.png")
    told = said("fit", strange, "-o", tmp_path / "c\nd.npz", *QUICK)
    assert told.count("\n") == 3 and r"a\n\x1b[31mb.png: 32x32" in told
    told = said("info", tmp_path / "c\nd.npz")
    assert r"c\nd.npz" in told and "\x1b" not in told
    for name, shown in (("\x1b[2J", r"\x1b[2J"), ("caf\udce9", r"caf\xe9"), ("é 猫", "é 猫")):
        assert_refused(run("info", tmp_path / f"{name}.npz"), f"{shown}.npz")
    assert_refused(run("info", tmp_path / "\u202egnp.npz"), r"\u202egnp.npz")


def test_a_terminal_that_cannot_show_a_name(photo, tmp_path, monkeypatch):
    name = photo.rename(tmp_path / "é猫.png")
    monkeypatch.setenv("PYTHONIOENCODING", "ascii:strict")
    assert start("fit", name, "-o", tmp_path / "x.npz", *QUICK).wait() == 0
    assert len(eg.Gaussians.load(tmp_path / "x.npz")) == 64
