"""README and manual: their Python runs, their commands have the options they name, claims hold."""

import itertools
import re
import runpy
import shlex
import shutil
import warnings
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import click
import drjit as dr
import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.families import small_model
from _helpers.packed import few_groups
from eigengs_dr.cli.main import main
from eigengs_dr.image.color import to_linear

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(FOLDER.glob("*.md")), *sorted(FOLDER.glob("*/*.md"))]
BLOCK = re.compile(r"^ *```python\n(.*?)^ *```", re.M | re.S)


def run_blocks(page, space, shrink=str):
    """Run the blocks of a page as one program, perhaps made smaller; returns its variables.

    A block of PyTorch is left out where PyTorch is not installed.
    """
    text = page.read_text()
    for found in BLOCK.finditer(text):
        if "import torch" in found[1] and not find_spec("torch"):
            continue
        line = text.count("\n", 0, found.start(1))
        exec(compile("\n" * line + shrink(found[1]), str(page), "exec"), space)
    return space


# --- Pages that are programs ---


@pytest.fixture(scope="module")
def own_loss():
    return run_blocks(FOLDER / "how-to/own-loss.md", {"__name__": "page"})


@pytest.fixture(scope="module")
def own_loop():
    return run_blocks(FOLDER / "how-to/own-loop.md", {"__name__": "page"})


def numbers(tensor):
    return np.array(dr.detach(tensor).numpy(), np.float64)


def test_gaussians_that_a_loop_adds_reduce_its_loss(own_loop):
    before, after = (
        np.mean((eg.render(own_loop[name]).numpy() - own_loop["photo"]) ** 2)
        for name in ("frozen", "larger")
    )
    assert len(own_loop["larger"]) == 400 and after < 0.9 * before


def test_losses_of_the_page_are_of_use(own_loss):
    """Each fit has less of its loss than a fit of the image, or finds what it looks for."""
    photo, loss_of = own_loss["photo"], own_loss["l1_ssim"]

    def plain(count, iterations):
        return eg.fit(photo, count, iterations=iterations, space="rgb")

    def psnr(found, part):
        return eg.psnr(found.image[part].clip(0, 1), photo[part])

    assert own_loss["free"].loss < numbers(loss_of(eg.render(plain(300, 100).gaussians), 0))
    half, middle, image = np.s_[:, :32], np.s_[24:40, 24:40], plain(300, 200)
    assert psnr(own_loss["left"], half) > 1 + psnr(image, half)
    assert psnr(own_loss["sharp"], middle) > 2 + psnr(image, middle)
    assert own_loss["gain"]["second"][0] == pytest.approx(0.6, abs=0.005)
    alpha = own_loss["found"].image["alpha"]
    assert ((alpha > 0.5) == (own_loss["alpha"].numpy() > 0.5)).mean() > 0.99
    assert own_loss["few"].stopped == "met" and own_loss["few"].loss <= 0.04


def test_the_network_of_the_page_fits():
    pytest.importorskip("torch")
    made = run_blocks(FOLDER / "how-to/own-loss.md", {"__name__": "page"})
    rows = made["seen"].trace
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]


def test_the_loops_of_the_page_fit(own_loop):
    """The loop of descents ends where `fit` does; the frozen one gains."""
    photo, start = own_loop["photo"], own_loop["start"]
    as_fit = eg.fit(photo, 300, iterations=100, space="rgb", loss=own_loop["l1"])
    assert own_loop["losses"][-1] == pytest.approx(as_fit.loss, rel=0.01)
    assert sorted(own_loop["losses"], reverse=True) == own_loop["losses"]
    before, after = (eg.psnr(numbers(eg.render(g)), photo) for g in (start, own_loop["frozen"]))
    assert after > before + 2
    assert own_loop["take_step"].n_recordings <= 3
    a, _, c = own_loop["frozen"].factor.numpy()
    assert (a > 0).all() and (c > 0).all()


