"""List what README.md and the manual say without a ground: ``python tools/manual/check_pages.py``.

These are names that the package does not have, links to files that are not there, and figures that
nobody can trace: a number with a unit, in a sentence that neither names the commit that it was
measured at, nor has it from a row (`eigengs_bench.pages`), nor says by ``<!-- setting -->`` that
nobody measured it; and tables of numbers that no row holds. Code of several words and formulas
say what is set or computed.
"""

import ast
import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md")), *sorted(ROOT.glob("docs/*/*.md"))]
NAME = re.compile(r"`(eigengs_dr(?:\.\w+)+)`(?:, `(\w+)`$)?")
UNIT = (
    r"dB|decibels?|%|per cent|min|minutes?|hours?|[mnu]?s|seconds?|[kKMGT]i?B"
    r"|GB/s|(?:bits?|bytes) (?:a|per) (?:pixel|texel|Gaussian)|bpp"
    r"|times (?:as|closer|faster|slower|more|less|longer|smaller|larger)"
)
FIGURE = re.compile(rf"\d ?(?:{UNIT})(?![\w/(])|^\|.*---:", re.M)
TRACED = re.compile(
    r"^ *```.*?^ *```|^\$\$.*?^\$\$|\$[^$]+\$|``.+?``"
    r"|<!-- (table|figure): (\S+) -->.*?<!-- end -->",
    re.M | re.S,
)
GROUND = re.compile(r"commit\s[0-9a-f]{7}|<!-- setting -->")
SENTENCE = re.compile(r".+?(?:[.?!:](?=\s)|\n\s*\n|\n(?= *(?:[-*#|]|\d+\.) )|\Z)", re.S)
LINK = re.compile(r"(?<!\[)(\[[^\]]*\])\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"")
BLOCKS = re.compile(r"^ *```.*?^ *```", re.M | re.S)
CODE = re.compile(rf"{BLOCKS.pattern}|<!-- manual:.*?-->|`[^`\n]+`", re.M | re.S)

FORMATS = {
    f"eigengs_dr.{kind}"
    for kind in ("gaussians", "material", "eigenbasis", "model", "relightable", "checkpoint")
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
    """Find the sentences of a page that give figures without a source, by their lines."""
    rest = TRACED.sub(lambda traced: "\n" * traced[0].count("\n"), text)
    return [
        f"{rest.count(chr(10), 0, figure.start()) + 1}: {' '.join(sentence[0].split())}"
        for sentence in SENTENCE.finditer(rest)
        if not GROUND.search(sentence[0])
        for figure in [FIGURE.search(rest, *sentence.span())]
        if figure
    ]


def broken() -> list[str]:
    """Find relative links and pictures that a checkout does not have, and links without words."""
    wrong = []
    for path in [*PAGES, *ROOT.glob("*.md"), *ROOT.glob("*/README.md")]:
        for words, *targets in LINK.findall(CODE.sub("code", path.read_text())):
            target = "".join(targets)
            file, _, heading = target.partition("#")
            there = path.parent / file if file else path
            is_there = there.exists() and (not heading or heading in headings(there))
            if not (is_there or re.match(r"\w+:", target)) or words == "[]":
                wrong.append(f"{path.relative_to(ROOT)}: {words}({target})")
    return wrong


def headings(path: Path) -> set[str]:
    """Return the anchors that GitHub and MyST give to the headings of a page."""
    titles = re.findall(r"^#+ (.+)", BLOCKS.sub("", path.read_text()), re.M)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


if __name__ == "__main__":
    sys.exit("\n".join([*missing(), *untraced(), *broken()]) or 0)
