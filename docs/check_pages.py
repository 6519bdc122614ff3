"""List what pages of the manual say without a ground: ``python docs/check_pages.py``.

These are names that the package does not have, and figures that nobody can trace: a number with
a unit that is not filled in from a row, not marked as ``{measured}``, and neither code nor a
formula, which say what is set or computed; and tables of numbers that no row holds.
"""

import ast
import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).parent
PAGES = sorted([*FOLDER.glob("*.md"), *FOLDER.glob("*/*.md")])
NAME = re.compile(r"`(eigengs_dr(?:\.\w+)+)`(?:, `(\w+)`$)?")
FIGURE = re.compile(r"\d ?(?:dB|min|[mnu]?s|[kMG]i?B|GB/s|%)(?![\w/(])|^\|.*---:")
TRACED = re.compile(
    r"^```.*?^```|^\$\$.*?^\$\$|\{\{.*?\}\}|\$[^$]+\$|``.+?``"
    r"|\{measured\}`[^`]*\bcommit\s[0-9a-f]{7}[^`]*`|(?<!\{measured\})`[^`]+`",
    re.M | re.S,
)

FORMATS = {
    f"eigengs_dr.{kind}" for kind in ("gaussians", "material", "eigenbasis", "model", "checkpoint")
}
"""Names of file formats, not of Python."""


def exists(name: str) -> bool:
    """Tell whether a dotted name is a module, or is defined where the name says.

    A package may name what its modules define. A module that only imports a name has it not.
    """
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:split]))
        except ImportError:
            continue
        if split < len(parts) and not hasattr(found, "__path__") and parts[split] not in own(found):
            return False
        for part in parts[split:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def own(module: ModuleType) -> set[str]:
    """Return the names that a module defines itself, at its top level."""
    names: set[str] = set()
    for node in ast.parse(Path(str(module.__file__)).read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}
    return names


def missing() -> list[str]:
    """Find names that do not exist, with the file and the line that mention them.

    A second name that ends a line, as in `` `eigengs_dr.a.b`, `c` ``, is taken beside the first.
    """
    found = []
    for path in PAGES:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            for name, second in NAME.findall(line):
                names = [name, f"{name.rpartition('.')[0]}.{second}"] if second else [name]
                wrong = [n for n in names if n not in FORMATS and not exists(n)]
                found += [f"{path.name}:{number}: {n}" for n in wrong]
    return found


def untraced() -> list[str]:
    """Find figures without a source, with the file and the line that give them."""
    return [f"{path.name}:{line}" for path in PAGES for line in untraced_in(path.read_text())]


def untraced_in(text: str) -> list[str]:
    """Find the lines of a page that give figures without a source, with their numbers."""
    rest = TRACED.sub(lambda traced: "\n" * traced[0].count("\n"), text).splitlines()
    return [f"{n}: {line.strip()}" for n, line in enumerate(rest, 1) if FIGURE.search(line)]


if __name__ == "__main__":
    sys.exit("\n".join([*missing(), *untraced()]) or 0)
