"""Settings of the manual: Sphinx, MyST-NB, numpydoc and sphinx-gallery."""

import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.util import logging

import eigengs_dr as eg

sys.path.insert(0, str(Path(__file__).parents[1] / "tools" / "manual"))
import pages
from check_pages import ROOT, missing, untraced

from eigengs_bench.pages import outdated

LOGGER = logging.getLogger(__name__)

project = "eigengs_dr"
author = "the authors of eigengs_dr"
copyright = f"2026, {author}"
version = release = eg.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
templates_path = ["_templates"]
exclude_patterns = ["tutorials/*.ipynb"]  # sphinx-gallery offers them, beside the pages

# --- Pages ---------------------------------------------------------------------------------------

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"eigengs_dr {release}"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
pages.FOLDER.mkdir(parents=True, exist_ok=True)  # Sphinx wants it before it is filled
html_extra_path = [str(pages.FOLDER)]

# --- Reference -----------------------------------------------------------------------------------


def table_of(names: list[str], folder: str) -> str:
    """Return a table of names, whose pages are in a folder."""
    lines = "".join(f"   {name}\n" for name in names)
    head = ".. currentmodule:: eigengs_dr\n\n.. autosummary::\n"
    return f"{head}   :toctree: {folder}\n\n{lines}"


# Autosummary finds the names of which it makes pages in files alone, and a page lists them once.
REFERENCE = pages.REFERENCE / "python.md"
LISTED = pages.LISTED.findall(REFERENCE.read_text("utf-8"))
TABLE = ROOT / "build" / "docs" / "names.rst"
TABLE.write_text(table_of(LISTED, f"{REFERENCE.parent}/generated"), "utf-8")
autosummary_generate = ["../build/docs/names.rst"]
autodoc_typehints = "none"  # the docstrings name types, shapes and units
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

# A name in single backticks is a link where it is public, else plain code.
default_role = "py:obj"
smartquotes = False  # options keep both of their hyphens
PUBLIC = set(eg.__all__) - {"__version__", "paper", "plugins"}
_public = "|".join(sorted(PUBLIC))
nitpick_ignore_regex = [("py:obj", rf"(?!(eigengs_dr\.)?({_public})$).*"), ("py:class", r".*")]


def skip_tuple_fields(
    app: Any, what: str, name: str, item: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out the fields of named tuples, which the docstring of their class describes."""
    is_field = (getattr(item, "__doc__", None) or "").startswith("Alias for field number")
    return True if is_field else None


def check_pages(app: Any) -> None:
    """Warn of public names that the reference leaves out, and of what pages say without ground."""
    for name in sorted(PUBLIC - {*LISTED}):
        LOGGER.warning("reference/python.md: the public name %s is not listed", name)
    for line in missing():
        LOGGER.warning("%s does not exist", line)
    for line in untraced():
        LOGGER.warning("a figure that is neither of a row nor has its commit: %s", line)
    for path in [*outdated(ROOT), *pages.outdated()]:
        LOGGER.warning("%s differs from what its marks name; run 'make pages'", path)


OUTSIDE = {"README": "index", "CHANGELOG": "changelog", "CONTRIBUTING": "contributing"}
"""Pages at the top of the checkout, and the pages of the manual that show them."""


def read_page(app: Any, name: str, source: list[str]) -> None:
    """Make a page of a checkout one of the HTML.

    Pages of `OUTSIDE` are shown where they belong, links to examples lead to their tutorials, and
    what only the HTML can show comes out of its comment. A list of names becomes a table.
    """
    text = source[0]
    for file, page in OUTSIDE.items():
        if page == name:
            outside = (ROOT / f"{file}.md").read_text("utf-8")
            outside = re.sub(r"\]\((?!https?:|#)", "](../", outside).replace("](../docs/", "](")
            text = outside + text if name == "index" else outside
    for file, page in OUTSIDE.items():
        text = re.sub(rf"\]\((\.\./)+{file}\.md", f"](/{page}.md", text)
    text = re.sub(r"\]\((\.\./)+examples/README\.md", "](/tutorials/index.rst", text)
    text = re.sub(r"\]\((?:\.\./)+examples/(\w+)\.py", r"](/tutorials/\1.rst", text)
    text = re.sub(r"<!-- names: .*?<!-- end -->", names_table, text, flags=re.S)
    source[0] = re.sub(r"<!-- manual:\n(.*?)-->", r"\1", text, flags=re.S)


def names_table(names: re.Match[str]) -> str:
    """Return the table that the HTML shows in place of a list of names."""
    return f"```{{eval-rst}}\n{table_of(pages.LISTED.findall(names[0]), 'generated')}```"


def link_names(app: Any, page: nodes.document) -> None:
    """Make links of the public names in backticks, as in `eigengs_dr.fit`."""
    for code in list(page.findall(nodes.literal)):
        package, _, name = code.astext().rpartition(".")
        if package == "eigengs_dr" and name in PUBLIC and isinstance(code.parent, nodes.Element):
            if isinstance(code.parent, nodes.reference | addnodes.pending_xref):
                continue
            target = {"reftype": "obj", "reftarget": code.astext(), "refdoc": app.env.docname}
            code.replace_self(addnodes.pending_xref("", code.deepcopy(), refdomain="py", **target))


def write_pages(app: Any) -> None:
    """Write the pages that how-to/view.md embeds."""
    pages.write_pages()


def setup(app: Any) -> None:
    """Connect the functions above."""
    app.connect("builder-inited", check_pages)
    app.connect("builder-inited", write_pages)
    app.connect("source-read", read_page)
    app.connect("doctree-read", link_names)
    app.connect("autodoc-skip-member", skip_tuple_fields)


# --- Tutorials -----------------------------------------------------------------------------------

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "tutorials",
    "filename_pattern": r"\.py$",
    "within_subsection_order": "gallery.sort_key",
    "image_scrapers": ("gallery.scrape_pictures",),
    "reset_argv": "gallery.output_folder",
    "reset_modules": (),
    "capture_repr": (),
    "remove_config_comments": True,
    "download_all_examples": False,
    "show_memory": False,
    "write_computation_times": False,
    "show_signature": False,
    "min_reported_time": 30,
    "abort_on_example_error": True,
}
