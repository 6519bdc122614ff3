"""The images of a run by folder and glob; the manifest of its folder."""

import json

import pytest

import eigengs_dr as eg
from _helpers.clusters import QUICK, files_of
from _helpers.process import run_python
from eigengs_dr.many.manifest import KEYS, NAME, list_sources, read_manifest
from eigengs_dr.storage.atomic import lock_folder


def statuses(output):
    rows, clean = read_manifest(output / NAME)
    assert clean
    return {name: row["status"] for name, row in rows.items()}


def test_a_row_for_each_image(photos, output):
    (photos / "01.png").write_text("no image")
    rows = eg.fit_many(photos, output, **QUICK)
    lines = (output / NAME).read_text().splitlines()
    found = [json.loads(line) for line in lines]
    assert [row["status"] for row in found] == ["done", "failed", "done"]
    for row, line in zip(rows, found, strict=True):
        assert list(line) == KEYS
        assert line["psnr_rgb"] == row.psnr_rgb and line["seconds"] == row.seconds
        assert line["input"] == str(row.input)
    assert found[0]["output"] == "00.npz" and found[0]["width"] == 32
    assert found[1]["error"] == rows[1].error


def test_skipped_images_keep_their_figures(photos, output):
    first = eg.fit_many(photos, output, **QUICK)
    before = (output / NAME).read_bytes()
    again = eg.fit_many(photos, output, **QUICK)
    assert [row.status for row in again] == ["skipped"] * 3
    assert [row.psnr_rgb for row in again] == [row.psnr_rgb for row in first]
    assert (output / NAME).read_bytes() == before


