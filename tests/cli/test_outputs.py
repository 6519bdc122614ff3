"""Names of outputs, for many images too, and names that a terminal cannot show."""

import os
import zipfile

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import run, smooth_pixels, succeeded
from _helpers.process import python_path, run_python
from eigengs_dr.cli.console import printable
from eigengs_dr.cli.outputs import check_outputs, name_outputs

QUICK = ("--gaussians", 20, "--iterations", 1)


def test_many_images(tmp_path):
    """Each name is looked at once: a second look at all for each would take minutes."""
    images = [tmp_path / f"{number}.png" for number in range(5_000)]
    outputs = name_outputs(images, tmp_path / "fits", [".npz"])
    check_outputs(outputs, images)
    assert len(outputs) == 5_000 and os.listdir(tmp_path / "fits") == []
    with pytest.raises(ValueError, match=r"7\.npz: two images have this name"):
        name_outputs([*images, tmp_path / "other" / "7.jpg"], tmp_path / "fits", [".npz"])


def test_what_killed_runs_left_beside_a_single_output_goes(photo, tmp_path):
    stale = tmp_path / ".eigengs_dr-0123456789abcdef.npz"
    stale.write_bytes(b"half")
    succeeded(run("fit", photo, "-o", tmp_path / "x.npz", *QUICK))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photo.png", "x.npz"]


@pytest.mark.parametrize("suffix", [".npz", ".png"])
def test_names_that_the_command_chooses_are_no_links(photo, tmp_path, suffix):
    """Names that the user gives may be; so may sets, which are looked at before."""
    link, precious = tmp_path / f"a{suffix}", tmp_path / "thesis"
    link.symlink_to(precious)
    with pytest.raises(ValueError, match=rf"a\{suffix}: is a link, which is not followed"):
        name_outputs(["a.jpg"], tmp_path, [suffix])
    assert name_outputs(["a.jpg"], link, [suffix]) == [link]
    precious.write_text("thesis")
    if suffix == ".npz":
        assert name_outputs(["a.jpg"], tmp_path, [suffix]) == [link]
        told = run("fit", photo.rename(tmp_path / "a.png"), "-o", tmp_path, *QUICK)
        assert told.exit_code == 2 and "is not a set of Gaussians" in told.stderr
        assert precious.read_text() == "thesis"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("é 猫 a.png", "é 猫 a.png"),
        ("caf\udce9", r"caf\xe9"),
        ("a\nb\x1b[31m\x7f", r"a\nb\x1b[31m\x7f"),
        ("\u202egnp", r"\u202egnp"),
    ],
)
def test_printable(text, shown):
    assert printable(text) == shown


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
def test_names_of_files_are_lines_of_text(photo, tmp_path):
    strange = photo.rename(tmp_path / "a\n\x1b[31mb.png")
    told = succeeded(run("fit", strange, "-o", tmp_path / "c\nd.npz", *QUICK, "--overwrite"))
    assert told.stdout.count("\n") == 3 and r"a\n\x1b[31mb.png: 32x32" in told.stdout
    told = succeeded(run("info", tmp_path / "c\nd.npz"))
    assert r"c\nd.npz" in told.stdout and "\x1b" not in told.stdout
    missing = run("info", tmp_path / "\x1b[2J.npz")
    assert missing.exit_code == 2 and r"\x1b[2J.npz" in missing.stderr


def test_names_in_archives_are_printed_without_control_characters(fitted, tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes((fitted[0] / "fit.npz").read_bytes())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("\x1b[31mred.npy", b"")
    told = succeeded(run("info", path))
    assert r"\x1b[31mred" in told.stdout and "\x1b" not in told.stdout


def test_a_terminal_that_cannot_show_a_name(tmp_path):
    name = tmp_path / "é猫.png"
    eg.save_image(name, smooth_pixels(8, 8))
    words = ["fit", str(name), "-o", str(tmp_path / "x.npz"), "--gaussians", "4"]
    code = f"""
import sys
from eigengs_dr.cli.main import main
main({[*words, "--iterations", "1"]!r})
"""
    found = run_python(code, PYTHONPATH=python_path(), PYTHONIOENCODING="ascii:strict")
    assert found.returncode == 0, found.stderr
    assert np.isfinite(eg.Gaussians.load(tmp_path / "x.npz").to_arrays()["mean"]).all()
