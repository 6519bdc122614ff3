"""The page: one HTML file that needs no other file and no network."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from ..storage.atomic import atomic_write

SCRIPTS = (
    "data.js",
    "camera.js",
    "shaders.js",
    "renderer.js",
    "model.js",
    "gestures.js",
    "viewer.js",
    "panel.js",
    "main.js",
)
"""The programs of the page, in the order in which they run."""

FRAME_HEIGHT = 560
"""Height of a page inside a notebook, in pixels."""


@dataclass(frozen=True, repr=False)
class Page:
    """A page for the browser that shows a set or a model.

    Jupyter shows it as the value of a cell. It needs WebGL 2, which browsers have since 2021, and
    no network.

    Attributes
    ----------
    html : str
        The whole page.
    """

    html: str

    def __repr__(self) -> str:
        return f"Page({len(self.html):,} bytes)"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page as an ``.html`` file, completely or not at all.

        Raises
        ------
        ValueError
            If the name has another suffix.
        OSError
            If the file cannot be written; an existing file does not change.
        """
        if Path(path).suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"{path}: the name must end in .html")
        with atomic_write(path) as temporary:
            temporary.write_text(self.html, encoding="utf-8")

    def _repr_html_(self) -> str:
        """Show the page in a frame of its own, so that neither page styles the other."""
        style = f"width: 100%; height: {FRAME_HEIGHT}px; border: 1px solid #8886"
        return f'<iframe srcdoc="{escape(self.html)}" style="{style}"></iframe>'


def build_page(**values: Any) -> Page:
    """Fill the template; for the values see ``web/page.html.j2``. Text is escaped."""
    loader = _environment().loader
    assert loader is not None
    scripts = [Markup(_source(name)) for name in SCRIPTS]
    template = _environment().get_template("page.html.j2")
    return Page(template.render(style=Markup(_source("page.css")), scripts=scripts, **values))


@cache
def _environment() -> jinja2.Environment:
    """Return the environment of the template; an unknown value is an error."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("eigengs_dr.viewer", "web"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )


def _source(name: str) -> str:
    loader = _environment().loader
    assert loader is not None
    return loader.get_source(_environment(), name)[0]
