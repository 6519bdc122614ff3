"""The public names: their documentation, what importing them loads, what a wrong one says."""

import doctest
import importlib
import pkgutil

import pytest

import eigengs_dr as eg
from _helpers.families import family, small_basis, small_model
from _helpers.kernels import launches
from _helpers.process import run_python

MODULES = [
    module.name
    for module in pkgutil.walk_packages(eg.__path__[:1], "eigengs_dr.")
    if not module.name.endswith("__main__")  # which runs the command line
]
SLOW = [name for name in MODULES if name.startswith("eigengs_dr.plugins.")]
"""Their examples are scenes, of which each compiles programs of its own."""


@pytest.mark.parametrize(
    "module", [pytest.param(m, marks=pytest.mark.slow if m in SLOW else ()) for m in MODULES]
)
def test_examples_in_docstrings(module):
    if module.startswith(("eigengs_dr.scene.", "eigengs_dr.plugins.")):
        mi = pytest.importorskip("mitsuba", reason="scenes need mitsuba")
        mi.set_variant("llvm_ad_rgb")
        eg.register_plugins()
    found = doctest.testmod(importlib.import_module(module))
    assert found.failed == 0


# --- Wrong names --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("module", "wrong", "right"),
    [
        ("eigengs_dr", "fti", "fit"),
        ("eigengs_dr", "fit_manny", "fit_many"),
        ("eigengs_dr", "eigengs", "EigenGS"),
        ("eigengs_dr", "PSNR", "psnr"),
        ("eigengs_dr.plugins", "photoloss", "photo_loss"),
    ],
)
def test_the_error_of_a_wrong_name_names_the_right_one(module, wrong, right):
    if module.endswith("plugins"):
        pytest.importorskip("mitsuba", reason="plugins need mitsuba")
    with pytest.raises(AttributeError) as caught:
        getattr(importlib.import_module(module), wrong)
    text = f"module '{module}' has no attribute '{wrong}'; did you mean '{right}'?"
    assert str(caught.value) == text and caught.value.name == wrong


@pytest.mark.parametrize("name", ["xyzzy", "__wrapped__", "_fit"])
def test_nothing_is_suggested_for_what_is_like_no_name(name):
    with pytest.raises(AttributeError) as caught:
        getattr(eg, name)
    assert str(caught.value) == f"module 'eigengs_dr' has no attribute '{name}'"
    assert not hasattr(eg, name)


def test_the_listed_names_are_the_public_ones():
    assert dir(eg) == sorted(eg.__all__) and "fit" in dir(eg) and "fti" not in dir(eg)
    assert all(name in dir(eg) for name in ("EigenGS", "Relightable", "plugins", "view"))


# --- Imports ------------------------------------------------------------------------------------


def test_libraries_are_imported_where_they_are_used():
    code = """
import sys, eigengs_dr as eg
slow = {"click", "drjit", "matplotlib", "mitsuba", "numpy", "PIL", "scipy", "skimage", "tqdm"}
print(sorted(slow & set(sys.modules)))
if sys.platform == "linux":
    # Dr.Jit loads libLLVM when it is imported, and with it what a user may not want.
    print([line for line in open("/proc/self/maps") if "libLLVM" in line][:1])
from eigengs_dr.cli import main
eg.fit_many, eg.EigenGS, eg.Eigenbasis
print([name for name in ("dask", "distributed", "fsspec") if name in sys.modules])
print(eg.paper.__name__, eg.plugins.__name__, "__version__" in dir(eg))
"""
    process = run_python(code)
    *empty, last = process.stdout.splitlines()
    assert set(empty) == {"[]"}, process.stderr
    assert last == "eigengs_dr.paper eigengs_dr.plugins True"


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
    fit = eg.fit(image, 20, iterations=1, backend="llvm")
    packed = eg.pack(fit, tmp_path / "x.egs", max_psnr_drop=60)
    rows = eg.fit_many([image], tmp_path, gaussians=20, iterations=1)
    lazy, lists, page = fit.gaussians.scaled(40, 40), eg.tile_lists(fit), eg.view(fit)
    for thing in (fit, lazy, packed, rows, lists, page, small_basis(), small_model("llvm")):
        with launches() as launched:
            assert len(repr(thing)) < 400
        assert not launched, repr(thing)