@pytest.mark.parametrize("name", ["l1_ssim", "masked", "foveated"])
def test_a_loss_of_the_page_has_the_derivative_of_finite_differences(own_loss, own_loop, name):
    values, step = np.random.default_rng(3).uniform(0.2, 0.8, (2, 64, 64, 3))
    Tensor = type(own_loop["exact"])  # in double precision
    for known in ("wanted", "weight", "fovea"):
        own_loss[known] = Tensor(own_loss[known])
    picture = Tensor(values)
    dr.enable_grad(picture)
    dr.backward(own_loss[name](picture, 0))
    up, down = (numbers(own_loss[name](Tensor(values + s * step), 0)).item() for s in (1e-6, -1e-6))
    wanted = (up - down) / 2e-6
    assert (dr.grad(picture).numpy() * step).sum() == pytest.approx(wanted, rel=1e-5)


def test_getting_started_runs_without_a_warning(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    eg.save_image("photo.jpg", eg.sample("coffee")[100:164, 200:264])
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        run_blocks(
            FOLDER / "getting-started.md",
            {"__name__": "page"},
            lambda code: re.sub(r"gaussians=\d+", "gaussians=300", code),
        )
    assert eg.load_image("large.png").shape == (2048, 2048, 3)


# --- A page about photos of a ball ---

GREY = """<texture name="{0}" type="bitmap"><boolean name="raw" value="true"/>
  <string name="filename" value="{1}.pfm"/></texture>"""
FAMILY = """<texture name="base_color" type="gaussian_texture">
  <string name="model" value="cats.npz"/></texture>"""
CAMERA = """<sensor type="perspective"><float name="fov" value="36"/>
  <transform name="to_world">
    <lookat origin="{}, {}, {}" target="0, 0, 0" up="0, 1, 0"/></transform>
  <film type="hdrfilm"><string name="pixel_format" value="rgb"/>
    <integer name="width" value="32"/><integer name="height" value="32"/></film></sensor>"""
BALL = """<scene version="3.0.0">
  <integrator type="prb"><integer name="max_depth" value="2"/></integrator>
  <emitter type="constant"><float name="radiance" value="0.3"/></emitter>
  <shape type="rectangle" id="lamp">
    <transform name="to_world">
      <lookat origin="2, 4, 3" target="0, 0, 0" up="0, 1, 0"/></transform>
    <emitter type="area"><rgb name="radiance" value="12"/></emitter></shape>
  <shape type="sphere" id="ball">
    <transform name="to_world"><rotate x="1" angle="90"/></transform>
    <bsdf type="principled">{color}{roughness}</bsdf></shape>{cameras}</scene>"""


def write_balls(mi, paint):
    """Write scenes of a ball, and photos of one with paint (32, 32, 3)."""
    angles = np.arange(4) * np.pi / 2
    places = np.stack([3.6 * np.sin(angles), 1.2 * np.cos(3 * angles), 3.6 * np.cos(angles)], 1)
    cameras = "".join(CAMERA.format(*place) for place in places)
    for name, pixels in (
        ("paint", paint),
        ("grey", np.full((8, 8, 3), 0.2, np.float32)),
        ("half", np.full((8, 8, 1), 0.5, np.float32)),
    ):
        mi.Bitmap(pixels).write(f"{name}.pfm")
    roughness, base = GREY.format("roughness", "half"), partial(GREY.format, "base_color")
    for name, color in (("known", base("paint")), ("ball", base("grey")), ("family", FAMILY)):
        Path(f"{name}.xml").write_text(
            BALL.format(color=color, roughness=roughness, cameras=cameras)
        )
    text, room = Path("known.xml").read_text(), '<emitter type="envmap" id="room">'
    sky = f'{room}<string name="filename" value="grey.pfm"/></emitter>'
    Path("indoors.xml").write_text(re.sub('<emitter type="constant">.*</emitter>', sky, text))
    scene = mi.load_file("known.xml")
    Path("photos").mkdir()
    for k in range(4):
        mi.Bitmap(mi.render(scene, sensor=k, spp=64, seed=100 + k)).write(f"photos/{k}.pfm")


@pytest.mark.mitsuba
def test_textures_are_recovered_from_photos(tmp_path, monkeypatch):
    mi = pytest.importorskip("mitsuba")
    monkeypatch.chdir(tmp_path)
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    small_model("llvm").save("cats.npz")
    paint = eg.sample("coffee")[100:132, 200:232]
    write_balls(mi, to_linear(paint).astype(np.float32))

    def smaller(code):
        code = code.replace(".exr", ".pfm")  # for which Mitsuba needs no second thread
        code = code.replace("range(8)", "range(4)")
        code = code.replace("240", "80" if "lamp" in code else "40")
        return code.replace("256", "32").replace("160", "24")

    made = run_blocks(FOLDER / "how-to/recover.md", {"__name__": "page"}, smaller)
    assert made["lamp"][made["light"]].numpy() == pytest.approx(12, rel=0.08)
    assert list(made["material"].image) == ["albedo", "roughness"]
    assert eg.Gaussians.load("room.npz").space == "log"
    counts, losses = zip(*made["curve"], strict=True)
    assert [*counts] == [8 * 2**k for k in range(len(counts))]
    assert all(more < less for less, more in itertools.pairwise(losses[:-1]))
    seen = slice(8, 24)  # rows that cameras see from the front
    middle = np.broadcast_to(paint.mean(axis=(0, 1)), paint.shape)
    found = eg.picture_of(eg.Gaussians.load("paint.npz")).clip(0, 1)
    assert eg.psnr(found[seen], paint[seen]) > 3 + eg.psnr(middle[seen], paint[seen])


# --- Other pages, on tiny images ---


TEXTURE = re.compile(r'<texture name="\w+" (type="gaussian_texture">.*?</texture>)', re.S)
COMMAND = re.compile(r"^ *(eigengs-dr [^\n#]*)|`(eigengs-dr \w[^`]*)`", re.M)
"""A command in a block or in a sentence."""
SHELL = re.compile(r"^ *```sh\n(.*?)^ *```", re.M | re.S)
NUMBER = re.compile(r"\b\d[\d_]{3,}\b")

ROOM = """<scene version="3.0.0">
  <integrator type="direct"/>
  <emitter type="constant"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm">
      <integer name="width" value="24"/><integer name="height" value="24"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  </sensor>
  <shape type="rectangle" id="poster"><bsdf type="diffuse">
    <texture name="reflectance" type="bitmap"><string name="filename" value="photo.jpg"/></texture>
  </bsdf></shape>
</scene>"""

RUN_AS_A_WHOLE = (  # above
    "how-to/own-loss.md",
    "how-to/own-loop.md",
    "how-to/recover.md",
    "getting-started.md",
    "extending.md",  # below
)


def is_mitsuba(page):
    text = page.read_text()
    return "mi." in text or "eg.convert_scene" in text or bool(TEXTURE.search(text))


def cases():
    for page in PAGES:
        name = str(page.relative_to(FOLDER if page.is_relative_to(FOLDER) else ROOT))
        if BLOCK.search(page.read_text()) and name not in RUN_AS_A_WHOLE:
            marks = [pytest.mark.mitsuba] if is_mitsuba(page) else []
            yield pytest.param(page, id=name, marks=marks)


def fit_one(file):
    return file


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with the files that pages name, and the images in them."""
    path = tmp_path_factory.mktemp("pages") / "files"
    for folder in ("photos", "states", "coin"):
        (path / folder).mkdir(parents=True)
    image = eg.sample("coffee")[100:124, 200:224]
    images = [np.roll(image, 5 * k, axis=1) for k in range(5)]
    for k, other in enumerate(images):
        eg.save_image(path / f"photos/{k}.png", other)
        eg.save_image(path / f"coin/image{k:02}.png", other)
    lights = [f"image{k:02}.png {k / 5} 0.2 1" for k in range(5)]
    (path / "coin" / "dirs.lp").write_text("\n".join(["5", *lights]))
    for name in ("photo.jpg", "wood.jpg", "huge.tif"):
        eg.save_image(path / name, np.tile(image, (3, 3, 1)) if name == "huge.tif" else image)
    eg.save_image(path / "roughness.png", image[..., :1])
    Image.fromarray(np.uint8(255 * image[..., [0, 1, 2, 0]])).save(path / "leaf.png")
    eg.save_image(path / "sky.exr", 20 * image, encoding="linear")
    light = eg.fit(image, 50, iterations=2, space="linear").gaussians
    for name in ("wood", "lamp", "sky", "photo"):
        light.save(path / f"{name}.npz")
    small_model("llvm").save(path / "cats.npz")
    (path / "room.xml").write_text(ROOM)
    return path, images


@pytest.fixture
def space(files, tmp_path, monkeypatch):
    """A folder with these files, and the variables that pages use."""
    folder, images = files[0], [image.copy() for image in files[1]]
    monkeypatch.chdir(shutil.copytree(folder, tmp_path / "files"))
    image, model = images[0], small_model("llvm")
    result = eg.fit(image, 50, iterations=2)
    n = np.full((24, 24, 3), (0.5, 0.5, 1.0))
    space = {
        "__name__": "__main__",
        "eg": eg,
        "np": np,
        "image": image,
        "images": images,
        "frames": images[:2],
        "array": np.tile(image, (3, 3, 1)),
    }
    space |= {"a": image, "r": image[..., :1], "n": n, "model": model, "result": result}
    space |= {
        "h": image[..., 1:2],
        "gaussians": result.gaussians,
        "files": ["a", "b"],
        "fit_one": fit_one,
        "few_steps": few_steps,
    }
    return space


def few_steps(fit):
    return partial(fit, iterations=40)


def small(code):
    """Shrink numbers of Gaussians, pixels, steps and workers to a tiny image's, without a GPU."""
    code = code.replace("n_workers=4", "n_workers=1, processes=False").replace(
        ".Pool(4)", ".Pool(1)"
    )
    code = code.replace('"cuda"', '"llvm"')
    code = re.sub(r"\beg\.(fit|fit_large)\(", r"few_steps(eg.\1)(", code)
    return NUMBER.sub(lambda found: str(min(200, int(found[0].replace("_", "")) // 50)), code)


@pytest.mark.parametrize("page", list(cases()))
@few_groups()
def test_python_of_a_page_runs(page, space):
    if is_mitsuba(page):
        mi = pytest.importorskip("mitsuba")
        mi.set_variant("llvm_ad_rgb")
        eg.register_plugins()
        from eigengs_dr.plugins import texture_of

        space |= {"mi": mi, "texture_of": texture_of}
    run_blocks(page, space, small)
    for texture in TEXTURE.findall(page.read_text()):
        mi.load_string(f'<texture version="3.0.0" {texture}')


def test_parts_of_ones_own_fit(space):
    """Each part of a method on the page takes steps that gain, or places as well."""
    made = run_blocks(FOLDER / "extending.md", space, small)
    for name in ("placed", "signs", "colored", "calm"):
        found = made[name]
        assert len(found.gaussians) == 200 and np.isfinite(found.image).all()
        assert found.psnr_ycbcr > found.trace[0]["psnr_ycbcr"] + 1, name
    assert made["colored"].psnr_ycbcr > eg.fit(made["image"], 200, 0).psnr_ycbcr + 1
    assert [row.status for row in made["rows"]] == ["done", "done"]


TEXTS = {str(page.relative_to(ROOT)): page.read_text() for page in PAGES}
TEXTS |= {f"{name} --help": command.help or "" for name, command in main.commands.items()}


@pytest.mark.parametrize("name", TEXTS)
def test_commands_of_a_page_exist(name):
    """They have the options that they name, and these the values that they need."""
    for found in COMMAND.finditer(TEXTS[name]):
        line = " ".join((found[1] or found[2]).split(" && ")[-1].split())
        words = shlex.split(line.rstrip("\\&").replace("...", ""))[1:]
        command, context = main, click.Context(main)
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            command = command.get_command(context, words.pop(0))
            assert command, line
        context = click.Context(command, ignore_unknown_options=False)
        try:
            command.make_parser(context).parse_args(words)
        except click.UsageError as error:
            pytest.fail(f"{line}: {error.format_message()}")


@pytest.mark.parametrize("name", [name for name, text in TEXTS.items() if SHELL.search(text)])
def test_other_programs_of_a_page_find_what_they_name(name):
    """Extras that pip installs, targets of make, and scripts are there."""
    extras = set(re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), re.M))
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    for line in "".join(SHELL.findall(TEXTS[name])).splitlines():
        first, *words = shlex.split(line, comments=True) or [""]
        if first == "pip":
            named = re.findall(r"[\[,](\w+)", " ".join(words))
            assert words[0] == "install" and set(named) <= extras, line
            assert "./benchmarks" in words or [word for word in words if word[0] == "."], line
        elif first == "make":
            assert set(words) <= targets, line
        elif first.startswith("python"):
            assert (ROOT / words[0]).is_file(), line


# --- Claims ---


def test_getting_started_lists_all_extras():
    text = (FOLDER / "getting-started.md").read_text()
    said = set(re.findall(r"^\| `(\w+)` \|", text, re.M))
    extras = (ROOT / "pyproject.toml").read_text()
    extras = extras.split("[project.optional-dependencies]")[1].split("\n[")[0]
    assert set(re.findall(r"^(\w+) = \[", extras, re.M)) == said


@pytest.fixture(scope="module")
def check():
    return runpy.run_path(str(ROOT / "tools" / "manual" / "check_pages.py"))


def test_names_are_where_the_manual_says(check):
    assert check["missing"]() == []
    assert check["exists"]("eigengs_dr.fitting.placement.adaptive.target_density")
    assert not check["exists"]("eigengs_dr.fitting.placement.adaptive.Canvas")
    assert not check["exists"]("eigengs_dr.fitting.placement.adaptive.nothing")


def test_the_folders_are_those_of_the_layers():
    """Write them anew by ``python tools/manual/folders.py``."""
    assert runpy.run_path(str(ROOT / "tools" / "manual" / "folders.py"))["outdated"]() == {}


def test_figures_of_the_manual_can_be_traced(check):
    assert check["untraced"]() == []


@pytest.mark.parametrize(
    ("text", "traced"),
    [
        ("it takes 3.5 s", False),
        ("it gains 0.1 to\n0.2 dB", False),
        ("| a | b |\n|---|---:|\n| x | 2 |", False),
        ("it takes `3.5 s`, and is 5.3 times closer", False),
        ("it is 5.3 times closer", False),
        ("it takes 3.5 s. That is of commit 0a1b2c3.", False),
        ("it takes 3.5 s (2 photos,\ncommit 0a1b2c3). It is set.", True),
        ("it takes <!-- figure: kernels.fast -->3.5 ms<!-- end -->, and $6$ dB", True),
        ("it takes 4 GB <!-- setting --> of memory", True),
        ("<!-- table: a.b -->\n\n| a | b |\n|---|---:|\n| x | 2 |\n\n<!-- end -->", True),
        ("```sh\nfit photo.jpg  # 36 dB\n```\n16 bits, 3 x 3 pixels, 24 photos, min(k, 2)", True),
    ],
)
def test_what_a_traced_figure_is(check, text, traced):
    assert (check["untraced_in"](text) == []) == traced


def test_links_of_pages_work_in_a_checkout(check):
    assert check["broken"]() == []


def test_files_of_the_architecture_exist():
    """Folders and files on the page and in its drawing lie in the package, or beside it."""
    texts = (ROOT / "CONTRIBUTING.md", FOLDER / "images/architecture.svg")
    paths = re.findall(r"[`>]([a-z_]+/[\w/]*(?:\.py)?)[`<]", "".join(t.read_text() for t in texts))
    tops = (ROOT / "eigengs_dr", ROOT)
    assert len(paths) > 50
    assert not [path for path in paths if not any((top / path).exists() for top in tops)]


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_pages_and_charts_have_what_their_rows_give(drawn):
    """To draw a chart takes half a second, so tables, figures and names of charts go first."""
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    from eigengs_bench import pages
    from eigengs_bench.rows import read

    draw = pages.chart_file if drawn else lambda figure: b""
    assert {path for path in pages.outdated(ROOT, draw) if drawn or path.suffix == ".md"} == set()
    shown = "".join(page.read_text() for page in pages.pages_of(ROOT))
    once = {f"table: once.{row['job']['table']} -->" for row in read(ROOT / pages.ROWS, "once")}
    assert not [mark for mark in once if mark not in shown]
    charts = sorted((ROOT / pages.CHARTS).iterdir())
    assert {chart.stem for chart in charts} == {*pages.CHART.findall(shown)}
    assert max(chart.stat().st_size for chart in charts) < 60_000


def test_a_page_and_a_chart_that_differ_from_their_rows_are_written_anew(tmp_path):
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    from eigengs_bench import pages
    from eigengs_bench.rows import read, record

    (tmp_path / "docs").mkdir()
    rows = [row for row in read(ROOT / pages.ROWS) if row["bench"] == "stability"]
    record(tmp_path / pages.ROWS, rows)
    page, chart = tmp_path / "docs/results.md", tmp_path / pages.CHARTS / "stability.svg"
    tables = ("stability.ends", "all.runs")
    marks = "".join(f"<!-- table: {name} -->\n<!-- end -->\n" for name in tables)
    page.write_text(f"{marks}![cases](images/measured/stability.svg)\n")
    (tmp_path / "README.md").write_text("A page without a mark.\n")
    assert pages.write(tmp_path) == [page, chart]
    right = page.read_text(), chart.read_bytes()
    assert " (`bench stability`).*" in right[0]
    assert f"commit {rows[0]['run']['commit'][:9]}: `bench stability`\n" in right[0]
    page.write_text(re.sub(r"(\| *)(\d)", r"\g<1>1\2", right[0], count=1))
    chart.unlink()
    assert pages.write(tmp_path) == [page, chart]
    assert (page.read_text(), chart.read_bytes()) == right
    page.write_text("<!-- table: stability.none -->\n<!-- end -->")
    with pytest.raises(ValueError, match=r"results\.md: no row holds the table: stability\.none"):
        pages.outdated(tmp_path)


@pytest.mark.mitsuba
def test_the_reference_is_what_the_code_says():
    """Public names, commands, and the parameters of plugins; ``make pages`` writes them anew."""
    pytest.importorskip("mitsuba")
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    pages = runpy.run_path(str(ROOT / "tools" / "manual" / "pages.py"))
    assert pages["outdated"]() == {}


def test_readme_fits_a_screen():
    lines = (ROOT / "README.md").read_text().splitlines()
    first = [line for line in lines if line.startswith("!")]
    assert len(lines) <= 100 and "kodak-speed.svg" in first[1]
    assert (FOLDER / "images/teaser.jpg").stat().st_size < 150_000


def test_no_page_needs_a_build_to_be_read():
    """Nothing is filled in by Sphinx alone: no substitutions, roles, or pictures in directives."""
    for page in PAGES:
        text = re.sub(r"<!-- manual:.*?-->", "", page.read_text(), flags=re.S)
        assert not re.search(
            r"\{\{|\{[\w:]+\}`|```\{(image|figure|raw)|^:::|^\(\w+\)=", text, re.M
        ), page
