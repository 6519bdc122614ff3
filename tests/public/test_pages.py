"""What README and the manual print runs for a reader who has photo.jpg, in the order of a page."""

import os
import re
import shlex
import subprocess
import sys
import warnings
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.command import said

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs"
PAGES = [
    ROOT / "README.md",
    *(FOLDER / f"{name}.md" for name in ("getting-started", "questions", "extending")),
    *sorted(FOLDER.glob("how-to/*.md")),
]
BLOCK = re.compile(r"^ *```(python|sh)\n(.*?)^ *```", re.M | re.S)
COMMAND = re.compile(r"^ *(?:.*&& )?(eigengs-dr [^\n#]*)|`(eigengs-dr \w[^`]*)`", re.M)
"""A command in a block or in a sentence."""
TEXTURE = re.compile(r'<texture name="\w+" (type="gaussian_texture">.*?</texture>)', re.S)

ELSEWHERE = {
    r"^(pip|apt|dnf|brew|winget) ": "it installs something",
    r"^(make|python3 -m venv) ": "it is for a clone of the repository",
    r"tcp://": "it needs a scheduler on another machine",
    r"^#!/bin/bash": "it is a job of Slurm",
    r"--gpu": "it needs a GPU",
}
"""What no test runs, and why."""

SMALLER = [
    (
        r"\b\d[\d_]{3,}\b",
        lambda number: str(min(200, max(40, int(number[0].replace("_", "")) // 50))),
    ),
    (r"\b256\b", "32"),
    (r"\b(240|300)\b", "40"),
    (r"(local:|n_workers=|Pool\()4", r"\g<1>1"),
]
"""Fewer Gaussians (5,000 become 100), pixels, components, steps and processes."""


def small(text):
    for pattern, replacement in SMALLER:
        text = re.sub(pattern, replacement, text)
    return text


def name_of(page):
    return str(page.relative_to(ROOT))


@cache
def blocks_of(page):
    """The blocks of a page: their language, text, and the line of the page that they begin in."""
    text = page.read_text()
    return [(b[1], b[2], text.count("\n", 0, b.start(2)) + 1) for b in BLOCK.finditer(text)]


def commands_of(text, line):
    """The commands of a block of a shell, and the lines that they begin in."""
    if text.startswith("#!"):
        return [(text, line)]
    parts = re.finditer(r"^(?:.*\\\n)*.*\n", text, re.M)
    return [(part[0].strip(), line + text.count("\n", 0, part.start())) for part in parts]


def run_python(page, text, line, space):
    exec(compile("\n" * (line - 1) + text, name_of(page), "exec"), space)


def run_command(page, command, line):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "BROWSER": "true"}
    process = subprocess.run(
        command, shell=True, env=environment, capture_output=True, text=True, check=False
    )
    if process.returncode:
        pytest.fail(f"{name_of(page)}:{line}: {command}\n{process.stderr}", pytrace=False)


def pages_that_run():
    for page in PAGES:
        text = "".join(text for _, text, _ in blocks_of(page))
        marks = [pytest.mark.mitsuba] * ("mitsuba" in text) + [pytest.mark.exr] * (".exr" in text)
        if text:
            yield pytest.param(page, id=name_of(page), marks=marks)


def run_blocks(page, space, shrink=str):
    """Run the blocks of a page in order; the texts of PyTorch only where it is installed."""
    for language, text, line in blocks_of(page):
        if language == "python":
            if "import torch" not in text or find_spec("torch"):
                run_python(page, shrink(text), line, space)
            continue
        for command, place in commands_of(text, line):
            if not any(re.search(pattern, command) for pattern in ELSEWHERE):
                run_command(page, shrink(command), place)
    return space


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("page", list(pages_that_run()))
def test_a_page_runs_from_its_first_block_to_its_last(page, tmp_path, monkeypatch):
    """No page needs another file than photo.jpg, and the first two that people read do not warn."""
    monkeypatch.chdir(tmp_path)
    eg.save_image("photo.jpg", eg.sample("coffee")[100:164, 200:296])
    with warnings.catch_warnings():
        if page.stem in ("README", "getting-started"):
            warnings.simplefilter("error", UserWarning)
        space = run_blocks(page, {"__name__": "__main__"}, small)
    for texture in TEXTURE.findall(page.read_text()):
        if "mi" in space:
            space["mi"].load_string(f'<texture version="3.0.0" {texture}')


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_of_a_page_compiles(page):
    for language, text, line in blocks_of(page):
        if language == "python":
            compile("\n" * (line - 1) + text, name_of(page), "exec")


ALL_PAGES = [ROOT / "README.md", *sorted(FOLDER.glob("*.md")), *sorted(FOLDER.glob("*/*.md"))]


@cache
def help_of(*command):
    return said(*command, "--help")


def commands_in(text):
    """The commands that a help lists."""
    return re.findall(r"^  ([a-z][\w-]*) ", text.partition("Commands:")[2], re.M)


@pytest.mark.parametrize("page", [*ALL_PAGES, "help"], ids=str)
def test_commands_of_a_page_have_the_options_that_they_name(page):
    texts = [help_of(name) for name in commands_in(help_of())]
    text = "\n".join(texts) if page == "help" else page.read_text()
    for match in COMMAND.finditer(text):
        line = " ".join((match[1] or match[2]).split())
        words = shlex.split(line.rstrip("\\&").replace("...", ""))[1:]
        command = ()
        while commands_in(help_of(*command)) and words and not words[0].startswith("-"):
            assert words[0] in commands_in(help_of(*command)), line
            command = (*command, words.pop(0))
        options = set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", help_of(*command)))
        assert {
            word.partition("=")[0] for word in words if re.match("--?[a-z]", word)
        } <= options, line


def test_other_programs_of_pages_find_what_they_name():
    """Extras that pip installs, targets of make, and scripts are there."""
    extras = set(re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), re.M))
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    shells = [
        text
        for page in [*ALL_PAGES, ROOT / "CONTRIBUTING.md"]
        for language, text, _ in blocks_of(page)
        if language == "sh"
    ]
    for line in "".join(shells).splitlines():
        first, *words = shlex.split(line, comments=True) or [""]
        if first == "pip":
            named = re.findall(r"[\[,](\w+)", " ".join(words))
            assert words[0] == "install" and set(named) <= extras, line
            assert "./benchmarks" in words or [word for word in words if word[0] == "."], line
        elif first == "make":
            assert set(words) <= targets, line
        elif first.startswith("python") and words[0] != "-m":
            assert (ROOT / words[0]).is_file(), line


