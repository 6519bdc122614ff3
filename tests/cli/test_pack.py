"""The command `pack`."""

import re

import eigengs_dr as eg
from _helpers.command import run
from _helpers.packed import small_fit
from eigengs_dr.cli import pack as cli_pack
from eigengs_dr.codec import egs as packed
from eigengs_dr.codec import packing


def test_commands_pack_and_read(tmp_path):
    gaussians, image = small_fit()
    gaussians.save(tmp_path / "x.npz")
    eg.save_image(tmp_path / "x.png", image)
    source, target = tmp_path / "x.npz", tmp_path / "x.egs"
    told = run("pack", source, "-o", target, "--image", tmp_path / "x.png", "--max-psnr-drop", 0.2)
    assert told.exit_code == 0, told.output
    size = (tmp_path / "x.egs").stat().st_size
    assert f"{size:,} bytes, {8 * size / 1024:.3f} bits per pixel" in told.output
    told = run("info", target).output
    for line in (rf"bytes +{size}", r"bpp +\d", r"color_step +\d"):
        assert re.search(f"(?m)^{line}", told)
    assert "bpp" in run("info", tmp_path / "x.npz").output
    for suffix in ("npz", "egs"):
        run("render", tmp_path / f"x.{suffix}", "-o", tmp_path / f"{suffix}.png")
    one, other = (eg.load_image(tmp_path / f"{suffix}.png") for suffix in ("npz", "egs"))
    assert eg.psnr(one, other) > 30
    assert run("pack", tmp_path / "x.npz", "-o", tmp_path / "y.zip").exit_code == 2
    told = run("pack", source, "-o", target, "--image", tmp_path / "x.png", "--levels", 9)
    assert told.exit_code == 2 and "x.npz: levels is 9" in told.output


def test_the_command_knows_the_defaults():
    assert (packed.SUFFIX, packing.BUDGET) == (cli_pack.SUFFIX, cli_pack.BUDGET)
    assert "Examples" in run("pack", "--help").output
