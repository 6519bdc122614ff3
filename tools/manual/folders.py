"""The table of the folders of `eigengs_dr/`, in CONTRIBUTING.md.

``python tools/manual/folders.py`` writes it between its marks: the order is that of the layers in
pyproject.toml, the text is the first line of each folder.
"""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "CONTRIBUTING.md",)
LAYERS = re.compile(r"^layers = \[(.*?)^\]", re.S | re.M)
MARKS = re.compile(r"(<!-- folders -->\n).*?(<!-- end -->)", re.S)


def table() -> str:
    """Return the table, lowest folder first."""
    listed = LAYERS.search((ROOT / "pyproject.toml").read_text("utf-8"))
    assert listed is not None
    layers = re.findall(r'"([\w.]+)"', listed[1])
    rows = ["| folder | holds |", "|---|---|"]
    for layer in reversed(layers):
        start = ROOT / layer.replace(".", "/") / "__init__.py"
        text = ast.get_docstring(ast.parse(start.read_text("utf-8"))) or ""
        rows.append(f"| `{layer.rpartition('.')[2]}/` | {text.splitlines()[0].rstrip('.')} |")
    return "\n".join([*rows, ""])


def outdated() -> dict[Path, str]:
    """Return the pages whose table is another one, with what they should hold."""
    texts = {page: page.read_text("utf-8") for page in PAGES}
    right = {page: MARKS.sub(rf"\g<1>{table()}\g<2>", text) for page, text in texts.items()}
    return {page: right[page] for page in PAGES if right[page] != texts[page]}


if __name__ == "__main__":
    for changed, content in outdated().items():
        changed.write_text(content, "utf-8")
