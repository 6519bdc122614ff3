"""Fits by blocks: no seams, and runs that were stopped go on with the same bits."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import run, succeeded
from _helpers.mosaics import FEW, assert_same_bits, mosaic
from _helpers.process import python_path, run_python
from _helpers.sets import check_equal, random_scene

LONG = FEW | {"iterations": 200}


@pytest.fixture(scope="module")
def short():
    """A fit that runs without a stop."""
    return eg.fit_large(mosaic(128), **FEW)


@pytest.fixture(scope="module")
def long():
    """One that places its Gaussians twice."""
    return eg.fit_large(mosaic(128), **LONG)


HOLED = FEW | {"gaussians": 200, "block": 32, "iterations": 32}


@pytest.fixture(scope="module")
def small():
    """One of four small blocks."""
    return eg.fit_large(mosaic(64), **HOLED)


def near_borders(side, block, distance):
    """Which pixels of a square lie near a border of blocks."""
    number = -(-side // block)
    cuts = np.array([k * side // number for k in range(1, number)])
    near = (np.abs(np.arange(side)[:, None] + 0.5 - cuts) < distance).any(axis=1)
    return near[:, None] | near


def test_no_seam_is_left():
    """Near borders and elsewhere, the error is that of a fit of the whole."""
    pixels = mosaic(256)
    settings = {"gaussians": 3000, "iterations": 40, "backend": "llvm"}
    blocks = eg.fit_large(pixels, block=96, **settings)
    assert blocks.blocks == 9 and len(blocks.gaussians) == 3000
    whole = eg.fit(pixels, **settings)
    shown = eg.picture_of(blocks.gaussians)
    for mask in (near_borders(256, 96, 16), ~near_borders(256, 96, 16)):
        pair = [eg.psnr(p.clip(0, 1), pixels, "data", mask) for p in (shown, whole.image)]
        assert pair[0] > pair[1] - 0.2
    assert blocks.psnr_rgb == pytest.approx(eg.psnr(shown, pixels), abs=1e-3)
    assert blocks.psnr_ycbcr == pytest.approx(eg.psnr(shown, pixels, "ycbcr"), abs=1e-3)


def test_linear_light_of_a_grey_image():
    result = eg.fit_large(mosaic(96)[..., :1], **FEW | {"space": "linear", "gaussians": 500})
    assert result.gaussians.space == "linear" and result.gaussians.channels == 3
    assert result.psnr_rgb > 22


def test_data_of_any_range():
    """As `fit`: heights of 100 m are fitted in a unit, and measured in it."""
    heights = 200 * mosaic(96)[..., :1].astype(np.float32) / 255 - 100
    result = eg.fit_large(heights, **FEW | {"space": "data", "gaussians": 500})
    assert result.gaussians.channels == 1
    same = eg.fit_large(heights / 100, **FEW | {"space": "data", "gaussians": 500})
    assert result.psnr_ycbcr == pytest.approx(same.psnr_ycbcr, abs=0.5)
    error = np.square(eg.picture_of(result.gaussians) - heights).mean()
    assert result.psnr_ycbcr == pytest.approx(
        -10 * np.log10(error / np.ptp(heights) ** 2), abs=0.01
    )


def test_light_that_no_display_shows():
    """As `fit`, whose PSNRs are those of light that is exposed: else all would be equal."""
    light = 200 + 2000 * eg.sample("coffee")[:96, :96]
    settings = {"gaussians": 500, "iterations": 10, "space": "log", "encoding": "linear"}
    found, whole = eg.fit_large(light, block=48, **settings), eg.fit(light, **settings)
    assert found.psnr_ycbcr == pytest.approx(whole.psnr_ycbcr, abs=1.5)
    assert found.psnr_rgb == pytest.approx(whole.psnr_rgb, abs=1.5)


def test_progress():
    rows = []
    eg.fit_large(
        mosaic(128),
        **FEW,
        progress=lambda done, total, row: rows.append((row.status, done, total)),
    )
    stages = list(dict.fromkeys(stage for stage, _, _ in rows))
    assert stages == ["survey", "place", "fit", "measure"]
    for stage in stages:
        done = [(d, t) for s, d, t in rows if s == stage]
        assert done[0][0] == 0 and done[-1][0] == done[-1][1]
        assert done == sorted(done)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"block": 8}, "block is 8; it must be at least 32"),
        ({"gaussians": 10}, "at least 64: use more, or fit a smaller version"),
        ({"gaussians": 128 * 128 + 1}, "takes 1 to 16384"),
    ],
)
def test_bad_options(options, reason):
    with pytest.raises(ValueError, match=reason):
        eg.fit_large(mosaic(128), **FEW | options)


def test_a_method_of_the_caller():
    found = eg.fit_large(mosaic(96), **FEW, method=replace(eg.DEFAULT, cutoff=4.0))
    assert found.gaussians.cutoff == 4 and found.psnr_rgb > 20
    with pytest.raises(TypeError, match="method is 'default'; pass a Method"):
        eg.fit_large(mosaic(96), **FEW, method="default")


def test_bad_pixel_ends_the_run_before_the_fit(tmp_path):
    pixels = mosaic(128) / np.float32(255)
    pixels[100, 20] = np.inf
    with pytest.raises(eg.ImageError, match=r"rows 0 to 114, columns 0 to 114: 1 of"):
        eg.fit_large(pixels, tmp_path / "a.npz", **FEW)
    assert list(tmp_path.iterdir()) == []


BLOCK_MEMORY = 112_000_000
"""A quarter of what a fit of 2048x2048 pixels as a whole takes more than one of 1024x1024."""

MEASURE = """
import resource
import numpy as np
import eigengs_dr as eg
from _helpers.command import run, succeeded
from _helpers.mosaics import mosaic
pixels = np.tile(mosaic(256), ({side} // 256, {side} // 256, 1))
np.save("{folder}/{side}.npy", pixels)
eg.fit_large("{folder}/{side}.npy", "{folder}/{side}.npz", iterations=2, block=256)
succeeded(run("render", "{folder}/{side}.npz", "-o", "{folder}/{side}.tif", "--scale", 2))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_memory_is_that_of_a_block(tmp_path):
    """Of the fit, and of the picture that is drawn of it."""
    used = {}
    for side in (1024, 2048):
        code = MEASURE.format(folder=tmp_path, side=side)
        process = run_python(code, PYTHONPATH=python_path())
        assert process.returncode == 0, process.stderr
        used[side] = int(process.stdout.splitlines()[-1]) * 1024
    assert used[2048] - used[1024] < BLOCK_MEMORY


@pytest.mark.parametrize(
    ("size", "picture"),
    [((1024, 64), (16384, 512)), ((65536, 512), (32768, 256))],
    ids=["larger", "averaged"],
)
def test_pictures_are_drawn_by_strips(tmp_path, size, picture):
    """Also by Gaussians outside of a strip that become wider where pixels are averaged."""
    scene = random_scene(0, 200, size)
    scene.mean[:, 1] = np.linspace(0.45, 0.55, 200) * size[1]  # around the border of two strips
    gaussians = scene.on("llvm", space="rgb")
    gaussians.save(tmp_path / "a.npz")
    asked = ("--size", f"{picture[0]}x{picture[1]}", "--backend", "llvm", "--quiet")
    succeeded(run("render", tmp_path / "a.npz", "-o", tmp_path / "a.tif", *asked))
    drawn = np.rint(255 * eg.load_image(tmp_path / "a.tif"))
    whole = np.rint(255 * eg.picture_of(gaussians, *picture).clip(0, 1))
    assert drawn.shape == (picture[1], picture[0], 3) and np.ptp(drawn) > 50
    assert np.abs(drawn - whole).max() <= 1


# --- Runs that were stopped ---


class Stop(Exception):
    """The end of a run from outside."""


def end():
    raise Stop


def press():
    os.kill(os.getpid(), signal.SIGINT)


def stop_after(output, pixels, stage, share, settings=FEW, act=end):
    """Fit until a share of a stage is done."""

    def stop(done, total, row):
        if row.status == stage and done and done >= share * total:
            act()

    with pytest.raises((Stop, eg.Interrupted)) as stopped:
        eg.fit_large(pixels, output, progress=stop, **settings)
    return stopped.value


@pytest.mark.parametrize(
    ("stage", "act"),
    [("fit", end), pytest.param("density", end, marks=pytest.mark.slow), ("fit", press)],
)
def test_interrupted_run_goes_on(tmp_path, stage, act, short, request):
    pixels, output = mosaic(128), tmp_path / "a.npz"
    settings, whole = FEW, short
    if stage == "density":
        settings, whole = LONG, request.getfixturevalue("long")
    stopped = stop_after(output, pixels, stage, 0.5, settings, act)
    if act is press:
        row = stopped.result
        assert (row.status, row.width, row.height, row.output) == (stage, 128, 128, output)
    folder = tmp_path / "a.npz.checkpoint"
    assert folder.is_dir() and not output.exists()
    again = eg.fit_large(pixels, output, **settings)
    assert again.resumed >= 1
    assert_same_bits(whole, again)
    assert not folder.exists()
    check_equal(eg.Gaussians.load(output, backend="llvm"), whole.gaussians.to_arrays())


@pytest.mark.parametrize("part", [0.3, 0.95])
def test_a_round_with_a_hole_is_taken_again(tmp_path, part, small):
    """In any round, a run goes on from the last one that is complete, with the same bits."""
    output, rows = tmp_path / "a.npz", []
    stop_after(output, mosaic(64), "fit", part, HOLED)
    for path in (tmp_path / "a.npz.checkpoint").glob("fit?-2.npz"):
        path.unlink()

    def note(done, total, row):
        if row.status == "fit":
            rows.append(done)

    assert_same_bits(small, eg.fit_large(mosaic(64), output, progress=note, **HOLED))
    assert rows == sorted(rows) and rows[-1] == 4 * 32


def test_a_run_goes_on_beside_another_processor(tmp_path, short):
    """Its sums differ in the last bits; the run goes on with those of the first call."""
    pixels, output = mosaic(128), tmp_path / "a.npz"
    stop_after(output, pixels, "fit", 0.5)
    survey = tmp_path / "a.npz.checkpoint" / "survey.npz"
    arrays = dict(np.load(survey))
    np.savez(survey, **arrays | {"figures": arrays["figures"] * (1 + 1e-7)})
    again = eg.fit_large(pixels, output, **FEW)
    assert again.resumed >= 1 and again.psnr_rgb == pytest.approx(short.psnr_rgb, abs=1e-3)


def test_folder_of_another_run_is_refused(tmp_path):
    pixels, output = mosaic(128), tmp_path / "a.npz"
    stop_after(output, pixels, "measure", 0)
    with pytest.raises(ValueError, match="with gaussians 700 instead of 701"):
        eg.fit_large(pixels, output, **FEW | {"gaussians": 701})
    with pytest.raises(ValueError, match="interrupted run of another image"):
        eg.fit_large(pixels[::-1], output, **FEW)
    assert eg.fit_large(pixels, output, **FEW).resumed == 3 * 4  # three rounds of four blocks
