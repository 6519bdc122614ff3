"""What all charts share: their colours, and files that one run and the next write alike."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..storage.atomic import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".svg", ".png", ".pdf")
"""Kinds of charts that are written."""

COLORS = {
    "default": "#0b6e99",
    "gaussianimage": "#b5442f",
    "eigengs": "#5a8f3c",
}
"""Lines of the presets: told apart also where red and green look alike, by their lightness."""


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure, sides in inches, that arranges its parts itself.

    Raises
    ------
    ValueError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure  # not pyplot, which looks for a screen
    except ImportError as error:
        raise ValueError(f"{error}; charts need: pip install 'eigengs-dr[charts]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(path: str | os.PathLike[str], figure: Figure) -> None:
    """Write a chart, whole or not at all; equal charts give equal files.

    Parameters
    ----------
    path : path-like
        Ends in one of `SUFFIXES`.
    figure : matplotlib.figure.Figure

    Raises
    ------
    ValueError
        If the suffix is another.
    OSError
        If the file cannot be written.
    """
    import matplotlib

    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: the name must end in {', '.join(SUFFIXES)}")
    # Names in an SVG file are else drawn at random.
    metadata: dict[str, Any] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with atomic_write(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "eigengs_dr"}):
        figure.savefig(temporary, format=suffix[1:], dpi=90, metadata=metadata.get(suffix))
