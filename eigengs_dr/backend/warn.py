"""Warnings that name the line of the user's program, however deep in this package they arise."""

from __future__ import annotations

import sys
import warnings

OWN = ("eigengs_dr", "contextlib", "functools")
"""Modules between the fault and the user's line."""


def warn(text: str) -> None:
    """Warn of something in the line outside of this package that called it."""
    frame, level = sys._getframe(), 1
    while frame.f_globals.get("__name__", "").partition(".")[0] in OWN and frame.f_back:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, stacklevel=level)
