"""What users see: warnings, and text that is safe to print on a terminal."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable

SKIPPED_MODULES = ("eigengs_dr", "contextlib", "functools")
"""Modules whose frames a warning skips to reach the caller's line."""


def warn(text: str) -> None:
    """Issue a warning at the line outside of this package that made the call."""
    frame, level = sys._getframe(), 1
    while frame.f_globals.get("__name__", "").partition(".")[0] in SKIPPED_MODULES and frame.f_back:
        frame, level = frame.f_back, level + 1
    warnings.warn(printable(text), stacklevel=level)


def no_attribute(module: str, name: str, names: Iterable[str]) -> AttributeError:
    """Return the error of a name that a module lacks, with the public name that is closest."""
    from difflib import get_close_matches  # only after a mistake

    by_case = {public.casefold(): public for public in names}
    close = get_close_matches(name.casefold(), by_case, 1) if name[0] != "_" else []
    hint = "".join(f"; did you mean {by_case[key]!r}?" for key in close)
    # With `obj` too, Python 3.10 and later add a suggestion of their own.
    return AttributeError(f"module {module!r} has no attribute {name!r}{hint}", name=name)


def printable(text: str) -> str:
    """Escape control characters, and bytes that are not UTF-8, for output on a terminal."""
    return "".join(c if c.isprintable() else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    number = ord(character)
    is_byte = 0xDC80 <= number <= 0xDCFF  # Python's surrogate escapes in file names
    return f"\\x{number - 0xDC00:02x}" if is_byte else repr(character)[1:-1]


def shown(value: object) -> str:
    """Return a value for a message: in one line, and its type if it is long."""
    text = repr(value)
    short = len(text) <= 60 and text.isprintable()
    return text if short else f"of the type {type(value).__name__}"
