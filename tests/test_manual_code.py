"""The Python of README and manual runs, on tiny images; its commands have the options they name."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.families import small_model
from eigengs_dr.cli.main import main
from eigengs_dr.fitting.options import PRESETS, Preset
from eigengs_dr.fitting.schedule import Schedule

ROOT = Path(__file__).parent.parent
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs").glob("*/*.md")),
]
BLOCK = re.compile(r"^ *```python\n(.*?)^ *```", re.M | re.S)
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

RUN_AS_A_WHOLE = ("how-to/own-loop.md", "getting-started.md")  # in test_manual.py


def is_mitsuba(page):
    return "mi." in page.read_text() or bool(TEXTURE.search(page.read_text()))


def cases():
    for page in PAGES:
        name = str(page.relative_to(ROOT / "docs" if "docs" in page.parts else ROOT))
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
    space |= {"gaussians": result.gaussians, "files": ["a", "b"], "fit_one": fit_one}
    return space | {"PRESETS": dict(PRESETS), "Preset": Preset, "Schedule": Schedule}


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
    text = page.read_text()
    for found in BLOCK.finditer(text):
        line = text.count("\n", 0, found.start(1))
        exec(compile("\n" * line + small(found[1]), str(page), "exec"), space)
    for texture in TEXTURE.findall(text):
        mi.load_string(f'<texture version="3.0.0" {texture}')


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
