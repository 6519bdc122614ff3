"""Where outputs cannot go."""

import shutil

import pytest

import eigengs_dr as eg
from _helpers.command import assert_refused, run


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
