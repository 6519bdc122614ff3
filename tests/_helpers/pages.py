"""The pages of the manual, and the blocks of programs in them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(FOLDER.glob("*.md")), *sorted(FOLDER.glob("*/*.md"))]

BLOCK = re.compile(r"^ *```(python|sh)\n(.*?)^ *```", re.M | re.S)
"""The language and the text of a block."""


def name_of(page):
    return str(page.relative_to(ROOT))


def blocks_of(page):
    """The blocks of a page: their language, text, and the line of the page that they begin in."""
    text = page.read_text()
    return [(b[1], b[2], text.count("\n", 0, b.start(2)) + 1) for b in BLOCK.finditer(text)]
