"""What type checkers and editors see of the package: the programs of the manual pass mypy."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(FOLDER.glob("*.md")), *sorted(FOLDER.glob("*/*.md"))]
BLOCK = re.compile(r"^ *```python\n(.*?)^ *```", re.M | re.S)

SETTINGS = """
[mypy]
strict = true
untyped_calls_exclude = distributed, drjit, mitsuba
[mypy-scipy.*,torch.*]
ignore_missing_imports = true
"""
"""These packages come without types, or with few."""


def program_of(page):
    """The blocks of a page as one program."""
    return "\n".join(BLOCK.findall(page.read_text()))


def errors_of_mypy(folder, installed, files):
    """What mypy says of files in a folder, where the package lies in the folder `installed`."""
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(folder / "cache"), *files]
    process = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert process.returncode in (0, 1), process.stderr
    return process.stdout if process.returncode else ""


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.mitsuba
def test_programs_of_the_manual_are_typed(tmp_path):
    """In strict mode, against the files of an installed wheel and against the checkout."""
    pytest.importorskip("mypy", reason="pip install mypy")
    pytest.importorskip("mitsuba")
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    files = []
    for page in PAGES:
        if BLOCK.search(page.read_text()):
            path = page.relative_to(ROOT).with_suffix(".py")
            files.append(re.sub(r"[-/]", "_", path.as_posix()))
            (tmp_path / files[-1]).write_text(program_of(page))
    assert len(files) > 20
    hidden = shutil.ignore_patterns(".*", "build", "dist", "*.egg-info")
    source = shutil.copytree(ROOT, tmp_path / "source", ignore=hidden)
    build = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(tmp_path)]
    subprocess.run([sys.executable, "-m", "pip", *build, str(source)], check=True)
    shutil.unpack_archive(next(tmp_path.glob("*.whl")), tmp_path / "installed", "zip")
    assert errors_of_mypy(tmp_path, tmp_path / "installed", files) == ""
    assert errors_of_mypy(tmp_path, ROOT, files) == ""


def test_an_editor_completes_the_public_names_with_their_signatures():
    jedi = pytest.importorskip("jedi", reason="comes with IPython")
    script = jedi.Script("import eigengs_dr as eg\neg.")
    import eigengs_dr as eg

    assert set(eg.__all__) <= {found.name for found in script.complete(2, 3)}
    [signature] = jedi.Script("import eigengs_dr as eg\neg.fit(").get_signatures(2, 7)
    assert {"gaussians", "target_psnr", "loss"} <= {found.name for found in signature.params}
