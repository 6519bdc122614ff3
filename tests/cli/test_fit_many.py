"""The command `fit` with several images: skipped, failed and interrupted ones; --cluster."""

import json
import shutil
import subprocess
import sys
import time

import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.clusters import files_of, folder_of_photos
from _helpers.command import assert_refused, run, smooth_pixels, succeeded

QUICK = ("--gaussians", 20, "--iterations", 1)


@pytest.fixture
def photos(tmp_path):
    return folder_of_photos(tmp_path / "photos", 3)


def test_images_of_any_size_into_folders(photo, photos, tmp_path):
    Image.fromarray(smooth_pixels(20, 30)).save(tmp_path / "other.png")
    folders = ["-o", tmp_path / "fits", "--preview", tmp_path / "previews"]
    images = [photo, f"{photos}/0[12].png", tmp_path / "other.png"]
    succeeded(run("fit", *images, *folders, *QUICK, "--report", tmp_path / "r.json"))
    assert list(files_of(tmp_path / "fits")) == ["01.npz", "02.npz", "other.npz", "photo.npz"]
    assert len(list((tmp_path / "previews").iterdir())) == 4
    report = json.loads((tmp_path / "r.json").read_text())
    assert [row["width"] for row in report["images"]] == [32, 32, 32, 20] and report["versions"]


def test_targets_out_of_reach_are_told_for_each_image(photos, tmp_path):
    settings = ("--target-psnr", 90, "--max-gaussians", 20, "--iterations", 5)
    result = run("fit", photos, "-o", tmp_path / "fits", *settings)
    assert result.exit_code == 1
    lines = [line for line in result.stderr.splitlines() if "out of reach" in line]
    for line, name in zip(lines, ("00", "01", "02"), strict=True):
        assert f"{photos / name}.png: psnr_rgb of 90 dB is out of reach: 20 " in line


def test_images_in_subfolders(photos, tmp_path):
    (photos / "1999").mkdir()
    (photos / "02.png").rename(photos / "1999" / "02.png")
    command = ["fit", photos, "-o", tmp_path / "fits", *QUICK]
    assert "left out, such as 1999" in succeeded(run(*command)).stderr
    told = succeeded(run(*command, "--recursive"))
    assert told.stderr == "" and (tmp_path / "fits" / "02.npz").exists()
    single = run("fit", photos / "00.png", "--recursive", *QUICK)
    assert_refused(single, "--recursive takes a folder of images")


def test_a_folder_of_one_image(photo, tmp_path):
    folder, report = tmp_path / "photos", tmp_path / "r.json"
    folder.mkdir()
    shutil.copy(photo, folder / "a.png")
    succeeded(run("fit", folder, "-o", tmp_path / "fits", "--report", report, *QUICK))
    assert [path.name for path in (tmp_path / "fits").iterdir()] == ["a.npz"]
    assert len(json.loads(report.read_text())["images"]) == 1


def test_the_same_command_continues(photos, tmp_path):
    fits, report = tmp_path / "fits", tmp_path / "r.json"
    command = ["fit", photos, "-o", fits, "--report", report, *QUICK]
    succeeded(run(*command))
    (fits / "01.npz").unlink()
    result = succeeded(run(*command))
    assert "1 image fitted, 2 skipped" in result.stdout and "--overwrite" in result.stdout
    rows = json.loads(report.read_text())["images"]
    assert [row["stopped"] for row in rows] == ["skipped", "iterations", "skipped"]
    assert rows[1]["psnr_ycbcr"] > rows[1]["psnr_rgb"] > 10
    assert rows[1]["output"] == str(fits / "01.npz")
    result = succeeded(run(*command, "--overwrite", "--gaussians", 9))
    assert "3 images fitted in" in result.stdout
    assert len(eg.Gaussians.load(fits / "00.npz")) == 9


def test_pictures_of_results_that_exist(photos, tmp_path):
    """A killed run may have written results without their pictures."""
    command = ["fit", photos, "-o", tmp_path / "fits", *QUICK]
    pictures = ["--preview", tmp_path / "new"]
    succeeded(run(*command, "--preview", tmp_path / "old"))
    eg.save_image(photos / "02.png", smooth_pixels(20, 30))  # another image of the same name
    told = succeeded(run(*command, *pictures))
    assert "02.png is not drawn: " in told.stderr and "is of an image of 32x24" in told.stderr
    for name in ("00.png", "01.png"):
        a, b = (eg.load_image(tmp_path / folder / name) for folder in ("old", "new"))
        assert abs(a - b).max() <= 1.01 / 255
    (tmp_path / "new" / "00.png").write_bytes(b"kept")
    (tmp_path / "new" / "01.png").unlink()
    succeeded(run(*command, *pictures))
    assert (tmp_path / "new" / "00.png").read_bytes() == b"kept"
    assert len(list((tmp_path / "new").iterdir())) == 2


