"""Many images in one run: their rows, names, mistakes and interrupts."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.clusters import QUICK
from _helpers.command import smooth_pixels
from _helpers.sets import check_equal


def files_in(folder):
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.mark.parametrize("changed", [{}, {"gaussians": [5, 20]}], ids=["one", "levels"])
def test_results_are_those_of_single_fits(photos, output, changed):
    options = QUICK | changed
    rows = eg.fit_many(photos, output, **options)
    assert [row.name for row in rows] == ["00", "01", "02", "03"]
    for row in rows:
        image = eg.load_image(row.input)
        alone = eg.fit(image, **options)
        check_equal(eg.Gaussians.load(row.output), alone.gaussians.to_arrays())
        assert (row.width, row.height, row.gaussians) == (image.shape[1], 24, 20)
        assert row.psnr_rgb == alone.psnr_rgb
        assert row.psnr_ycbcr > row.psnr_rgb > 10 and row.seconds > 0
        assert row.result is None


def test_arrays_stay_in_memory_without_an_output():
    images = [smooth_pixels(32, 24), smooth_pixels(32, 24)[..., 0]]
    rows = eg.fit_many(images, **QUICK)
    assert [row.name for row in rows] == ["000000", "000001"]
    for row, image in zip(rows, images, strict=True):
        check_equal(row.result.gaussians, eg.fit(image, **QUICK).gaussians.to_arrays())
        assert row.input is None and row.output is None


def test_an_iterator_may_reuse_its_array():
    def frames():
        buffer = np.zeros((24, 32, 3), np.float32)
        for value in (0.2, 0.4, 0.6):
            buffer[:] = value
            yield buffer

    rows = eg.fit_many(frames(), gaussians=1, iterations=0)
    means = [row.result.image.mean() for row in rows]
    assert means == pytest.approx([0.2, 0.4, 0.6], abs=0.02)


def test_bad_images_among_good_ones(photos, output):
    (photos / "01.png").write_text("no image")
    broken = np.full((24, 32, 3), np.nan, np.float32)
    small = np.zeros((2, 2, 3), np.float32)
    sources = [photos / "00.png", photos / "01.png", broken, small, photos / "03.png"]
    rows = eg.fit_many(sources, output, **QUICK)
    assert [row.status for row in rows] == ["done", "failed", "failed", "failed", "done"]
    assert str(photos / "01.png") in rows[1].error
    assert rows[2].error.startswith("000002: ") and "not finite" in rows[2].error
    assert rows[3].error.startswith("000003: ") and "gaussians is 20" in rows[3].error
    assert files_in(output) == ["00.npz", "03.npz"]


def test_two_images_of_one_name(photos, output, tmp_path):
    (tmp_path / "more").mkdir()
    other = (photos / "00.png").rename(tmp_path / "more" / "01.png")
    sources = [photos / "01.png", other]
    with pytest.raises(ValueError, match=r"more.01\.png: .*photos.01\.png has this name too"):
        eg.fit_many(sources, output, **QUICK)
    assert not output.exists()
    rows = eg.fit_many(iter(sources), output, **QUICK)
    assert [row.status for row in rows] == ["done", "failed"]
    assert "this name" in rows[1].error


def test_folders_and_patterns(photos, tmp_path):
    (photos / "deep").mkdir()
    (photos / "03.png").rename(photos / "deep" / "04.png")
    few = {"gaussians": 1, "iterations": 0}
    pattern = str(tmp_path / "**" / "*.png")
    for images, asked in ((photos, {"recursive": True}), (pattern, {})):
        rows = eg.fit_many(images, **asked, **few)
        assert [row.name for row in rows] == ["00", "01", "02", "04"]
    with pytest.raises(ValueError, match="recursive is for a folder; the images are given one"):
        eg.fit_many([photos / "00.png"], recursive=True, **few)
    with pytest.raises(eg.ImageError, match=r"recursive is for a folder; write \*\* into"):
        eg.fit_many(pattern, recursive=True, **few)
    with pytest.raises(ValueError, match=r"\*\.jpg: no file matches; check the pattern"):
        eg.fit_many(str(photos / "*.jpg"), **few)
    (photos / "deep" / "04.png").rename(photos / "04.png")
    assert len(eg.fit_many(photos.rename(tmp_path / "photos[1]"), **few)) == 4


def test_a_bound_above_an_image_leaves_it_one_gaussian_per_pixel():
    photo = eg.sample("chelsea")[100:106, 150:156]
    goal = eg.Goal(99, max_gaussians=100)
    [row] = eg.fit_many([photo], target_psnr=goal, iterations=2)
    assert (row.status, row.gaussians, row.stopped) == ("done", 36, "out of reach")


def send_signal(done, total, row):
    if done == 2:
        os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_leaves_what_is_done(photos, output):
    with pytest.raises(eg.Interrupted) as stopped:
        eg.fit_many(photos, output, progress=send_signal, **QUICK)
    assert [row.name for row in stopped.value.result[:2]] == ["00", "01"]
    left = files_in(output)
    assert left[:2] == ["00.npz", "01.npz"]  # and what was being fitted, if it was quick
    for name in left:
        assert len(eg.Gaussians.load(output / name)) == 20
    rows = eg.fit_many(photos, output, **QUICK)
    assert [row.status for row in rows[:2]] == ["skipped", "skipped"]
    assert files_in(output) == ["00.npz", "01.npz", "02.npz", "03.npz"]


def test_mistakes_are_found_before_the_work(photos, output, tmp_path):
    with pytest.raises(TypeError, match="gausians"):
        eg.fit_many(photos, output, gausians=9)
    for option in ({"weight": np.ones((24, 32))}, {"loss": len}):
        with pytest.raises(TypeError, match=f"fit_many takes no {next(iter(option))}"):
            eg.fit_many(photos, output, **option)
    with pytest.raises(ValueError, match="got none"):
        eg.fit_many([], output)
    with pytest.raises(ValueError, match="list of images"):
        eg.fit_many(smooth_pixels(32, 24), output)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no images"):
        eg.fit_many(tmp_path / "empty", output)
    assert not output.exists()
    output.write_text("a file")
    with pytest.raises(OSError, match="need a folder"):
        eg.fit_many(photos, output, **QUICK)
