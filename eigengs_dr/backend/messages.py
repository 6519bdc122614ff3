"""Lines for people: warnings, and text that a terminal may show."""

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


def printable(text: str) -> str:
    """Escape what may not reach a terminal: control characters, and bytes that are no UTF-8."""
    return "".join(c if c.isprintable() else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    number = ord(character)
    is_byte = 0xDC80 <= number <= 0xDCFF  # as Python keeps bytes of names
    return f"\\x{number - 0xDC00:02x}" if is_byte else repr(character)[1:-1]
