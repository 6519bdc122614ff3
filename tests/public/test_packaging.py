"""What is published works where it is installed, and its types are those of the manual.

Needs the package to be installed, as ``make setup`` does.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from _helpers.pages import BLOCK, PAGES, ROOT


def ended(command, folder, environment=None):
    """What a program wrote, which must have ended well."""
    words = [str(word) for word in command]
    process = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if "NewConnectionError" in process.stdout + process.stderr:
        pytest.skip("no package index can be reached: nothing was installed")
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def test_in_the_root_of_a_checkout():
    """Its package comes before an installed one; -S leaves editable installs out."""
    libraries = os.pathsep.join(path for path in sys.path if path.endswith("site-packages"))
    code = "import eigengs_dr.plugins.cone, eigengs_dr; print(eigengs_dr.plugins.__file__)"
    shown = ended([sys.executable, "-S", "-c", code], ROOT, os.environ | {"PYTHONPATH": libraries})
    assert shown.strip() == str(ROOT / "eigengs_dr" / "plugins" / "__init__.py")


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A folder with the source distribution and the wheel that is built from it."""
    pytest.importorskip("build", reason="pip install build twine")
    pytest.importorskip("twine", reason="pip install build twine")
    folder = tmp_path_factory.mktemp("published")
    hidden = shutil.ignore_patterns(".*", "build", "dist", "*.egg-info")
    source = shutil.copytree(ROOT, folder / "source", ignore=hidden)  # building leaves files behind
    dist = folder / "dist"
    build = ["build", "--no-isolation", "--outdir", dist, source]
    ended([sys.executable, "-m", *build], folder)
    ended([sys.executable, "-m", "twine", "check", "--strict", *dist.iterdir()], folder)
    return dist


@pytest.fixture(scope="module")
def wheel(published):
    [wheel] = published.glob("*.whl")
    return wheel


@pytest.mark.slow
def test_archives_hold_all_files(published, wheel):
    [archive] = published.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    beside = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"}
    assert beside | {"eigengs_dr/plugins/entry.py"} <= names
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"eigengs_dr"}
    files = [*ROOT.glob("eigengs_dr/**/*.py"), *ROOT.glob("eigengs_dr/viewer/web/*")]
    assert {path.relative_to(ROOT).as_posix() for path in files} <= set(names)
    assert {f"eigengs_dr/plugins/{path.name}" for path in ROOT.glob("plugins/*.py")} <= set(names)
    for name in ("eigenbasis/data/natural.npz", "__init__.pyi", "py.typed"):
        assert f"eigengs_dr/{name}" in names


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_an_installed_wheel_works_outside_of_the_checkout(wheel, tmp_path):
    """In an empty environment, which has no benchmarks either."""
    hidden = ("PYTHONPATH", "VIRTUAL_ENV")
    clean = {name: value for name, value in os.environ.items() if name not in hidden}

    def run(*command):
        return ended(command, tmp_path, clean)

    run(sys.executable, "-m", "venv", tmp_path / "empty")
    programs = tmp_path / "empty" / ("Scripts" if os.name == "nt" else "bin")
    python, command = programs / "python", programs / "eigengs-dr"
    run(python, "-m", "pip", "install", f"{wheel}[plugins]")
    doctor = run(command, "doctor")  # it fits, and renders a scene with a texture
    assert "llvm     works" in doctor and "programs of a first fit are compiled" in doctor
    run(python, "-c", "import eigengs_dr as eg; eg.save_image('a.png', eg.sample('coffee')[:96])")
    run(command, "fit", "a.png", "-o", "fit.npz", "--gaussians", 100, "--iterations", 20)
    run(command, "fit", "a.png", "-o", "n.npz", "--basis", "natural", "--iterations", 0)
    run(command, "view", "fit.npz", "-o", "page.html")
    where = run(python, "-c", "import eigengs_dr.plugins as p; print(p.__file__)")
    assert Path(where).is_relative_to(tmp_path / "empty")
    bench = subprocess.run([command, "bench"], capture_output=True, text=True, check=False)
    assert bench.returncode == 2 and bench.stderr.count("\n") == 1
    assert "pip install ./benchmarks" in bench.stderr


# These packages come without types, or with few.
SETTINGS = """
[mypy]
strict = true
untyped_calls_exclude = distributed, drjit, mitsuba
[mypy-scipy.*,torch.*]
ignore_missing_imports = true
"""


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_programs_of_the_manual_are_typed(wheel, tmp_path):
    """In strict mode, against the files of an installed wheel and against the checkout."""
    for module in ("mypy", "mitsuba"):
        pytest.importorskip(module)
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    files = []
    for page in PAGES:
        if blocks := BLOCK.findall(page.read_text()):
            files.append(re.sub(r"\W", "_", str(page.relative_to(ROOT).with_suffix(""))) + ".py")
            program = "\n".join(text for language, text in blocks if language == "python")
            (tmp_path / files[-1]).write_text(program)
    assert len(files) > 20
    shutil.unpack_archive(wheel, tmp_path / "installed", "zip")
    command = [sys.executable, "-m", "mypy", "--cache-dir", tmp_path / "cache", *files]
    for where in (tmp_path / "installed", ROOT):
        ended(command, tmp_path, os.environ | {"PYTHONPATH": str(where)})


def test_an_editor_completes_the_public_names_with_their_signatures():
    jedi = pytest.importorskip("jedi", reason="comes with IPython")
    script = jedi.Script("import eigengs_dr as eg\neg.")
    import eigengs_dr as eg

    assert set(eg.__all__) <= {name.name for name in script.complete(2, 3)}
    [signature] = jedi.Script("import eigengs_dr as eg\neg.fit(").get_signatures(2, 7)
    assert {"gaussians", "target_psnr", "loss"} <= {name.name for name in signature.params}
