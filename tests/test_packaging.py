"""The plugins are installed inside the package, from a wheel and from an editable install.

Needs the package to be installed, as ``make setup`` does.
"""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent

FIND = """
import importlib.util, sys
sys.path[:0] = sys.argv[1:]
import eigengs_dr.plugins
print(eigengs_dr.plugins.__file__)
print(importlib.util.find_spec("plugins"))
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
    assert process.stdout.strip() == str(ROOT / "plugins" / "__init__.py"), process.stderr


def test_wheel(tmp_path):
    # A copy, because building leaves files behind.
    source = tmp_path / "source"
    hidden = shutil.ignore_patterns(".*", "build", "*.egg-info")
    shutil.copytree(ROOT, source, ignore=hidden)
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
    assert found.stdout.splitlines() == [where, "None"]
