"""The commands `scene` and `convert`."""

import json
import subprocess
import sys

import numpy as np
import pytest

from _helpers.command import assert_refused, run, said
from _helpers.scene_sets import save_halves

mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

from _helpers.bitmap_scenes import save_images, sky  # noqa: E402

pytestmark = pytest.mark.mitsuba

LLVM = ("--variant", "llvm_ad_rgb")

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


@pytest.fixture(scope="module", autouse=True)
def variant():
    """The commands set a variant; the variant before is set again."""
    before = mi.variant()
    yield
    if before:
        mi.set_variant(before)


@pytest.fixture
def scene(tmp_path):
    """Write a scene of which one line is given."""

    def write(line="", name="scene.xml", text=EMPTY):
        path = tmp_path / name
        path.write_text(text.replace("INSERT", line))
        return path

    return write


def test_says_what_it_did(scene, tmp_path):
    told = said("scene", scene(), "-o", tmp_path / "x.png", *LLVM)
    assert "8x6, samples per pixel: 2" in told and f"wrote {tmp_path / 'x.png'}" in told
    assert np.allclose(mi.Bitmap(str(tmp_path / "x.png")), 187.5, atol=0.5)  # 0.5, dithered


def test_several_scenes_into_a_folder(scene, tmp_path):
    scenes = [scene(name="a.xml"), scene(name="b.xml")]
    said("scene", *scenes, "-o", tmp_path / "out", "-D", "light=1", "--spp", 1)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png"]


def test_passes_make_one_picture(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("eigengs_dr.scene.convert.SAMPLES_PER_PASS", 8 * 6 * 2)
    told = said("scene", scene(), "-o", tmp_path / "x.exr", "--spp", 5)
    assert "samples per pixel: 5" in told
    assert np.allclose(mi.Bitmap(str(tmp_path / "x.exr")), 0.5)


BROKEN = [
    ('<shape type="rectangl"/>', ["rectangl", "line 14"]),
    ('<shape type="sphere"><float name="size" value="$x"/></shape>', ["undefined", "$x"]),
    (
        '<texture type="gaussian_texture"><string name="filename" value="no.npz"/></texture>',
        ["No such file or directory", "no.npz"],
    ),
    (
        '<texture type="gaussian_texture"><float name="prefilter" value="1"/></texture>',
        ["gaussian_texture: give one of filename"],
    ),
    (
        '<shape type="sphere"><bsdf type="normalmap"><bsdf type="diffuse"/>'
        '<texture type="gaussian_texture" name="normalmap"><boolean name="raw" value="true"/>'
        '<string name="filename" value="FOLDER/roughness.npz"/></texture></bsdf></shape>',
        ["a lookup of three channels"],  # which shows while it renders
    ),
]


@pytest.mark.parametrize(("line", "words"), BROKEN)
def test_broken_scene(line, words, scene, tmp_path):
    if "FOLDER" in line:
        line = line.replace("FOLDER", str(save_halves(tmp_path)))
    path = scene(line)
    result = run("scene", path, "-o", tmp_path / "x.png", *LLVM)
    assert_refused(result, path, *words)
    assert "Traceback" not in result.stderr and "cpp" not in result.stderr
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "No document element"),
        ('<scene version="3.0.0"/>', "no sensor"),
        ('<scene version="3.0.0"><sensor type="perspective"/></scene>', "ntegrator"),
        ('<shape version="3.0.0" type="sphere"/>', "holds no scene"),
    ],
)
def test_no_scene(text, words, scene, tmp_path):
    assert_refused(run("scene", scene(text=text), "-o", tmp_path / "x.png"), words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-D", "spp"], ["spp=16"]),
        (["-D", "path=x"], ["path"]),
        (["-D", "other=1"], ["$other"]),
        (["--variant", "llvm"], ["--variant llvm", "llvm_ad_rgb"]),
        (["--spp", "0"], ["--spp"]),
        (["-o", "no/x.png"], ["cannot create a file"]),
        (["-o", "x.jpg"], [".png or .exr"]),
        (["no.xml"], ["no.xml"]),
    ],
)
def test_mistaken_options(options, words, scene, tmp_path):
    assert_refused(run("scene", scene(), "-o", tmp_path / "x.png", *options), *words)


def test_without_mitsuba(scene, tmp_path):
    program = (
        "import sys; sys.modules['mitsuba'] = None; from eigengs_dr.cli.main import main; main()"
    )
    command = [sys.executable, "-c", program, "scene", scene(), "-o", tmp_path / "x.png"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 2 and len(result.stderr.splitlines()) == 1
    assert "pip install 'mitsuba>=3.9,<4'" in result.stderr


def test_convert(tmp_path):
    scene = sky(save_images(tmp_path))
    settings = ("--psnr", 25, "--iterations", 5, "-D", "spp=2", *LLVM)
    told = said("convert", scene, "-o", tmp_path / "new", *settings, "--report", tmp_path / "r")
    for words in ("32x32", "(the same set)", "memory: ", "left alone: leaf.png", "camera 1: "):
        assert words in told
    report = json.loads((tmp_path / "r").read_text())
    assert report["bytes"] < report["bytes_before"] and len(report["left"]) == 5
    assert (tmp_path / "new" / "scene.xml").exists()
    assert_refused(run("convert", scene, "-o", tmp_path / "new"), "exists and is not empty")


def test_mistakes_of_convert(scene, tmp_path):
    bad = scene(text="<scene version='3.0.0'><shape></scene>")
    for arguments, words in (
        ([bad, "-o", tmp_path / "new"], "scene.xml: "),
        ([tmp_path / "none.xml", "-o", tmp_path / "new"], "does not exist"),
        ([bad, "-o", tmp_path / "a" / "b"], "cannot create a file"),
    ):
        assert_refused(run("convert", *arguments), words)
        assert list(tmp_path.iterdir()) == [bad]
