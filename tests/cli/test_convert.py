"""The command convert."""

import json

import pytest
from click.testing import CliRunner

mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

from _helpers.bitmap_scenes import save_images, sky  # noqa: E402
from eigengs_dr.cli.main import main  # noqa: E402

pytestmark = pytest.mark.mitsuba


@pytest.fixture(autouse=True)
def variant():
    """Keep the variant."""
    before = mi.variant()
    yield
    if before:
        mi.set_variant(before)


def run(*arguments):
    """Call the program with its arguments."""
    return CliRunner().invoke(main, [str(argument) for argument in ("convert", *arguments)])


def test_a_scene(tmp_path):
    scene = sky(save_images(tmp_path))
    settings = ("--psnr", 25, "--iterations", 5, "-D", "spp=2", "--variant", "llvm_ad_rgb")
    result = run(scene, "-o", tmp_path / "new", *settings, "--report", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    for words in ("32x32", "(the same set)", "memory: ", "left alone: leaf.png", "camera 1: "):
        assert words in result.output
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["bytes"] < report["bytes_before"] and len(report["left"]) == 4
    assert (tmp_path / "new" / "scene.xml").exists()
    again = run(scene, "-o", tmp_path / "new")
    assert again.exit_code == 2 and "exists and is not empty" in again.output
    assert len(again.output.strip().splitlines()) == 1


def test_mistakes(tmp_path):
    (tmp_path / "bad.xml").write_text("<scene version='3.0.0'><shape></scene>")
    before = sorted(tmp_path.iterdir())
    for arguments, words in (
        ((tmp_path / "bad.xml", "-o", tmp_path / "new"), "bad.xml: "),
        ((tmp_path / "none.xml", "-o", tmp_path / "new"), "does not exist"),
        ((tmp_path / "bad.xml", "-o", tmp_path / "a" / "b"), "cannot create a folder"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2, result.output
        assert words in result.output and len(result.output.strip().splitlines()) == 1
        assert sorted(tmp_path.iterdir()) == before
