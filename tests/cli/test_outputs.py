"""Where outputs cannot go."""

import shutil

import pytest

from _helpers.command import assert_refused, run
from eigengs_dr.fitting import fit as fit_module


def test_unwritable_outputs(photo, existing, tmp_path, monkeypatch):
    monkeypatch.setattr(fit_module, "fit_image", lambda *_: pytest.fail("the work was started"))
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


def test_a_basis_is_not_overwritten(trained, photo):
    """By default the output has the name of the photo, in the current folder."""
    model = shutil.copy(trained[0] / "m.npz", photo.with_suffix(".npz"))
    before = model.read_bytes()
    basis = ["--basis", model, "--iterations", 0]
    assert_refused(run("fit", photo, "-o", photo.parent, *basis), model, "is read")
    assert model.read_bytes() == before


def test_an_image_given_twice(photo, tmp_path):
    assert_refused(run("fit", photo, photo, "-o", tmp_path / "out"), photo, "twice")
    assert_refused(run("fit", photo.parent, photo, "-o", tmp_path / "out"), photo, "twice")
    assert not (tmp_path / "out").exists()
