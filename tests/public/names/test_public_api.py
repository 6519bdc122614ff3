"""The public names, their documentation, and what importing them loads."""

import doctest
import importlib
import inspect
import pkgutil
import re

import pytest

import eigengs_dr
from _helpers.families import family, small_basis, small_model
from _helpers.kernels import launches
from _helpers.process import run_python
from eigengs_dr.backend.selection import candidates

MODULES = [
    module.name
    for module in pkgutil.walk_packages(eigengs_dr.__path__[:1], "eigengs_dr.")
    if not module.name.endswith("__main__")  # which runs the command line
]

names = pytest.mark.parametrize("name", eigengs_dr.__all__)


def sections_of(docstring):
    """Sections of a NumPy-style docstring: their text by their title."""
    parts = re.split(r"^(\w[\w ]*)\n-+$", inspect.cleandoc(docstring), flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


@names
def test_public_names_are_documented(name):
    """Functions tell their parameters and what they return, records and classes their fields."""
    assert name in dir(eigengs_dr)
    thing = getattr(eigengs_dr, name)
    docstring = thing.__doc__
    assert docstring.strip()
    sections = sections_of(docstring)
    if inspect.isclass(thing):
        assert "Attributes" in sections or issubclass(thing, Exception)
        return
    if not callable(thing):
        return
    signature = inspect.signature(thing)
    told = re.findall(r"^([\w, ]+) : ", sections.get("Parameters", ""), flags=re.M)
    assert [n for line in told for n in line.split(", ")] == list(signature.parameters)
    assert ("Returns" in sections) == (signature.return_annotation not in (None, "None"))


def test_folders_are_attributes_and_dask_is_imported_where_it_is_used():
    code = """
import sys, eigengs_dr as eg
from eigengs_dr.cli import main
eg.fit_many, eg.EigenGS, eg.Eigenbasis
print([name for name in ("dask", "distributed", "fsspec") if name in sys.modules])
print(eg.paper.__name__, eg.plugins.__name__, "__version__" in dir(eg))
"""
    words = ["[]", "eigengs_dr.paper", "eigengs_dr.plugins", "True"]
    assert run_python(code).stdout.split() == words


@pytest.mark.parametrize("module", MODULES)
def test_examples_in_docstrings(module):
    if module.startswith("eigengs_dr.scene."):
        pytest.importorskip("mitsuba", reason="scenes need mitsuba")
    found = doctest.testmod(importlib.import_module(module))
    assert found.failed == 0


def test_import_starts_nothing():
    code = """
import sys
import eigengs_dr
slow = {"click", "drjit", "matplotlib", "mitsuba", "numpy", "PIL", "scipy", "skimage", "tqdm"}
print(sorted(slow & set(sys.modules)))
if sys.platform == "linux":
    # Dr.Jit loads libLLVM when it is imported, and with it what a user may not want.
    print([line for line in open("/proc/self/maps") if "libLLVM" in line][:1])
"""
    process = run_python(code)
    assert process.returncode == 0, process.stderr
    assert set(process.stdout.splitlines()) == {"[]"}


@pytest.mark.slow
def test_libllvm_is_chosen_before_names_are_imported_at_once():
    """With EAGER_IMPORT, `lazy_loader` imports all names, and so Dr.Jit, with the package."""
    code = """
import os
chosen = []
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "drjit":
            chosen.append(os.environ.get("DRJIT_LIBLLVM_PATH"))
import sys
sys.meta_path.insert(0, Watch())
import eigengs_dr
print(chosen[0] == os.environ.get("DRJIT_LIBLLVM_PATH"), bool(chosen[0]))
"""
    pytest.importorskip("mitsuba", reason="all names need mitsuba")
    if not candidates():
        pytest.skip("needs a libLLVM")
    process = run_python(code, EAGER_IMPORT="1", DRJIT_LIBLLVM_PATH=None)
    assert process.stdout.split() == ["True", "True"], process.stderr


def test_without_mitsuba_its_users_say_what_to_install():
    code = """
import sys
sys.modules["mitsuba"] = None
import eigengs_dr as eg
for name in ("fit_for_scene", "register_plugins"):
    try:
        getattr(eg, name)
    except ImportError as error:
        print(error)
"""
    process = run_python(code)
    assert process.stdout.count("pip install 'mitsuba") == 2, process.stderr


def test_to_print_computes_nothing(tmp_path):
    """What a user sees in a shell after a call: results, and sets that are not evaluated yet."""
    image = family(1, side=32)[0]
    fit = eigengs_dr.fit(image, 20, iterations=1, backend="llvm")
    lazy = fit.gaussians.scaled(40, 40)
    packed = eigengs_dr.pack(fit, tmp_path / "x.egs", max_psnr_drop=60)
    rows = eigengs_dr.fit_many([image], tmp_path, gaussians=20, iterations=1)
    lists, page = eigengs_dr.tile_lists(fit), eigengs_dr.view(fit)
    for thing in (fit, lazy, packed, rows, lists, page, small_basis(), small_model("llvm")):
        with launches() as launched:
            assert len(repr(thing)) < 400
        assert not launched, repr(thing)
