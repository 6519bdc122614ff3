"""Folders of results: a run goes on by its files, refuses other options, survives kills."""

from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.clusters import QUICK, files_of

OTHER = {"gaussians": 10, "iterations": 0}

REFUSED = r"00\.npz: is a result of other options, .*; use those options or another folder, or fit"


def statuses(rows):
    return [row.status for row in rows]


def test_skipped_images_keep_their_figures(photos, output):
    first = eg.fit_many(photos, output, **QUICK)
    again = eg.fit_many(photos, output, **QUICK, space="ycbcr")  # the default
    assert statuses(again) == ["skipped"] * 4
    for name in ("psnr_rgb", "psnr_ycbcr", "iterations", "width", "height", "gaussians"):
        assert [vars(row)[name] for row in again] == [vars(row)[name] for row in first]


@pytest.mark.parametrize(
    "changed",
    [
        {"gaussians": 9},
        {"iterations": 3},
        {"space": "rgb"},
        {"method": replace(eg.DEFAULT, cutoff=4.0)},
    ],
)
def test_other_options_are_refused_before_any_work(photos, output, changed):
    """In Python whether they are given or the defaults; with a file that is missing or not."""
    eg.fit_many(photos, output, **QUICK)
    (output / "03.npz").unlink()
    before = files_of(output)
    with pytest.raises(ValueError, match=REFUSED):
        eg.fit_many(photos, output, **QUICK | changed)
    with pytest.raises(ValueError, match=REFUSED):
        eg.fit_many(photos, output)
    assert files_of(output) == before


def test_a_result_stays_until_it_is_replaced(photos, output):
    """A run that should replace all results and ends early leaves whole files of both runs."""
    eg.fit_many(photos, output, **QUICK)
    before = files_of(output)

    def press(done, total, row):
        raise KeyboardInterrupt

    with pytest.raises(eg.Interrupted):
        eg.fit_many(photos, output, overwrite=True, progress=press, **OTHER)
    assert files_of(output)["00.npz"] != before["00.npz"]
    with pytest.raises(ValueError, match="is a result of other options"):
        eg.fit_many(photos, output, **OTHER)
    rows = eg.fit_many(photos, output, overwrite=True, **OTHER)
    assert statuses(rows) == ["done"] * 4 and rows[0].gaussians == 10


def test_a_start_counts_by_what_it_holds(photos, output):
    start = eg.fit(photos / "00.png", **QUICK).gaussians
    eg.fit_many(photos, output, start=start, iterations=1)
    start.save(output.parent / "start.npz")
    rows = eg.fit_many(photos, output, start=output.parent / "start.npz", iterations=1)
    assert statuses(rows) == ["skipped"] * 4
    other = eg.fit(photos / "01.png", **QUICK).gaussians
    with pytest.raises(ValueError, match="is a result of other options"):
        eg.fit_many(photos, output, start=other, iterations=1)


def test_results_of_single_fits_are_kept(photos, output):
    output.mkdir()
    single = eg.fit(photos / "00.png", gaussians=9, iterations=1)
    single.save(output / "00.npz")
    rows = eg.fit_many(photos, output, **QUICK)
    assert statuses(rows) == ["skipped", "done", "done", "done"]
    assert (rows[0].gaussians, rows[0].psnr_rgb) == (9, single.psnr_rgb)


@pytest.mark.parametrize("kind", ["cut", "another", "link"])
def test_a_file_that_is_no_set_is_never_replaced(photos, output, kind):
    eg.fit_many(photos, output, **QUICK)
    path, content = output / "01.npz", (output / "01.npz").read_bytes()
    if kind == "link":
        path.unlink()
        path.symlink_to(output.parent / "new")
    else:
        path.write_bytes(b"something else" if kind == "another" else content[: len(content) // 2])
    for overwrite in (False, True):
        rows = eg.fit_many(photos, output, overwrite=overwrite, **QUICK)
        done = "done" if overwrite else "skipped"
        assert statuses(rows) == [done, "failed", done, done]
        assert "01.npz: exists and is not a set of Gaussians; move it" in rows[1].error
    assert not (output.parent / "new").exists()
    path.unlink()
    assert statuses(eg.fit_many(photos, output, **QUICK)).count("done") == 1


def test_two_runs_into_one_folder(photos, output):
    errors = []

    def begin_another(done, total, row):
        with pytest.raises(OSError, match=r"process \d+ on .* writes into this folder") as error:
            eg.fit_many(photos, output, **QUICK)
        errors.append(error)

    eg.fit_many(photos, output, progress=begin_another, **QUICK)
    assert len(errors) == 4
    assert statuses(eg.fit_many(photos, output, **QUICK)) == ["skipped"] * 4


def test_options_of_encodings_are_refused_too(photos, output):
    images = np.random.default_rng(0).random((12, 24, 32, 3), np.float32)
    basis = eg.Eigenbasis.from_images(images, (32, 24), 3)
    model = eg.EigenGS.fit(basis, gaussians=20)
    model.encode_many(photos, output)
    assert statuses(model.encode_many(photos, output)) == ["skipped"] * 4
    with pytest.raises(ValueError, match=REFUSED):
        model.encode_many(photos, output, colors="projected")
