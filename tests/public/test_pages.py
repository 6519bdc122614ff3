"""What README and the manual print: programs that run, in the order of a page, and commands."""

import os
import re
import shlex
import subprocess
import sys
import warnings
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest

import eigengs_dr as eg
from _helpers.command import said
from _helpers.pages import FOLDER, PAGES, ROOT, blocks_of, name_of

RUN = [
    ROOT / "README.md",
    *(FOLDER / f"{name}.md" for name in ("getting-started", "questions", "extending")),
    *sorted(FOLDER.glob("how-to/*.md")),
]
COMMAND = re.compile(r"^ *(?:.*&& )?(eigengs-dr [^\n#]*)|`(eigengs-dr \w[^`]*)`", re.M)
"""A command in a block or in a sentence."""
TEXTURE = re.compile(r'<texture name="\w+" (type="gaussian_texture">.*?</texture>)', re.S)

ELSEWHERE = {
    r"^(pip|apt|dnf|brew|winget) ": "it installs something",
    r"^(make|python3 -m venv) ": "it is for a clone of the repository",
    r"tcp://|https?://": "it needs a scheduler, or files, on another machine",
    r"^#!/bin/bash": "it is a job of Slurm",
}
"""What no test runs, and why."""


def fewer(number):
    return str(min(200, max(40, int(number[0].replace("_", "")) // 50)))


SMALLER = [
    (r"\b\d[\d_]{3,}\b", fewer),
    (r"\b256\b", "32"),
    (r"\b(240|300)\b", "40"),
    (r"(local:|n_workers=|Pool\()4", r"\g<1>1"),
]
"""Fewer Gaussians (5,000 become 100), pixels, components, steps and processes."""


def small(text):
    for pattern, replacement in SMALLER:
        text = re.sub(pattern, replacement, text)
    return text


def commands_of(text, line):
    """The commands of a block of a shell, and the lines that they begin in."""
    if text.startswith("#!"):
        return [(text, line)]
    parts = re.finditer(r"^(?:.*\\\n)*.*\n", text, re.M)
    return [(part[0].strip(), line + text.count("\n", 0, part.start())) for part in parts]


def run_command(page, command, line):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "BROWSER": "true"}
    process = subprocess.run(
        command, shell=True, env=environment, capture_output=True, text=True, check=False
    )
    if process.returncode:
        pytest.fail(f"{name_of(page)}:{line}: {command}\n{process.stderr}", pytrace=False)


def pages_that_run():
    for page in RUN:
        text = "".join(text for _, text, _ in blocks_of(page))
        marks = [pytest.mark.mitsuba] * ("mitsuba" in text) + [pytest.mark.exr] * (".exr" in text)
        if text:
            yield pytest.param(page, id=name_of(page), marks=marks)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("page", list(pages_that_run()))
def test_a_page_runs_from_its_first_block_to_its_last(page, tmp_path, monkeypatch):
    """No page needs another file than photo.jpg, and the first two that people read do not warn.

    What needs PyTorch runs only where it is installed.
    """
    monkeypatch.chdir(tmp_path)
    eg.save_image("photo.jpg", eg.sample("coffee")[100:164, 200:296])
    space = {"__name__": "__main__"}
    with warnings.catch_warnings():
        if page.stem in ("README", "getting-started"):
            warnings.simplefilter("error", UserWarning)
        for language, text, line in blocks_of(page):
            if language == "sh":
                for command, place in commands_of(text, line):
                    if not any(re.search(pattern, command) for pattern in ELSEWHERE):
                        run_command(page, small(command), place)
            elif "import torch" not in text or find_spec("torch"):
                exec(compile("\n" * (line - 1) + small(text), name_of(page), "exec"), space)
    for texture in TEXTURE.findall(page.read_text()):
        if "mi" in space:
            space["mi"].load_string(f'<texture version="3.0.0" {texture}')


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_of_a_page_compiles(page):
    for language, text, line in blocks_of(page):
        if language == "python":
            compile("\n" * (line - 1) + text, name_of(page), "exec")


@cache
def help_of(*command):
    return said(*command, "--help")


def commands_in(text):
    """The commands that a help lists."""
    return re.findall(r"^  ([a-z][\w-]*) ", text.partition("Commands:")[2], re.M)


@pytest.mark.parametrize("page", [*PAGES, "help"], ids=str)
def test_commands_of_a_page_have_the_options_that_they_name(page):
    texts = [help_of(name) for name in commands_in(help_of())]
    text = "\n".join(texts) if page == "help" else page.read_text()
    for match in COMMAND.finditer(text):
        line = re.sub(r"<\(.*?\)", "FILE", " ".join((match[1] or match[2]).split()))
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
    """Extras of pip stand in the table of getting-started, and targets of make in the Makefile."""
    settings = (ROOT / "pyproject.toml").read_text()
    extras = settings.split("[project.optional-dependencies]")[1].split("\n[")[0]
    table = re.findall(r"^\| `(\w+)` \|", (FOLDER / "getting-started.md").read_text(), re.M)
    assert sorted(re.findall(r"^(\w+) = \[", extras, re.M)) == sorted(table)
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    text = "".join(page.read_text() for page in [*PAGES, ROOT / "CONTRIBUTING.md"])
    assert set(re.findall(r"(?:^ *|`)make ([\w-]+)", text, re.M)) <= targets
    scripts = re.findall(r"^ *(?:\S*/)?python3? ([\w/]+\.py)", text, re.M)
    assert all((ROOT / script).is_file() for script in scripts)
