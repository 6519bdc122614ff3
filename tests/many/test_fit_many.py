"""Many images in one run: rows, resuming, interrupts, memory."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.clusters import QUICK
from _helpers.command import smooth_pixels
from _helpers.sets import check_equal


@pytest.fixture
def photos(tmp_path):
    """A folder of four images of two sizes."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, (name, width) in enumerate([("a", 32), ("b", 32), ("c", 24), ("d", 32)]):
        pixels = np.roll(smooth_pixels(width, 24), 3 * number, axis=1)
        Image.fromarray(pixels).save(folder / f"{name}.png")
    return folder


def statuses(rows):
    return {row.name: row.status for row in rows}


def files_in(folder):
    return sorted(path.name for path in Path(folder).iterdir())


def test_results_are_those_of_single_fits(photos, output):
    rows = eg.fit_many(photos, output, **QUICK)
    assert [row.name for row in rows] == ["a", "b", "c", "d"]
    for row in rows:
        image = eg.load_image(row.input)
        alone = eg.fit(image, **QUICK)
        check_equal(eg.Gaussians.load(row.output), alone.gaussians.to_arrays())
        assert (row.width, row.height, row.gaussians) == (image.shape[1], 24, 20)
        assert row.psnr_rgb == alone.psnr_rgb
        assert row.psnr_ycbcr > row.psnr_rgb > 10 and row.seconds > 0
        assert row.result is None
    # The first two have one size: they were fitted together.
    assert rows[0].seconds == rows[1].seconds != rows[2].seconds


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


def test_levels_of_detail(photos, output):
    [row, *_] = eg.fit_many(photos, output, **{**QUICK, "gaussians": [5, 20]})
    alone = eg.fit(eg.load_image(row.input), **{**QUICK, "gaussians": [5, 20]})
    check_equal(eg.Gaussians.load(row.output), alone.gaussians.to_arrays())


def test_bad_images_among_good_ones(photos, output):
    (photos / "b.png").write_text("no image")
    broken = np.full((24, 32, 3), np.nan, np.float32)
    small = np.zeros((2, 2, 3), np.float32)
    sources = [photos / "a.png", photos / "b.png", broken, small, photos / "d.png"]
    rows = eg.fit_many(sources, output, **QUICK)
    assert [row.status for row in rows] == ["done", "failed", "failed", "failed", "done"]
    assert str(photos / "b.png") in rows[1].error
    assert rows[2].error.startswith("000002: ") and "not finite" in rows[2].error
    assert rows[3].error.startswith("000003: ") and "gaussians is 20" in rows[3].error
    assert files_in(output) == ["a.npz", "d.npz", "manifest.jsonl"]


def test_a_file_of_another_kind_is_never_replaced(photos, output):
    output.mkdir()
    (output / "b.npz").write_bytes(b"something else")
    for overwrite in (False, True):
        rows = eg.fit_many(photos, output, overwrite=overwrite, **QUICK)
        assert statuses(rows)["b"] == "failed"
        assert "is not a set of Gaussians" in rows[1].error
    assert (output / "b.npz").read_bytes() == b"something else"


def test_two_images_of_one_name(photos, output, tmp_path):
    (tmp_path / "more").mkdir()
    other = (photos / "a.png").rename(tmp_path / "more" / "b.png")
    sources = [photos / "b.png", other]
    with pytest.raises(ValueError, match=r"more.b\.png: .*photos.b\.png has this name too"):
        eg.fit_many(sources, output, **QUICK)
    assert not output.exists()
    rows = eg.fit_many(iter(sources), output, **QUICK)
    assert [row.status for row in rows] == ["done", "failed"]
    assert "this name" in rows[1].error


def press(done, total, row):
    if done == 2:
        raise KeyboardInterrupt


def send_signal(done, total, row):
    if done == 2:
        os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("stop", [press, send_signal])
def test_ctrl_c_leaves_what_is_done(photos, output, stop):
    with pytest.raises(eg.Interrupted) as stopped:
        eg.fit_many(photos, output, progress=stop, **QUICK)
    assert [row.name for row in stopped.value.result[:2]] == ["a", "b"]
    left = files_in(output)
    assert left[:2] == ["a.npz", "b.npz"]  # and what was being fitted, if it was quick
    for name in left[:-1]:
        assert len(eg.Gaussians.load(output / name)) == 20
    rows = eg.fit_many(photos, output, **QUICK)
    assert [row.status for row in rows[:2]] == ["skipped", "skipped"]
    assert files_in(output) == ["a.npz", "b.npz", "c.npz", "d.npz", "manifest.jsonl"]


def test_mistakes_are_found_before_the_work(photos, output, tmp_path):
    with pytest.raises(TypeError, match="gausians"):
        eg.fit_many(photos, output, gausians=9)
    with pytest.raises(ValueError, match="got none"):
        eg.fit_many([], output)
    with pytest.raises(ValueError, match="list of images"):
        eg.fit_many(smooth_pixels(32, 24), output)
    with pytest.raises(ValueError, match="holds no images"):
        eg.fit_many(tmp_path, output)
    with pytest.raises(ValueError, match="exclude each other"):
        eg.fit_many(photos, output, gaussians=[5, 20], target_psnr=30)
    assert not output.exists()
    output.write_text("a file")
    with pytest.raises(OSError, match="need a folder"):
        eg.fit_many(photos, output, **QUICK)
