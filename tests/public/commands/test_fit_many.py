"""The command `fit` with several images: skipped, failed and interrupted ones; --cluster."""

import json
import shutil

import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.command import assert_refused, run, said, smooth_pixels, succeeded

QUICK = ("--gaussians", 64, "--iterations", 1)


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(3):
        Image.fromarray(255 - smooth_pixels(32, 32) // (k + 1)).save(folder / f"{k:02}.png")
    return folder


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def rows(path):
    return json.loads(path.read_text())["images"]


def test_images_of_any_size_into_folders(photo, photos, tmp_path):
    Image.fromarray(smooth_pixels(22, 17)).save(tmp_path / "other.png")
    folders = ["-o", tmp_path / "fits", "--preview", tmp_path / "previews"]
    images = [photo, f"{photos}/0[12].png", tmp_path / "other.png"]
    succeeded(run("fit", *images, *folders, *QUICK, "--report", tmp_path / "r.json"))
    assert names_in(tmp_path / "fits") == ["01.npz", "02.npz", "other.npz", "photo.npz"]
    assert len(list((tmp_path / "previews").iterdir())) == 4
    assert [row["width"] for row in rows(tmp_path / "r.json")] == [32, 32, 32, 22]


def test_targets_out_of_reach_are_told_for_each_image(photos, tmp_path):
    settings = ("--target-psnr", 90, "--max-gaussians", 64, "--iterations", 5)
    result = run("fit", photos, "-o", tmp_path / "fits", *settings)
    assert result.exit_code == 1
    lines = [line for line in result.stderr.splitlines() if "out of reach" in line]
    for line, name in zip(lines, ("00", "01", "02"), strict=True):
        assert f"{photos / name}.png: psnr_rgb of 90 dB is out of reach: 64 " in line


def test_images_in_subfolders(photos, tmp_path):
    (photos / "1999").mkdir()
    (photos / "02.png").rename(photos / "1999" / "02.png")
    command = ["fit", photos, "-o", tmp_path / "fits", *QUICK]
    assert "left out, such as 1999" in succeeded(run(*command)).stderr
    result = succeeded(run(*command, "--recursive"))
    assert result.stderr == "" and (tmp_path / "fits" / "02.npz").exists()


def test_the_same_command_continues(photos, tmp_path):
    fits, report = tmp_path / "fits", tmp_path / "r.json"
    command = ["fit", photos, "-o", fits, "--report", report, *QUICK]
    succeeded(run(*command))
    (fits / "01.npz").unlink()
    told = said(*command)
    assert "1 image fitted, 2 skipped" in told and "--overwrite" in told
    assert [row["stopped"] for row in rows(report)] == ["skipped", "iterations", "skipped"]
    again = rows(report)[1]
    assert again["psnr_ycbcr"] > again["psnr_rgb"] > 10
    assert again["output"] == str(fits / "01.npz")
    assert "3 images fitted in" in said(*command, "--overwrite", "--gaussians", 9)
    assert len(eg.Gaussians.load(fits / "00.npz")) == 9


def test_pictures_of_results_that_exist(photos, tmp_path):
    """A killed run may have written results without their pictures."""
    command = ["fit", photos, "-o", tmp_path / "fits", *QUICK]
    pictures = ["--preview", tmp_path / "new"]
    succeeded(run(*command, "--preview", tmp_path / "old"))
    eg.save_image(photos / "02.png", smooth_pixels(22, 17))  # another image of the same name
    result = succeeded(run(*command, *pictures))
    assert "02.png is not drawn: " in result.stderr and "is of an image of 32x32" in result.stderr
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
    assert [row["stopped"] for row in rows(report)] == ["failed", "failed", "iterations"]
    assert "01.png" in rows(report)[1]["error"]


MISTAKES = {
    "a file": (["photos", "-o", "photos/00.png"], "need a folder"),
    "an .npz": (["photos", "-o", "out.npz"], "need a folder"),
    "twice": (["photos", "photos/00.png", "-o", "x"], "00.png and photos/00.png have this name"),
    "blocks": (["photos", "-o", "x", "--blocks", 64], "--blocks fits one image"),
    "pattern": (["photos/*.jpg", "-o", "x"], "no file matches"),
    "a URL": (["photos", "-o", "memory://fits"], "URLs"),
    "cluster": (
        ["photos", "-o", "x", "--preview", "p", "--cluster", "local"],
        "--preview and --cluster",
    ),
    "a word": (["photos", "-o", "x", "--cluster", "nowhere"], "is unknown; use"),
    "a photo": (["photos", "-o", "x", "--cluster", "photos/00.png"], "not the file of a scheduler"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(photos, tmp_path, case, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, words = MISTAKES[case]
    if "--cluster" in arguments:
        pytest.importorskip("distributed")
    assert_refused(run("fit", *arguments, *QUICK), words)
    assert not (tmp_path / "memory:").exists() and not list(tmp_path.glob("*/*.npz"))


def test_processes_of_this_machine(photos, tmp_path):
    pytest.importorskip("distributed")
    (photos / "02.png").write_text("no image")
    report = tmp_path / "r.json"
    outputs = ["-o", tmp_path / "fits", "--report", report]
    result = run("fit", photos, *outputs, *QUICK, "--cluster", "local:1")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert "02.png" in result.stderr and "2 images fitted, 1 failed" in result.stdout
    assert [row["stopped"] for row in rows(report)] == ["iterations", "iterations", "failed"]
    assert names_in(tmp_path / "fits") == ["00.npz", "01.npz"]


def test_a_scheduler_that_does_not_answer(photos, tmp_path):
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.comm.timeouts.connect": "0.3s"}):
        result = run("fit", photos, "-o", tmp_path / "x", "--cluster", "tcp://127.0.0.1:1")
    assert_refused(result, "tcp://127.0.0.1:1", "start")
