"""Fits by blocks that were stopped: no work is lost, and the bits are the same."""

import os
import signal

import pytest

import eigengs_dr as eg
from _helpers.mosaics import FEW, assert_same_bits, mosaic
from _helpers.sets import check_equal


class Stop(Exception):
    """The end of a run from outside."""


def end():
    raise Stop


def press():
    os.kill(os.getpid(), signal.SIGINT)


def stop_after(output, pixels, stage, share, settings=FEW, act=end):
    """Fit until a share of a stage is done."""

    def stop(done, total, row):
        if row["stage"] == stage and done and done >= share * total:
            act()

    with pytest.raises((Stop, KeyboardInterrupt)):
        eg.fit_large(pixels, output, progress=stop, **settings)


@pytest.mark.parametrize(("stage", "act"), [("fit", end), ("density", end), ("fit", press)])
def test_interrupted_run_goes_on(tmp_path, stage, act):
    pixels, output = mosaic(128), tmp_path / "a.npz"
    settings = FEW | {"iterations": 200 if stage == "density" else 20}
    whole = eg.fit_large(pixels, **settings)
    stop_after(output, pixels, stage, 0.5, settings, act)
    folder = tmp_path / "a.npz.checkpoint"
    assert folder.is_dir() and not output.exists()
    again = eg.fit_large(pixels, output, **settings)
    assert again.resumed >= 1
    assert_same_bits(whole, again)
    assert not folder.exists()
    check_equal(eg.Gaussians.load(output, backend="llvm"), whole.gaussians.to_arrays())


def test_a_block_is_kept_before_its_end_is_told(tmp_path):
    """A callable that raises does not lose the block that has just ended."""
    stop_after(tmp_path / "a.npz", mosaic(128), "fit", 0)
    assert eg.fit_large(mosaic(128), tmp_path / "a.npz", **FEW).resumed == 1


def test_a_folder_keeps_the_last_rounds_alone(tmp_path):
    """The Gaussians of an image would else lie on the disk once for every round."""
    stop_after(tmp_path / "a.npz", mosaic(128), "measure", 0)
    kept = {path.name for path in (tmp_path / "a.npz.checkpoint").glob("fit*")}
    assert kept == {f"fit2-{number}.npz" for number in range(4)}


@pytest.mark.parametrize("part", [0.3, 0.6, 0.95])
def test_a_round_with_a_hole_is_taken_again(tmp_path, part):
    """In any round, a run goes on from the last one that is complete, with the same bits."""
    settings = FEW | {"gaussians": 200, "block": 32, "iterations": 32}
    whole = eg.fit_large(mosaic(64), **settings)
    output, rows = tmp_path / "a.npz", []
    stop_after(output, mosaic(64), "fit", part, settings)
    for path in (tmp_path / "a.npz.checkpoint").glob("fit?-2.npz"):
        path.unlink()

    def note(done, total, row):
        if row["stage"] == "fit":
            rows.append(done)

    assert_same_bits(whole, eg.fit_large(mosaic(64), output, progress=note, **settings))
    assert rows == sorted(rows) and rows[-1] == 4 * 32


def test_folder_of_another_run_is_refused(tmp_path):
    pixels, output = mosaic(128), tmp_path / "a.npz"
    stop_after(output, pixels, "measure", 0)
    with pytest.raises(ValueError, match="with gaussians 700 instead of 701"):
        eg.fit_large(pixels, output, **FEW | {"gaussians": 701})
    with pytest.raises(ValueError, match="interrupted run of another image"):
        eg.fit_large(pixels[::-1], output, **FEW)
    assert eg.fit_large(pixels, output, **FEW).resumed == 3 * 4  # three rounds of four blocks
