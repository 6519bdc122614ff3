"""The command `scene`: pictures of Mitsuba scenes, their cameras and layers, and mistakes."""

import numpy as np
import pytest

from _helpers.command import assert_refused, run, said
from _helpers.scene_sets import save_halves

mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")

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


@pytest.mark.exr
def test_passes_make_one_picture(scene, tmp_path):
    """Of more samples than one pass takes, 2^24."""
    told = said("scene", scene(), "-o", tmp_path / "x.exr", "--spp", 360_000)
    assert "samples per pixel: 360000" in told
    assert np.allclose(mi.Bitmap(str(tmp_path / "x.exr")), 0.5)


CAMERAS = """
<scene version="3.0.0">
    <integrator type="aov"><string name="aovs" value="far:depth,up:sh_normal"/>
        <integrator type="path" name="all"/><integrator type="direct" name="once"/></integrator>
    <sensor type="perspective" id="left"><float name="fov" value="40"/>FILM</sensor>
    <sensor type="perspective"><float name="fov" value="40"/>FILM</sensor>
    <shape type="sphere"><point name="center" x="0" y="0" z="4"/></shape>
    <emitter type="constant"/>
</scene>
""".replace(
    "FILM",
    '<film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>'
    '<string name="pixel_format" value="rgb"/></film>',
)


def channels_of(path):
    """Names of the channels of a file."""
    return [field.name for field in mi.Bitmap(str(path)).struct_()]


@pytest.mark.exr
def test_layers_have_their_names_and_a_depth_is_no_alpha(scene, tmp_path):
    path = scene(text=CAMERAS)
    name = str(tmp_path / "x.exr")
    said("scene", path, "-o", name, *LLVM, "--spp", 2)
    seen = dict(zip(channels_of(tmp_path / "x.exr"), np.array(mi.Bitmap(name)).T, strict=True))
    layers = [f"once.{c}" for c in "RGB"]
    assert {*seen} == {*"RGB", *layers, "far.T", *(f"up.{c}" for c in "XYZ")}
    assert seen["far.T"][3, 2] == pytest.approx(3, abs=0.1)
    assert seen["up.Z"][3, 2] == pytest.approx(-1, abs=0.1)
    assert np.abs(seen["R"] - seen["once.R"]).max() < 0.5  # both integrators see this light
    told = said("scene", path, "-o", tmp_path / "x.png", "--spp", 2)
    assert "x.png, without once.R" in told and "the first of 2 cameras; --camera all" in told
    assert mi.Bitmap(str(tmp_path / "x.png")).pixel_format() == mi.Bitmap.PixelFormat.RGB


@pytest.mark.exr
def test_another_integrator(scene, tmp_path):
    """Of AOVs alone, which may be one or four; or of colours, whose parameters count."""
    path = scene(text=CAMERAS)
    for aovs, names in (("far:depth", ["far.T"]), ("uv:uv", ["uv.U", "uv.V"])):
        depth = ("--integrator", f"aov,aovs={aovs}")
        said("scene", path, "-o", tmp_path / "x.exr", *depth)
        assert channels_of(tmp_path / "x.exr") == names
        words = f"it has no colours, only {', '.join(names)}; write an .exr file"
        assert_refused(run("scene", path, "-o", tmp_path / "x.png", *depth), path, words)
    seen = []
    for depth in (1, 2):
        renderer = ("--integrator", f"path,max_depth={depth},hide_emitters=true")
        said("scene", path, "-o", tmp_path / "x.exr", *renderer, "--spp", 4)
        seen.append(np.array(mi.Bitmap(str(tmp_path / "x.exr"))).mean())
    assert seen[0] == 0 and seen[1] > 0.05
    for wrong, words in (("pathh", "pathh"), ("path,depth=1", "depth"), ("path,depth", "spp=16")):
        command = ("scene", path, "-o", tmp_path / "x.png", "--integrator", wrong)
        assert_refused(run(*command), words)


