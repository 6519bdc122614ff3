"""The scenes and the command that renders them: pictures, measurements, mistakes."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

import eigengs_dr as eg  # noqa: E402
from eigengs_dr.cli.main import main  # noqa: E402

SCENES = Path(__file__).parent.parent / "scenes"
SMALL = ["-D", "resolution=32", "--spp", "16", "--variant", "llvm_ad_rgb", "--quiet"]


@pytest.fixture(scope="module", autouse=True)
def scripts():
    """The folder of the scenes is where their scripts are imported from; the variant is kept."""
    before = mi.variant()
    sys.path.insert(0, str(SCENES))
    yield
    sys.path.remove(str(SCENES))
    if before:
        mi.set_variant(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Sets under the names that the scenes use, of two halves: red above, blue below."""
    folder = tmp_path_factory.mktemp("sets")

    def save(name, above, below, space):
        # Two splats so wide that each is one colour all over its half.
        gaussians = eg.Gaussians.from_arrays(
            [[8, 4], [8, 12]],
            [[0.02, 0, 0.5], [0.02, 0, 0.5]],
            [above, below],
            [0.0] * len(above),
            size=(16, 16),
            space=space,
            backend="llvm",
        )
        gaussians.save(folder / f"{name}.npz")

    for name in ("floor", "floor-coded", "picture", "poster", "tiles-color"):
        save(name, [0.9, 0.1, 0.1], [0.1, 0.1, 0.9], "rgb" if name == "poster" else "linear")
    save("tiles-roughness", [0.2], [0.6], "data")
    save("tiles-normals", [0.5, 0.5, 1], [0.6, 0.4, 0.9], "data")
    return folder


def run(*arguments):
    return CliRunner().invoke(main, ["scene", *map(str, arguments)])


def rendered(name, folder, tmp_path, *options):
    """Linear radiance of a scene, shape (H, W, C), by the command."""
    path = tmp_path / f"{name}.exr"
    options = [*SMALL, "-D", f"folder={folder}", *options]
    result = run(SCENES / f"{name}.xml", "-o", path, *options)
    assert result.exit_code == 0, result.output
    assert result.output == ""
    pixels = np.array(mi.Bitmap(str(path)))
    assert pixels.shape == (32, 32, 3)
    assert np.isfinite(pixels).all()
    return pixels


def redness(pixels):
    return float((pixels[..., 0] - pixels[..., 2]).mean())


def assert_refused(result, *words):
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("eigengs-dr: error: ")
    assert result.stderr.count("\n") == 1
    for word in words:
        assert str(word) in result.stderr


# --- The scenes ----------------------------------------------------------------------------------


def test_plane_repeats_its_texture_below_the_sky(folder, tmp_path):
    pixels = rendered("plane", folder, tmp_path, "-D", "prefilter=0.026")
    assert np.allclose(pixels[0], [0.4, 0.145, 0.0785], atol=0.01)
    near = pixels[16:, 16]
    change = np.diff(np.sign(near[:, 0] - near[:, 2]))
    assert np.count_nonzero(change) >= 2


@pytest.mark.parametrize(
    ("name", "above", "below"),
    [
        ("light", np.s_[6:11, 12:20], np.s_[15:19, 12:20]),
        ("cornell", np.s_[9:12, 12:20], np.s_[16:20, 15:18]),
    ],
)
def test_pictures_hang_upright(name, above, below, folder, tmp_path):
    pixels = rendered(name, folder, tmp_path)
    assert redness(pixels[above]) > 0.1
    assert redness(pixels[below]) < -0.1


def test_picture_lights_the_room(folder, tmp_path):
    floor = rendered("light", folder, tmp_path)[-4:]
    assert 0.02 < floor.mean() < 0.5


def test_ball_shows_both_colours(folder, tmp_path):
    ball = rendered("ball", folder, tmp_path)[8:20, 10:22]
    assert (ball[..., 0] > 1.5 * ball[..., 2]).sum() > 10
    assert (ball[..., 2] > 1.5 * ball[..., 0]).sum() > 10


def test_assets_are_what_scenes_name(monkeypatch, tmp_path):
    assets = importlib.import_module("assets")
    made = {}
    monkeypatch.setattr(
        assets, "fitted", lambda folder, name, image, *rest: made.update({name: image})
    )
    assets.main(tmp_path)
    named = {
        name
        for path in SCENES.glob("*.xml")
        for name in re.findall(r"\$folder/([\w-]+)\.npz", path.read_text())
    }
    assert set(made) == named
    for image in made.values():
        assert 0 <= np.min(image) < np.max(image) <= 1
    normals = 2 * made["tiles-normals"] - 1
    assert np.allclose(np.linalg.norm(normals, axis=2), 1)
    assert made["tiles-roughness"].ndim == 2


def test_assets_keep_what_is_there(tmp_path):
    assets = importlib.import_module("assets")
    (tmp_path / "x.npz").write_text("kept")
    assets.fitted(tmp_path, "x", None, 1, "rgb")
    assert (tmp_path / "x.npz").read_text() == "kept"


