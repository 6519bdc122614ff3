"""List the names in the manual that the package does not have: ``python docs/check_names.py``."""

import importlib
import re
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
NAME = re.compile(r"`(eigengs_dr(?:\.\w+)+)`(?:, `(\w+)` \|)?")

FORMATS = {f"eigengs_dr.{kind}" for kind in ("gaussians", "eigenbasis", "model", "checkpoint")}
"""Names of file formats, not of Python."""


def exists(name: str) -> bool:
    """Tell whether a dotted name can be imported, or is an attribute of what can be."""
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:split]))
        except ImportError:
            continue
        for part in parts[split:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def missing() -> list[str]:
    """Find names that do not exist, with the file and the line that mention them.

    A second name after a comma, as in `` `eigengs_dr.a.b`, `c` ``, is taken beside the first.
    """
    found = []
    for path in sorted([*FOLDER.glob("*.md"), *FOLDER.glob("*/*.md")]):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            for name, second in NAME.findall(line):
                names = [name, f"{name.rpartition('.')[0]}.{second}"] if second else [name]
                wrong = [n for n in names if n not in FORMATS and not exists(n)]
                found += [f"{path.name}:{number}: {n}" for n in wrong]
    return found


if __name__ == "__main__":
    sys.exit("\n".join(missing()) or 0)
