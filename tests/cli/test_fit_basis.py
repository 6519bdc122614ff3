"""The command `fit` from an eigenbasis."""

import json
import shutil

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, previewed, run, succeeded
from eigengs_dr.cli.fit import DEFAULT_BASIS
from eigengs_dr.cli.main import main
from eigengs_dr.eigenbasis.eigengs import SHIPPED, EigenGS
from eigengs_dr.fitting.options import INITS
from eigengs_dr.image.color import SPACES, YCBCR_TO_RGB


def test_fit_from_an_eigenbasis(trained, photo, tmp_path):
    folder, _ = trained
    start = ["--basis", folder / "m.npz", "--report", tmp_path / "r.json"]
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
    start = ["--basis", folder / "m.npz", "--iterations", 0]
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
    assert "mean image stays in the basis" in result.stderr
    _, fit, _ = previewed(tmp_path / "both.png")
    model = EigenGS.load(folder / "m.npz")
    added = model.dense_mean(32, 32) @ YCBCR_TO_RGB.T
    saved = eg.render(eg.Gaussians.load(tmp_path / "x.npz")).numpy()
    shown = np.clip(saved + added, 0, 1) * 255
    assert np.abs(shown - fit).max() < 1.5


def test_bases_that_do_not_fit(trained, fitted, photo, existing, tmp_path):
    folder, _ = trained
    eigen = ["fit", photo, "-o", existing, "--overwrite"]
    model = folder / "m.npz"
    assert_refused(run(*eigen, "--basis", "nowhere"), "'nowhere'", "natural")
    assert_refused(run(*eigen, "--basis", fitted[0] / "fit.npz"), "eigengs_dr.gaussians")
    assert_refused(run(*eigen, "--basis", tmp_path), "neither a file")
    assert_refused(run(*eigen, "--basis", model, "--gaussians", 50), photo, "50", "60")
    assert_refused(run(*eigen, "--basis", model, "--space", "rgb"), photo, "'rgb'", "'ycbcr'")


def test_the_names_of_inits_and_bases():
    [option] = [p for p in main.commands["fit"].params if p.name == "init"]
    assert tuple(option.type.choices) == INITS
    [option] = [p for p in main.commands["fit"].params if p.name == "space"]
    assert tuple(option.type.choices) == SPACES
    [option] = [p for p in main.commands["fit"].params if p.name == "basis"]
    assert DEFAULT_BASIS in SHIPPED and DEFAULT_BASIS in option.help


def test_a_basis_implies_its_start(trained, photo, tmp_path):
    """It is read, or the command says that it cannot be."""
    model, report = trained[0] / "m.npz", tmp_path / "r.json"
    output = ["-o", tmp_path / "x.npz", "--overwrite", "--iterations", 0, "--report", report]
    succeeded(run("fit", photo, *output, "--basis", model))
    told = json.loads(report.read_text())
    assert (told["gaussians"], told["basis"]) == (60, str(model))
    assert_refused(run("fit", photo, *output, "--basis", "nowhere.npz"), "nowhere.npz")
    assert_refused(run("fit", photo, *output, "--basis", model, "--init", "grid"), "start")
