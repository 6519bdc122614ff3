"""Tests stand at the door that users take, so that no change of the house edits them."""

import ast
from pathlib import Path

TESTS = Path(__file__).parents[1]
DOORS = {"eigengs_dr", "eigengs_dr.plugins", "eigengs_dr.paper"}


def inner_modules(source):
    """Modules of the package that a test imports and users do not."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        else:
            continue
        yield from (m for m in modules if m.split(".")[0] == "eigengs_dr" and m not in DOORS)


def test_only_tests_of_kernels_import_what_users_do_not():
    outside = [p for p in TESTS.rglob("*.py") if TESTS / "kernels" not in p.parents]
    inner = {p.relative_to(TESTS): sorted(set(inner_modules(p.read_text()))) for p in outside}
    assert not {path: modules for path, modules in inner.items() if modules}
