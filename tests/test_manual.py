"""README and manual: their Python runs, their commands have the options they name, claims hold."""

import re
import runpy
import shlex
import warnings
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from PIL import Image

import eigengs_dr as eg
from _helpers.families import small_model
from eigengs_dr.cli.main import main

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(FOLDER.glob("*.md")), *sorted(FOLDER.glob("*/*.md"))]
BLOCK = re.compile(r"^ *```python\n(.*?)^ *```", re.M | re.S)


def run_blocks(page, space, shrink=str):
    """Run the blocks of a page as one program, perhaps made smaller; returns its variables."""
    text = page.read_text()
    for found in BLOCK.finditer(text):
        line = text.count("\n", 0, found.start(1))
        exec(compile("\n" * line + shrink(found[1]), str(page), "exec"), space)
    return space


# --- Pages that are programs ---


@pytest.fixture(scope="module")
def own_loop():
    return run_blocks(FOLDER / "how-to/own-loop.md", {"__name__": "page"})


def numbers(tensor):
    return np.array(dr.detach(tensor).numpy(), np.float64)


def test_the_loops_of_the_page_fit(own_loop):
    """The frozen loop takes the steps of the plain one, but for the lists of five steps."""
    image = own_loop["image"]
    before, plain, frozen = (
        eg.psnr(numbers(eg.render(own_loop[name])), image) for name in ("start", "found", "frozen")
    )
    assert plain > before + 2
    assert abs(plain - frozen) < 0.1
    assert own_loop["take_step"].n_recordings <= 3
    a, _, c = own_loop["found"].factor.numpy()
    assert (a > 0).all() and (c > 0).all()


def test_the_loss_of_the_page_has_the_derivative_of_finite_differences(own_loop):
    found, image, step = np.random.default_rng(3).uniform(0.2, 0.8, (3, 24, 24, 3))
    Tensor = type(own_loop["exact"])  # in double precision
    picture = Tensor(found)
    dr.enable_grad(picture)
    dr.backward(own_loop["loss_of"](picture, Tensor(image)))
    up, down = (
        own_loop["loss_of"](Tensor(found + s * step), Tensor(image)).array[0] for s in (1e-6, -1e-6)
    )
    wanted = (up - down) / 2e-6
    assert (dr.grad(picture).numpy() * step).sum() == pytest.approx(wanted, rel=1e-5)


def test_the_traced_loop_of_the_page_is_a_sum_with_derivatives(own_loop):
    g = dr.detach(own_loop["double"])
    Float = dr.leaf_t(g.mean)
    at = [np.array([10.5, 30.5]), np.array([20.5, 40.5])]
    x, y = map(Float, at)
    dr.enable_grad(g.mean)
    found = own_loop["brightness"](g, x, y, len(g))
    dr.backward(dr.sum(found))

    def total(mean):
        (a, b, c), (dx, dy) = g.factor.numpy()[..., None], np.array(at)[:, None] - mean[..., None]
        return np.exp(-0.5 * ((a * dx + b * dy) ** 2 + (c * dy) ** 2)).sum(0)

    mean = dr.detach(g.mean).numpy()
    np.testing.assert_allclose(found.numpy(), total(mean), rtol=1e-9)
    step = np.random.default_rng(1).normal(size=mean.shape)
    wanted = (total(mean + 1e-6 * step) - total(mean - 1e-6 * step)).sum() / 2e-6
    assert (dr.grad(g.mean).numpy() * step).sum() == pytest.approx(wanted, rel=1e-5)


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


# --- Other pages, on tiny images ---


TEXTURE = re.compile(r'<texture name="\w+" (type="gaussian_texture">.*?</texture>)', re.S)
COMMAND = re.compile(r"^ *((?:.*&& )?eigengs-dr [^\n#]*)", re.M)
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

RUN_AS_A_WHOLE = ("how-to/own-loop.md", "getting-started.md")  # above


def is_mitsuba(page):
    text = page.read_text()
    return "mi." in text or "eg.convert_scene" in text or bool(TEXTURE.search(text))


def cases():
    for page in PAGES:
        name = str(page.relative_to(FOLDER if "docs" in page.parts else ROOT))
        if BLOCK.search(page.read_text()) and name not in RUN_AS_A_WHOLE:
            marks = [pytest.mark.mitsuba] if is_mitsuba(page) else []
            yield pytest.param(page, id=name, marks=marks)


def fit_one(file):
    return file