def test_measurement_of_the_plane(folder, monkeypatch, tmp_path):
    plane = importlib.import_module("plane")
    monkeypatch.setattr(plane, "FOLDER", folder)
    strip = tmp_path / "strip.png"
    options = ["--resolution", "48", "--reference", "64", "--seeds", "2", "--strip", str(strip)]
    result = CliRunner().invoke(plane.main, options, catch_exceptions=False)
    assert result.exit_code == 0
    error = {
        line[:30].strip(): float(line[31:39]) for line in result.output.splitlines() if "+-" in line
    }
    assert len(error) == 5
    assert error["Gaussians, prefiltered"] < error["bitmap"] / 4
    assert strip.exists()


# --- The command ---------------------------------------------------------------------------------


EMPTY = """
<scene version="3.0.0">
    <default name="light" value="0.5"/>
    <integrator type="path"/>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="8"/>
            <integer name="height" value="6"/>
            <rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    </sensor>
    <emitter type="constant"><float name="radiance" value="$light"/></emitter>
    INSERT
</scene>
"""


@pytest.fixture
def scene(tmp_path):
    """Write a scene of which one line is given."""

    def write(line="", name="scene.xml", text=EMPTY):
        path = tmp_path / name
        path.write_text(text.replace("INSERT", line))
        return path

    return write


def test_says_what_it_did(scene, tmp_path):
    result = run(scene(), "-o", tmp_path / "x.png", "--variant", "llvm_ad_rgb")
    assert result.exit_code == 0, result.output
    assert "8x6, samples a pixel: 2" in result.stdout
    assert f"wrote {tmp_path / 'x.png'}" in result.stdout
    assert np.allclose(mi.Bitmap(str(tmp_path / "x.png")), 187.5, atol=0.5)  # 0.5, dithered


def test_several_scenes_into_a_folder(scene, tmp_path):
    scenes = [scene(name="a.xml"), scene(name="b.xml")]
    result = run(*scenes, "-o", tmp_path / "out", "-D", "light=1", "--spp", 1)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png"]


def test_passes_make_one_picture(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("eigengs_dr.cli.scene.SAMPLES_PER_PASS", 8 * 6 * 2)
    result = run(scene(), "-o", tmp_path / "x.exr", "--spp", 5)
    assert "samples a pixel: 5" in result.stdout
    assert np.allclose(mi.Bitmap(str(tmp_path / "x.exr")), 0.5)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('<shape type="rectangl"/>', ["rectangl", "line 14"]),
        ('<shape type="sphere">', ["mismatch"]),
        ('<shape type="sphere"><float name="size" value="$x"/></shape>', ["undefined", "$x"]),
        (
            '<texture type="gaussian_texture"><string name="filename" value="no.npz"/></texture>',
            ["No such file or directory", "no.npz"],
        ),
        (
            '<texture type="gaussian_texture"><float name="prefilter" value="1"/></texture>',
            ["gaussian_texture: give one of filename"],
        ),
    ],
)
def test_broken_scene(line, words, scene, tmp_path):
    path = scene(line)
    result = run(path, "-o", tmp_path / "x.png", "--variant", "llvm_ad_rgb")
    assert_refused(result, path, *words)
    assert "Traceback" not in result.stderr
    assert "cpp" not in result.stderr
    assert not (tmp_path / "x.png").exists()


def test_mistake_that_shows_while_rendering(scene, folder, tmp_path):
    path = scene(
        '<shape type="sphere"><bsdf type="normalmap"><bsdf type="diffuse"/>'
        '<texture type="gaussian_texture" name="normalmap"><boolean name="raw" value="true"/>'
        f'<string name="filename" value="{folder / "tiles-roughness.npz"}"/></texture>'
        "</bsdf></shape>"
    )
    result = run(path, "-o", tmp_path / "x.png", "--variant", "llvm_ad_rgb")
    assert_refused(result, "three channels are asked")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["No document element"]),
        ('<scene version="3.0.0"/>', ["no sensor"]),
        ('<scene version="3.0.0"><sensor type="perspective"/></scene>', ["ntegrator"]),
        ('<shape version="3.0.0" type="sphere"/>', ["holds no scene"]),
    ],
)
def test_no_scene(text, words, scene, tmp_path):
    assert_refused(run(scene(text=text), "-o", tmp_path / "x.png"), *words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-D", "spp"], ["spp=16"]),
        (["-D", "path=x"], ["path", "rename"]),
        (["-D", "other=1"], ["$other"]),
        (["--variant", "llvm"], ["--variant llvm", "llvm_ad_rgb"]),
        (["--spp", "0"], ["--spp"]),
    ],
)
def test_mistaken_options(options, words, scene, tmp_path):
    assert_refused(run(scene(), "-o", tmp_path / "x.png", *options), *words)


def test_mistaken_files(scene, tmp_path):
    assert_refused(run(tmp_path / "no.xml", "-o", tmp_path / "x.png"), "no.xml")
    assert_refused(run(scene(), "-o", tmp_path / "no" / "x.png"), "no file can be made")
    assert_refused(run(scene(), "-o", tmp_path / "x.jpg"), ".png or .exr")


def test_without_mitsuba(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert_refused(run(scene(), "-o", tmp_path / "x.png"), "pip install 'eigengs-dr[plugins]'")
