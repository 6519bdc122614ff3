"""The public names, their documentation, and what importing them loads."""

import doctest
import importlib
import pkgutil

import pytest

import eigengs_dr
from _helpers.process import run_python


def test_import_starts_nothing():
    code = """
import sys
import eigengs_dr
slow = {"click", "matplotlib", "mitsuba", "scipy", "skimage", "tqdm"}
print(sorted(slow & set(sys.modules)))
if sys.platform == "linux":
    # Dr.Jit loads libLLVM when it is imported, and with it what a user may not want.
    print([line for line in open("/proc/self/maps") if "libLLVM" in line][:1])
"""
    process = run_python(code)
    assert process.returncode == 0, process.stderr
    assert set(process.stdout.splitlines()) == {"[]"}


MODULES = [m.name for m in pkgutil.iter_modules(eigengs_dr.__path__) if m.name != "plugins"]


@pytest.mark.parametrize("module", MODULES)
def test_examples_in_docstrings(module):
    found = doctest.testmod(importlib.import_module(f"eigengs_dr.{module}"))
    assert found.failed == 0
