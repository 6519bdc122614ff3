"""What a notebook shows of objects of this package; the viewer makes it, which is above them."""

from __future__ import annotations

from collections.abc import Callable

make_html: Callable[[object], str] = repr
"""That of the viewer, see `eigengs_dr.viewer.notebook.to_html`; `eigengs_dr` puts it here."""


def to_html(value: object) -> str:
    """Return pictures and figures of a set, a fit, a basis or a model."""
    return make_html(value)