@pytest.fixture
def space(tmp_path, monkeypatch):
    """A folder with the files that pages name, and the variables that they use."""
    monkeypatch.chdir(tmp_path)
    image = eg.sample("coffee")[100:124, 200:224]
    images = [np.roll(image, 5 * k, axis=1) for k in range(5)]
    for folder in ("photos", "states"):
        (tmp_path / folder).mkdir()
    for k, other in enumerate(images):
        eg.save_image(f"photos/{k}.png", other)
    for name in ("photo.jpg", "wood.jpg", "huge.tif"):
        eg.save_image(name, np.tile(image, (3, 3, 1)) if name == "huge.tif" else image)
    eg.save_image("roughness.png", image[..., :1])
    Image.fromarray(np.uint8(255 * image[..., [0, 1, 2, 0]])).save("leaf.png")
    eg.save_image("sky.exr", 20 * image, encoding="linear")
    result = eg.fit(image, 50, iterations=2)
    light = eg.fit(image, 50, iterations=2, space="linear").gaussians
    for name in ("wood", "lamp", "sky", "photo"):
        light.save(f"{name}.npz")
    model = small_model("llvm")
    model.save("cats.npz")
    (tmp_path / "room.xml").write_text(ROOM)
    n = np.full((24, 24, 3), (0.5, 0.5, 1.0))
    space = {
        "__name__": "__main__",
        "eg": eg,
        "np": np,
        "image": image,
        "images": images,
        "array": np.tile(image, (3, 3, 1)),
    }
    space |= {"a": image, "r": image[..., :1], "n": n, "model": model, "result": result}
    space |= {
        "h": image[..., 1:2],
        "gaussians": result.gaussians,
        "files": ["a", "b"],
        "fit_one": fit_one,
    }
    return space


def small(code):
    """Shrink numbers of Gaussians, pixels and workers to what a tiny image takes, without a GPU."""
    code = code.replace("n_workers=4", "n_workers=1").replace(".Pool(4)", ".Pool(1)")
    code = code.replace('"cuda"', '"llvm"')
    return NUMBER.sub(lambda found: str(min(200, int(found[0].replace("_", "")) // 50)), code)


@pytest.mark.parametrize("page", list(cases()))
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
    for found in COMMAND.finditer(TEXTS[name]):
        _, verb, *words = shlex.split(found[1].split("&& ")[-1].rstrip(" \\&"))
        command = main.get_command(None, verb) if not verb.startswith("-") else main
        if verb == "bench" and words and not words[0].startswith("-"):
            command = command.get_command(None, words[0])
        assert command, found[1]
        known = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        for word in words:
            if re.match(r"--?[a-zA-Z]", word):
                assert word in known, found[1]


# --- Claims ---


def test_getting_started_lists_all_extras():
    text = (FOLDER / "getting-started.md").read_text()
    said = set(re.findall(r"^\| `(\w+)` \|", text, re.M))
    extras = (ROOT / "pyproject.toml").read_text()
    extras = extras.split("[project.optional-dependencies]")[1].split("\n[")[0]
    assert set(re.findall(r"^(\w+) = \[", extras, re.M)) == said


@pytest.fixture(scope="module")
def check():
    return runpy.run_path(str(FOLDER / "check_pages.py"))


def test_names_are_where_the_manual_says(check):
    assert check["missing"]() == []
    assert check["exists"]("eigengs_dr.fitting.placement.density.target_density")
    assert not check["exists"]("eigengs_dr.fitting.placement.adaptive.target_density")
    assert not check["exists"]("eigengs_dr.fitting.placement.adaptive.nothing")


def test_figures_of_the_manual_can_be_traced(check):
    assert check["untraced"]() == []


@pytest.mark.parametrize(
    ("text", "traced"),
    [
        ("it takes 3.5 s", False),
        ("it gains 0.1 to\n0.2 dB", False),
        ("| a | b |\n|---|---:|\n| x | 2 |", False),
        ("it takes {measured}`3.5 s`", False),
        ("it takes {measured}`3.5 s (2 photos, commit 0a1b2c3)`", True),
        ("it takes {{ kernels.fast_ms|round(1) }} ms, as `36 dB` and $6$ dB are set", True),
        ("```sh\nfit photo.jpg  # 36 dB\n```\n16 bits, 3 x 3 pixels, 24 photos, min(k, 2)", True),
    ],
)
def test_what_a_traced_figure_is(check, text, traced):
    assert (check["untraced_in"](text) == []) == traced


def test_figures_of_the_readme_are_of_rows():
    pytest.importorskip("eigengs_bench", reason="pip install ./benchmarks")
    from eigengs_bench import kodak, rows

    [table] = kodak.summarize(rows.read(FOLDER / "rows.jsonl", "kodak")).tables
    figures = re.findall(r"(\d+\.\d+) dB \|", (ROOT / "README.md").read_text())
    assert figures and set(figures) <= set(table.frame["PSNR, float"])