def test_a_bad_image_does_not_end_a_folder(photos, trained, tmp_path):
    """It is named at once, and in the report; nor is a basis ever replaced."""
    report, fits = tmp_path / "r.json", tmp_path / "fits"
    fits.mkdir()
    model = shutil.copy(trained[0] / "m.npz", fits / "00.npz")
    before = model.read_bytes()
    (photos / "01.png").write_text("no image")
    result = run("fit", photos, "-o", fits, "--report", report, *QUICK)
    assert result.exit_code == 2 and model.read_bytes() == before
    assert "01.png" in result.stderr and "is not a set of Gaussians" in result.stderr
    assert result.stderr.count("\n") == 2
    images = json.loads(report.read_text())["images"]
    assert [image["stopped"] for image in images] == ["failed", "failed", "iterations"]
    assert "01.png" in images[1]["error"]


MISTAKES = {
    "a file": (["photos", "-o", "photos/00.png"], "need a folder"),
    "an .npz": (["photos", "-o", "out.npz"], "need a folder"),
    "twice": (["photos", "photos/00.png", "-o", "x"], "00.npz: two images have this name"),
    "one name": (["photos/00.png", "other/00.png", "-o", "x"], "00.npz: two images have this name"),
    "blocks": (["photos", "-o", "x", "--blocks", 64], "--blocks fits one image"),
    "pattern": (["photos/*.jpg", "-o", "x"], "no file matches"),
    "empty": (["other/none", "-o", "x"], "other/none"),
    "a URL": (["photos", "-o", "memory://fits"], "results cannot be written to URLs"),
    "cluster": (["photos", "-o", "x", "--preview", "p", "--cluster", "local"], "no --preview"),
    "a word": (["photos", "-o", "x", "--cluster", "nowhere"], "is unknown; use"),
    "none": (["photos", "-o", "x", "--cluster", "local:0"], "is unknown"),
    "a photo": (["photos", "-o", "x", "--cluster", "photos/00.png"], "not the file of a scheduler"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(photos, tmp_path, case, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "--cluster" in MISTAKES[case][0]:
        pytest.importorskip("distributed")
    shutil.copytree(photos, "other")
    (tmp_path / "other" / "none").mkdir()
    arguments, words = MISTAKES[case]
    assert_refused(run("fit", *arguments, *QUICK), words)
    assert not (tmp_path / "memory:").exists() and not list(tmp_path.glob("*/*.npz"))


# --- On a cluster ---


def test_processes_of_this_machine(photos, tmp_path):
    pytest.importorskip("distributed")
    (photos / "02.png").write_text("no image")
    found = []
    for name, where in (("far", ["--cluster", "local:1"]), ("here", [])):
        report = tmp_path / f"{name}.json"
        output = ["-o", tmp_path / name, "--report", report]
        result = run("fit", photos, *output, *QUICK, *where)
        assert result.exit_code == 2 and result.stderr.count("\n") == 1
        assert "02.png" in result.stderr and "2 images fitted, 1 failed" in result.stdout
        rows = json.loads(report.read_text())["images"]
        found.append([set(row) for row in rows])
    assert found[0] == found[1]
    assert files_of(tmp_path / "far") == files_of(tmp_path / "here")


@pytest.mark.slow
@pytest.mark.parametrize("starts", [True, False])
def test_sigterm_ends_the_run_and_its_workers(tmp_path, starts):
    """As schedulers of batch jobs send it; the same command then does the rest."""
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("distributed")
    photos, output = folder_of_photos(tmp_path / "photos", 30, 96, 64), tmp_path / "fits"
    command = ["fit", photos, "-o", output, "--gaussians", 300, "--iterations", 100]
    words = [sys.executable, "-m", "eigengs_dr", *map(str, command), "--quiet"]
    with subprocess.Popen(
        [*words, "--cluster", "local:2"], stderr=subprocess.PIPE, text=True
    ) as process:
        workers, deadline = [], time.monotonic() + 120
        while not (list(output.glob("[!.]*.npz")) if starts else workers):
            assert time.monotonic() < deadline
            time.sleep(0.01)
            workers = psutil.Process(process.pid).children(recursive=True)
        process.terminate()
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130 and "\n" not in said.strip()
    assert "to fit the others" in said if starts else said.strip() == "eigengs-dr: interrupted"
    assert not psutil.wait_procs(workers, timeout=10)[1]
    if starts:
        partial = files_of(output)  # reads each: all are whole
        assert 0 < len(partial) < 30 and len(workers) >= 2
        assert not [path for path in output.glob(".*") if path.suffix != ".npz"]
        succeeded(run(*command))
        assert partial.items() <= files_of(output).items() and len(files_of(output)) == 30


def test_without_dask_one_line_says_what_to_install(photos, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "eigengs_dr.cluster.executor", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = run("fit", photos, "-o", tmp_path / "fits", *QUICK, "--cluster", "local")
    assert_refused(result, "distributed", "pip install -e '.[cluster]'")


def test_a_scheduler_that_does_not_answer(photos, tmp_path):
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.comm.timeouts.connect": "0.3s"}):
        result = run("fit", photos, "-o", tmp_path / "x", "--cluster", "tcp://127.0.0.1:1")
    assert_refused(result, "tcp://127.0.0.1:1", "start")
