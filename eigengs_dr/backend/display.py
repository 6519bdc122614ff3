"""What a notebook shows of an object, made by a folder above that of its class."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import Any

NOTEBOOK = "eigengs_dr.viewer.notebook:to_html"
"""The function that makes HTML of objects, imported when a notebook shows the first."""


def to_html(value: Any) -> str:
    """Return what a notebook shows of a set, a fit, a basis or a model: pictures and figures."""
    html: str = resolve_name(NOTEBOOK)(value)
    return html
