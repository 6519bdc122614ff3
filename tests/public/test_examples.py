"""The examples run, write pictures, and reach what they print."""

import re
import runpy
import sys
from pathlib import Path

import pytest

import eigengs_dr as eg

FOLDER = Path(__file__).parents[2] / "examples"

NUMBER = r"(-?\d+(?:\.\d+)?(?:e[+-]\d+)?)"


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Run an example in this process, where programs that are compiled already are at hand."""
    mi = sys.modules.get("mitsuba")
    before = mi.variant() if mi else None

    def run(name, *arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        try:
            runpy.run_path(str(FOLDER / name), run_name="__main__")
        except SystemExit as end:
            assert not end.code, end.code
        return capsys.readouterr().out

    yield run
    if before is not None:
        mi.set_variant(before)


def numbers(text, pattern):
    """The numbers in the one place of the output that looks like the pattern, NUM for each."""
    escaped = re.escape(pattern).replace("NUM", NUMBER)
    found = re.findall(escaped, text)
    assert len(found) == 1, f"{pattern!r} is in the output {len(found)} times:\n{text}"
    return [float(x) for x in (found[0] if isinstance(found[0], tuple) else found)]


def check_pictures(folder, *names):
    """Whether just these pictures were written, and show something."""
    assert sorted(path.stem for path in folder.glob("*.png")) == sorted(names)
    for name in names:
        assert eg.load_image(folder / f"{name}.png").std() > 0.01, name


def test_fit_an_image(run, tmp_path):
    out = run("fit_an_image.py", tmp_path / "a" / "folder")
    count, psnr, _ = numbers(out, "NUM Gaussians, PSNR NUM dB, NUM s")
    assert count == 3000 and psnr > 36
    folder = tmp_path / "a" / "folder"
    check_pictures(folder, "cat", "cat_4x")
    assert eg.load_image(folder / "cat_4x.png").shape == (800, 960, 3)
    assert len(eg.Gaussians.load(folder / "cat.npz")) == 3000


@pytest.mark.slow
def test_film(run, tmp_path):
    out = run("film.py", tmp_path)
    film, alone = numbers(out, "still                  NUM (NUM)")
    assert film > alone + 0.2
    check_pictures(tmp_path, "still", "an_object_moves", "pan", "cuts")


@pytest.mark.slow
def test_render_and_differentiate(run, tmp_path):
    out = run("render_and_differentiate.py")
    reverse, forward = numbers(out, "by NUM a pixel (reverse), NUM (forward)")
    assert reverse == pytest.approx(forward, rel=0.01, abs=2e-6) and reverse != 0
    first, last, _ = numbers(out, "from NUM to NUM in NUM steps")
    assert last < 1e-8 < 1e-3 < first
    assert "[[20.0, 16.0], [30.0, 28.0], [48.0, 22.0]]" in out
    check_pictures(tmp_path / "build" / "examples", "target", "change", "found")


def test_numpy_and_torch(run, tmp_path):
    out = run("numpy_and_torch.py", tmp_path)
    [difference] = numbers(out, "differ by NUM at most")
    assert difference < 0.01  # where a splat ends, rounding decides on 1.1 % of it
    if "PyTorch: skipped" in out:
        check_pictures(tmp_path, "rocket", "rocket_mirrored")
        pytest.skip("no PyTorch")
    first, last, _ = numbers(out, "from NUM to NUM in NUM steps")
    assert last < 0.05 * first
    [difference] = numbers(out, "differs from Dr.Jit's by NUM of the largest entry")
    assert difference < 1e-4
    check_pictures(tmp_path, "rocket", "rocket_mirrored", "rocket_torch")


@pytest.mark.slow
@pytest.mark.mitsuba
def test_texture(run, tmp_path):
    pytest.importorskip("mitsuba")
    out = run("texture.py", tmp_path)
    points, filtered = numbers(out, "NUM at points, NUM prefiltered")
    assert 0 < filtered < 0.6 * points
    check_pictures(tmp_path, "floor_points", "floor_filtered", "floor_truth")


@pytest.mark.slow
def test_photos_of_a_ball(run, tmp_path):
    pytest.importorskip("mitsuba")
    out = run("photos_of_a_ball.py", tmp_path)
    by_texels, by_gaussians = map(float, re.findall(r"(\d+\.\d) dB in another view", out))
    assert by_gaussians > max(by_texels, 36)
    check_pictures(tmp_path, "photos", "paint", "errors")
    found = eg.Gaussians.load(tmp_path / "paint.npz")
    assert found.space == "linear" and len(found) == 4096


@pytest.mark.slow
def test_fit_for_scene(run, tmp_path):
    pytest.importorskip("mitsuba")
    out = run("fit_for_scene.py", tmp_path)
    found = re.findall(r"(\d+) Gaussians; PSNR (\d+\.\d) dB on the poster", out)
    far, middle, near = (int(count) for count, _ in found)
    assert 2 * far < middle and 1.5 * middle < near
    assert min(float(psnr) for _, psnr in found) >= 40
    check_pictures(tmp_path, "budget", "budget_photo")


@pytest.mark.slow
def test_convert_scene(run, tmp_path):
    mi = pytest.importorskip("mitsuba")
    run("convert_scene.py", tmp_path)
    check_pictures(tmp_path, "cat")
    files = [tmp_path / name for name in ("box.xml", "box-gaussians.xml")]
    assert ['type="bitmap"' in file.read_text() for file in files] == [True, False]
    size = {"resx": "64", "resy": "64"}
    before, after = (mi.render(mi.load_file(str(f), **size), spp=16).numpy() for f in files)
    assert eg.psnr(*(eg.image.color.to_coded(p.clip(0, 1)) for p in (before, after))) > 36


def test_all_are_listed_and_tested():
    scripts = {path.name for path in FOLDER.glob("*.py")}
    listed = re.findall(r"^\| \[`(\w+\.py)`\]\(\1\) \|", (FOLDER / "README.md").read_text(), re.M)
    assert sorted(listed) == sorted(scripts)
    sizes = {path.stem: path.stat().st_size for path in (FOLDER / "images").iterdir()}
    assert {f"{name}.py" for name in sizes} == scripts and max(sizes.values()) < 60_000
    tested = {name.removeprefix("test_") + ".py" for name in globals() if name.startswith("test_")}
    assert scripts <= tested
