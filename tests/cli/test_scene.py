"""The command `scene`."""

import sys

import numpy as np
import pytest

from _helpers import command
from _helpers.command import assert_refused
from _helpers.scene_sets import save_halves

mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

pytestmark = pytest.mark.mitsuba


@pytest.fixture(scope="module", autouse=True)
def variant():
    """The command sets a variant; the variant before is set again."""
    before = mi.variant()
    yield
    if before:
        mi.set_variant(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_halves(tmp_path_factory.mktemp("sets"))


def run(*arguments):
    return command.run("scene", *arguments)


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
    assert "8x6, samples per pixel: 2" in result.stdout
    assert f"wrote {tmp_path / 'x.png'}" in result.stdout
    assert np.allclose(mi.Bitmap(str(tmp_path / "x.png")), 187.5, atol=0.5)  # 0.5, dithered


def test_several_scenes_into_a_folder(scene, tmp_path):
    scenes = [scene(name="a.xml"), scene(name="b.xml")]
    result = run(*scenes, "-o", tmp_path / "out", "-D", "light=1", "--spp", 1)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png"]


def test_passes_make_one_picture(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("eigengs_dr.scene.convert.SAMPLES_PER_PASS", 8 * 6 * 2)
    result = run(scene(), "-o", tmp_path / "x.exr", "--spp", 5)
    assert "samples per pixel: 5" in result.stdout
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
        f'<string name="filename" value="{folder / "roughness.npz"}"/></texture>'
        "</bsdf></shape>"
    )
    result = run(path, "-o", tmp_path / "x.png", "--variant", "llvm_ad_rgb")
    assert_refused(result, "a lookup of three channels")


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
    assert_refused(run(scene(), "-o", tmp_path / "no" / "x.png"), "cannot create a file")
    assert_refused(run(scene(), "-o", tmp_path / "x.jpg"), ".png or .exr")


def test_without_mitsuba(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert_refused(run(scene(), "-o", tmp_path / "x.png"), "pip install 'mitsuba==3.9.*'")


def test_sets_that_were_not_made_yet(scene, tmp_path):
    """The scenes of the repository need `make scenes` once."""
    line = """<shape type="rectangle"><bsdf type="diffuse"><texture type="gaussian_texture"
        name="reflectance"><string name="filename" value="build/scenes/none.npz"/></texture>
        </bsdf></shape>"""
    assert_refused(run(scene(line), "-o", tmp_path / "x.png"), "none.npz", "make scenes")