def test_a_result_that_is_cut_is_not_skipped(photos, output):
    eg.fit_many(photos, output, **QUICK)
    content = (output / "01.npz").read_bytes()
    (output / "01.npz").write_bytes(content[: len(content) // 2])
    rows = eg.fit_many(photos, output, **QUICK)
    assert [row.status for row in rows] == ["skipped", "failed", "skipped"]
    assert "01.npz: exists and is not a set of Gaussians; move it" in rows[1].error
    (output / "01.npz").unlink()
    assert [row.status for row in eg.fit_many(photos, output, **QUICK)].count("done") == 1


def test_a_result_stays_until_it_is_replaced(photos, output):
    """A run that should replace all results and ends early leaves whole files of both runs."""
    eg.fit_many(photos, output, **QUICK)
    before = files_of(output)
    other = {"gaussians": 10, "iterations": 0}

    def press(done, total, row):
        raise KeyboardInterrupt

    with pytest.raises(eg.Interrupted):
        eg.fit_many(photos, output, overwrite=True, progress=press, **other)
    assert files_of(output)["00.npz"] != before["00.npz"]
    with pytest.raises(ValueError, match="holds results with gaussians 20 instead of 10"):
        eg.fit_many(photos, output, **other)
    rows = eg.fit_many(photos, output, overwrite=True, **other)
    assert [row.status for row in rows] == ["done"] * 3 and rows[0].gaussians == 10


def test_options_that_results_do_not_have(photos, output):
    """They are refused where they are given, or would mix; a run without work only says so."""
    eg.fit_many(photos, output, **QUICK)
    before = files_of(output)
    same = eg.fit_many(photos, output, **QUICK, space="ycbcr")  # the default
    assert [row.status for row in same] == ["skipped"] * 3
    text = (
        r"fits: holds results with gaussians 20 instead of 9; use their options or another folder"
    )
    with pytest.raises(ValueError, match=text):
        eg.fit_many(photos, output, **QUICK | {"gaussians": 9})
    with pytest.warns(UserWarning, match="iterations 2 instead of 1000.*--overwrite"):
        rows = eg.fit_many(photos, output)
    assert [row.status for row in rows] == ["skipped"] * 3
    (output / "01.npz").unlink()
    with pytest.raises(ValueError, match="iterations 2 instead of 1000"):
        eg.fit_many(photos, output)
    assert set(statuses(output).values()) == {"done"}
    eg.fit_many(photos, output, **QUICK)
    assert files_of(output) == before


def test_a_start_counts_by_what_it_holds(photos, output):
    start = eg.fit(photos / "00.png", **QUICK).gaussians
    eg.fit_many(photos, output, start=start, iterations=1)
    start.save(output.parent / "start.npz")
    rows = eg.fit_many(photos, output, start=output.parent / "start.npz", iterations=1)
    assert [row.status for row in rows] == ["skipped"] * 3
    other = eg.fit(photos / "01.png", **QUICK).gaussians
    with pytest.raises(ValueError, match="holds results with start "):
        eg.fit_many(photos, output, start=other, iterations=1)


def test_rows_of_older_versions_do_not_say_their_options(photos, output):
    eg.fit_many(photos, output, **QUICK)
    rows = [json.loads(line) for line in (output / NAME).read_text().splitlines()]
    for row in rows:
        del row["options"]
    (output / NAME).write_text("".join(json.dumps(row) + "\n" for row in rows))
    again = eg.fit_many(photos, output, **QUICK | {"gaussians": 9})
    assert [row.status for row in again] == ["skipped"] * 3


def test_a_file_without_its_row_says_its_figures(photos, output):
    """As after a kill between the two, whether the line is missing or cut off."""
    first = eg.fit_many(photos, output, **QUICK)
    path = output / NAME
    path.write_bytes(path.read_bytes()[:-40])
    rows = eg.fit_many(photos, output, **QUICK)
    assert [row.status for row in rows] == ["skipped", "skipped", "skipped"]
    assert (rows[2].width, rows[2].height, rows[2].gaussians) == (32, 24, 20)
    assert (rows[2].psnr_rgb, rows[2].iterations) == (first[2].psnr_rgb, 2)
    assert statuses(output) == {"00": "done", "01": "done", "02": "done"}


@pytest.mark.parametrize(
    "text", ["a,b\n1,2\n", '{"name": "a"}\n', "[1]\n", '{"name": 1, "status": "done"}\n']
)
def test_another_file_of_this_name_is_kept(photos, output, text):
    output.mkdir()
    (output / NAME).write_text(text)
    with pytest.raises(ValueError, match="is not a row of a manifest; move the file"):
        eg.fit_many(photos, output, **QUICK)
    assert (output / NAME).read_text() == text
    assert [path.name for path in output.iterdir()] == [NAME]


def test_what_a_killed_conversion_left_stops_no_run(photos, output):
    work = output / ".eigengs_dr-0123456789abcdef"
    work.mkdir(parents=True)
    (work / "bark.npz").write_bytes(b"half")
    assert [row.status for row in eg.fit_many(photos, output, **QUICK)] == ["done"] * 3
    assert not work.exists()


def test_two_runs_into_one_folder(photos, output):
    output.mkdir()
    with (
        lock_folder(output),
        pytest.raises(OSError, match=r"fits: process \d+ on .* writes into this folder; wait"),
    ):
        eg.fit_many(photos, output, **QUICK)
    assert [row.status for row in eg.fit_many(photos, output, **QUICK)] == ["done"] * 3
    assert not (output / ".lock").exists()


def test_a_run_that_was_killed_holds_no_lock(photos, output):
    output.mkdir()
    code = (
        "import os, pathlib; from eigengs_dr.storage.atomic import lock_folder\n"
        f"with lock_folder(pathlib.Path({str(output)!r})): os.kill(os.getpid(), 9)"
    )
    run_python(code)
    assert (output / ".lock").exists()
    assert [row.status for row in eg.fit_many(photos, output, **QUICK)] == ["done"] * 3


@pytest.mark.parametrize("name", [NAME, "01.npz"])
def test_links_in_a_folder_from_elsewhere(photos, output, name):
    """Neither the manifest nor a result is written where a link leads."""
    output.mkdir()
    (output / name).symlink_to(output.parent / "new")
    if name == NAME:
        with pytest.raises(OSError, match=r"manifest\.jsonl: is a link"):
            eg.fit_many(photos, output, **QUICK)
    else:
        rows = eg.fit_many(photos, output, **QUICK)
        assert [row.status for row in rows].count("failed") == 1
    assert not (output.parent / "new").exists()


# --- Images by folder and glob ---


def test_globs(photos, tmp_path):
    (tmp_path / "photos" / "deep").mkdir()
    (photos / "02.png").rename(photos / "deep" / "03.png")
    rows = eg.fit_many(photos, recursive=True, **QUICK)
    assert [row.name for row in rows] == ["00", "01", "03"]
    with pytest.raises(ValueError, match="recursive is for a folder; the images are given one"):
        eg.fit_many([photos / "00.png"], recursive=True, **QUICK)
    names = [source.name for source in list_sources(str(tmp_path / "**" / "*.png"))]
    assert names == ["00", "01", "03"]
    with pytest.raises(ValueError, match=r"\*\.jpg: no file matches; check the pattern"):
        list_sources(str(photos / "*.jpg"))


def test_a_folder_whose_name_looks_like_a_glob(photos, tmp_path):
    folder = photos.rename(tmp_path / "photos[1]")
    assert len(list_sources(str(folder))) == 3
