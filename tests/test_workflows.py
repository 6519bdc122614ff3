"""The workflows run what is there: targets of the Makefile, and actions of one known commit."""

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
FILES = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
PINNED = re.compile(r"uses: [\w-]+/[\w-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+")
PUBLISH = [("manual", "publish"), ("publish", "publish")]
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]


def jobs(file):
    """The jobs of a workflow, by name."""
    return yaml.safe_load(file.read_text())["jobs"]


def steps(file):
    """The steps of all jobs of a workflow."""
    return [step for job in jobs(file).values() for step in job["steps"]]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_steps(file):
    for step in steps(file):
        assert ("run" in step) != ("uses" in step)
        for target in re.findall(r"\bmake ([a-z-]+)", step.get("run", "")):
            assert target in TARGETS
    lines = [line for line in file.read_text().splitlines() if "uses:" in line]
    assert lines and all(PINNED.search(line) for line in lines)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_rights(file):
    """A workflow reads the code; only jobs that publish, the manual or a release, may do more."""
    assert yaml.safe_load(file.read_text())["permissions"] == {"contents": "read"}
    for name, job in jobs(file).items():
        assert "permissions" not in job or (file.stem, name) in PUBLISH


def test_what_is_run():
    run = {file.stem: [step["run"] for step in steps(file) if "run" in step] for file in FILES}
    assert set(run) == {"test", "nightly", "manual", "package", "publish"}
    for name, target in (
        ("test", "test"),
        ("nightly", "test-slow"),
        ("manual", "docs"),
        ("package", "dist"),
        ("publish", "dist"),
    ):
        assert f"make {target} PYTHON=python" in run[name]
    made = jobs(ROOT / ".github" / "workflows" / "test.yml")
    assert made["linux"]["strategy"]["matrix"]["python"] == PYTHONS
    settings = [step.get("with", {}) for step in made["oldest"]["steps"]]
    [oldest] = [one["python-version"] for one in settings if "python-version" in one]
    metadata = (ROOT / "pyproject.toml").read_text()
    assert f'requires-python = ">={oldest}"' in metadata
    assert re.findall(r'"Programming Language :: Python :: (3\.\d+)"', metadata) == PYTHONS