# --- What the losses and loops of two pages reach ---


@pytest.fixture(scope="module")
def own_loss():
    return run_blocks(FOLDER / "how-to/own-loss.md", {"__name__": "page"})


@pytest.fixture(scope="module")
def own_loop():
    return run_blocks(FOLDER / "how-to/own-loop.md", {"__name__": "page"})


def numbers(tensor):
    return np.array(dr.detach(tensor).numpy(), np.float64)


@pytest.mark.slow
def test_gaussians_that_a_loop_adds_reduce_its_loss(own_loop):
    before, after = (
        np.mean((eg.render(own_loop[name]).numpy() - own_loop["photo"]) ** 2)
        for name in ("frozen", "larger")
    )
    assert len(own_loop["larger"]) == 400 and after < 0.9 * before


@pytest.mark.slow
def test_losses_of_the_page_are_of_use(own_loss):
    """Each fit has less of its loss than a fit of the image, or finds what it looks for."""
    photo, loss_of = own_loss["photo"], own_loss["l1_ssim"]

    def plain(count, iterations):
        return eg.fit(photo, count, iterations=iterations, space="rgb")

    def psnr(fit, part):
        return eg.psnr(fit.image[part].clip(0, 1), photo[part])

    assert own_loss["free"].loss < numbers(loss_of(eg.render(plain(300, 100).gaussians), 0))
    half, middle, image = np.s_[:, :32], np.s_[24:40, 24:40], plain(300, 200)
    assert psnr(own_loss["left"], half) > 1 + psnr(image, half)
    assert psnr(own_loss["sharp"], middle) > 2 + psnr(image, middle)
    assert own_loss["gain"]["second"][0] == pytest.approx(0.6, abs=0.005)
    alpha = own_loss["found"].image["alpha"]
    assert ((alpha > 0.5) == (own_loss["alpha"].numpy() > 0.5)).mean() > 0.99
    assert own_loss["few"].stopped == "met" and own_loss["few"].loss <= 0.04


@pytest.mark.slow
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


@pytest.mark.slow
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
