"""The plugins are installed inside the package, and what is published works where it is installed.

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

ROOT = Path(__file__).parent.parent

FIND = """
import sys
sys.path[:0] = sys.argv[1:]
import eigengs_dr.plugins
print(eigengs_dr.plugins.__file__)
"""


def test_in_the_root_of_a_checkout(tmp_path):
    """Its package comes before an installed one; -S leaves editable installs out."""
    libraries = os.pathsep.join(path for path in sys.path if path.endswith("site-packages"))
    code = "import eigengs_dr.plugins.cone, eigengs_dr; print(eigengs_dr.plugins.__file__)"
    process = subprocess.run(
        [sys.executable, "-S", "-c", code],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": libraries},
        capture_output=True,
        text=True,
        check=False,
    )
    plugins = ROOT / "eigengs_dr" / "plugins"
    assert process.stdout.strip() == str(plugins / "__init__.py"), process.stderr


def copy_of_the_source(folder):
    """A copy, because building leaves files behind."""
    hidden = shutil.ignore_patterns(".*", "build", "dist", "*.egg-info")
    return shutil.copytree(ROOT, folder / "source", ignore=hidden)


def test_all_folders_are_packages():
    """Others would be missing in a wheel."""
    listed = re.findall(r'^    "(eigengs_dr[\w.]*)",$', (ROOT / "pyproject.toml").read_text(), re.M)
    made = {path.parent.relative_to(ROOT) for path in ROOT.glob("eigengs_dr/**/*.py")}
    assert {".".join(folder.parts) for folder in made} | {"eigengs_dr.plugins"} == {*listed}


@pytest.mark.slow
def test_wheel(tmp_path):
    source = copy_of_the_source(tmp_path)
    build = ["pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(tmp_path)]
    subprocess.run([sys.executable, "-m", *build, str(source)], check=True)
    [wheel] = tmp_path.glob("*.whl")

    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "installed")
    assert {name.split("/")[0].split("-")[0] for name in names} == {"eigengs_dr"}
    modules = {path.relative_to(ROOT).as_posix() for path in ROOT.glob("eigengs_dr/**/*.py")}
    plugins = {
        "eigengs_dr/" + path.relative_to(ROOT).as_posix() for path in ROOT.glob("plugins/*.py")
    }
    assert modules | plugins <= set(names)
    for name in ("eigenbasis/data/natural.npz", "__init__.pyi", "py.typed"):
        assert f"eigengs_dr/{name}" in names
    page = {path.relative_to(ROOT).as_posix() for path in ROOT.glob("eigengs_dr/viewer/web/*")}
    assert page and page <= set(names)
    installed = tmp_path / "installed"
    where = str(installed / "eigengs_dr/plugins/__init__.py")
    command = [sys.executable, "-c", FIND, str(installed)]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert found.stdout.splitlines() == [where]


SCENE = """
import eigengs_dr as eg
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from eigengs_dr.plugins import texture_of
eg.register_plugins()
bsdf = {"type": "diffuse", "reflectance": texture_of(eg.Gaussians.load("fit.npz"))}
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "direct"},
    "sensor": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at(
        [0, 0, 4], [0, 0, 0], [0, 1, 0]), "film": {"type": "hdrfilm", "width": 16, "height": 16}},
    "light": {"type": "constant"},
    "card": {"type": "rectangle", "bsdf": bsdf},
})
picture = mi.render(scene, spp=4).numpy()
print(eg.__file__)
print(0.05 < picture.mean() < 0.95, picture.std() > 0.01)
"""


def ended(process):
    """What a program wrote, which must have ended well."""
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_an_installed_wheel_works_outside_of_the_checkout(tmp_path):
    """The wheel, built from the source distribution, in an empty environment."""
    pytest.importorskip("build", reason="pip install build twine")
    pytest.importorskip("twine", reason="pip install build twine")
    hidden = ("PYTHONPATH", "VIRTUAL_ENV")
    clean = {name: value for name, value in os.environ.items() if name not in hidden}

    def run(*command):
        words = [str(word) for word in command]
        options = {"capture_output": True, "text": True, "check": False}
        return subprocess.run(words, cwd=tmp_path, env=clean, **options)

    source = copy_of_the_source(tmp_path)
    built = tmp_path / "dist"
    ended(run(sys.executable, "-m", "build", "--no-isolation", "--outdir", built, source))
    [wheel], [archive] = built.glob("*.whl"), built.glob("*.tar.gz")
    ended(run(sys.executable, "-m", "twine", "check", "--strict", wheel, archive))
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    beside = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"}
    assert beside | {"eigengs_dr/plugins/entry.py"} <= names

    ended(run(sys.executable, "-m", "venv", tmp_path / "empty"))
    programs = tmp_path / "empty" / ("Scripts" if os.name == "nt" else "bin")
    python, command = programs / "python", programs / "eigengs-dr"
    installed = run(python, "-m", "pip", "install", f"{wheel}[plugins]")
    if "NewConnectionError" in installed.stdout + installed.stderr:
        pytest.skip("no package index can be reached: the wheel was not installed")
    ended(installed)
    assert "llvm     works" in ended(run(command, "doctor"))
    photo = "import eigengs_dr as eg; eg.save_image('photo.png', eg.sample('coffee')[:96, :96])"
    ended(run(python, "-c", photo))
    fit = ("fit", "photo.png", "-o", "fit.npz", "--gaussians", 100, "--iterations", 20)
    ended(run(command, *fit))
    ended(run(command, "fit", "photo.png", "-o", "n.npz", "--basis", "natural", "--iterations", 0))
    ended(run(command, "view", "fit.npz", "-o", "page.html"))
    where, checks = ended(run(python, "-c", SCENE)).splitlines()
    assert Path(where).is_relative_to(tmp_path / "empty") and checks == "True True"