@pytest.mark.exr
def test_cameras(scene, tmp_path):
    path = scene(text=CAMERAS.replace('value="6"', 'value="5"', 1))
    sizes = {}
    for name in ("left", "1", "2"):
        picture = tmp_path / f"{name}.png"
        told = said("scene", path, "-o", picture, "--camera", name, "--integrator", "direct")
        assert f"camera {'2' if name == '2' else 'left'}: " in told
        sizes[name] = mi.Bitmap(str(tmp_path / f"{name}.png")).width()
    assert sizes == {"left": 5, "1": 5, "2": 6}
    said("scene", path, "-o", tmp_path / "all.exr", "--camera", "all", "--integrator", "direct")
    assert sorted(p.name for p in tmp_path.glob("all*")) == ["all-2.exr", "all-left.exr"]
    assert_refused(
        run("scene", path, "-o", tmp_path / "x.png", "--camera", "3"),
        "it has no camera 3; use all, or one of left, 2",
    )


WALL = """<shape type="rectangle">
    <transform name="to_world"><translate z="4"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"><texture type="gaussian_texture" name="reflectance">
        <string name="filename" value="roughness.npz"/>PREFILTER
    </texture></bsdf></bsdf>
</shape>"""
SPHERE = '<shape type="sphere"><point name="center" x="0" y="0" z="4"/></shape>'


@pytest.mark.slow
@pytest.mark.exr
def test_a_texture_follows_each_camera(scene, tmp_path):
    """And a prefilter that is a number for another film does not blur in silence."""
    save_halves(tmp_path)
    text = CAMERAS.replace('value="6"', 'value="12"', 1).replace(SPHERE, WALL)
    follows = text.replace("PREFILTER", '<boolean name="prefilter" value="true"/>')
    number = text.replace("PREFILTER", '<float name="prefilter" value="$angle"/>')
    followed, numbered = scene(text=follows, name="a.xml"), scene(text=number, name="b.xml")
    usual = ("-o", tmp_path / "x.exr", "--integrator", "direct", "--spp", 4)
    for camera, width in (("left", 12), ("2", 6)):
        angle = 2 * np.tan(np.radians(20)) / width
        pictures = []
        for path, options in ((followed, ()), (numbered, ("-D", f"angle={angle}"))):
            said("scene", path, *usual, "--camera", camera, *options)
            pictures.append(np.array(mi.Bitmap(str(tmp_path / "x.exr"))))
        assert pictures[0].shape[:2] == (4, width)
        np.testing.assert_allclose(*pictures, rtol=1e-5)
    result = run("scene", numbered, *usual, "-D", "angle=0.5")
    assert result.exit_code == 0 and "say true, and the texture follows" in result.stderr


BROKEN = [
    ('<shape type="rectangl"/>', ["rectangl", "line 14"]),
    (
        '<texture type="gaussian_texture"><string name="filename" value="no.npz"/></texture>',
        ["no.npz: no such file; check the path"],
    ),
    (
        '<texture type="gaussian_texture"><float name="prefilter" value="1"/></texture>',
        ["gaussian_texture: give one of filename"],
    ),
    pytest.param(  # which shows while it renders
        '<shape type="sphere"><bsdf type="normalmap"><bsdf type="diffuse"/>'
        '<texture type="gaussian_texture" name="normalmap"><boolean name="raw" value="true"/>'
        '<string name="filename" value="roughness.npz"/></texture></bsdf></shape>',
        ["a lookup of three channels"],
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize(("line", "words"), BROKEN)
def test_broken_scene(line, words, scene, tmp_path):
    save_halves(tmp_path)
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
        (["-o", "x.jpg"], [".png or .exr"]),
        (["no.xml"], ["no.xml"]),
    ],
)
def test_mistaken_options(options, words, scene, tmp_path):
    assert_refused(run("scene", scene(), "-o", tmp_path / "x.png", *options), *words)
