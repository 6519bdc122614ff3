"""The module by which Mitsuba finds the plugins."""

import importlib
import re
from pathlib import Path

import pytest

from _helpers.process import run_python
from _helpers.texture import mi  # noqa: F401  (skips where it is not installed)

pytestmark = pytest.mark.mitsuba


FOUND = """
import importlib, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
module = importlib.import_module("{module}")
for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
    mi.set_variant(variant)
    importlib.reload(module)
    try:
        mi.load_dict({{"type": "gaussian_texture"}})
    except RuntimeError as error:
        print(error)
"""


def test_the_entry_point_names_a_module_that_registers():
    """3.10 imports the module, and imports it anew after a change of the variant."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    module = re.search(r'entry-points\.mitsuba\]\n(?:#.*\n)*\w+ = "(.*)"', text)[1]
    assert importlib.util.find_spec(module)
    found = run_python(FOUND.format(module=module))
    assert found.stdout.count("give one of filename") == 2, found.stderr
