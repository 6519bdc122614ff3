"""HTML representations for notebooks, which the viewer, a layer above, provides."""

from __future__ import annotations

from collections.abc import Callable

make_html: Callable[[object], str] = repr
"""`eigengs_dr.viewer.notebook.to_html`, which `eigengs_dr` assigns here."""


def to_html(value: object) -> str:
    """Return pictures and figures of a set, a fit, a basis or a model as HTML."""
    return make_html(value)
