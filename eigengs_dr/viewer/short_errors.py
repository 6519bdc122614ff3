"""Errors of this package in a notebook: the line of the cell, and what is wrong with it."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

FOLDER = str(Path(__file__).parent.parent)
"""Code of this package; frames from here on are left out."""

MISTAKES = (ValueError, TypeError, IndexError, OSError)
"""Errors that tell what a caller did; errors of classes of this package count too."""


def install(shell: Any) -> None:
    """Shorten the errors of this package in an IPython shell; ``%tb`` still shows all of them.

    Parameters
    ----------
    shell : IPython.core.interactiveshell.InteractiveShell
    """
    shell.set_custom_exc((Exception, KeyboardInterrupt), show_short)


def show_short(
    shell: Any,
    kind: type[BaseException],
    error: BaseException,
    trace: TracebackType | None,
    tb_offset: int | None = None,
) -> None:
    """Show an error; the handler of IPython's ``set_custom_exc``."""
    own = type(error).__module__.startswith("eigengs_dr.")
    outer = outside(trace) if own or isinstance(error, MISTAKES) else trace
    if outer is trace:
        shell.showtraceback((kind, error, trace), tb_offset=tb_offset)
        return
    # What %tb and %debug read.
    sys.last_type, sys.last_value, sys.last_traceback = kind, error, trace
    reasons = error.__cause__, error.__context__
    error.__cause__ = error.__context__ = None  # the message tells what is worth knowing of them
    lines = shell.InteractiveTB.structured_traceback(kind, error, outer, tb_offset=tb_offset)
    error.__cause__, error.__context__ = reasons
    shell._showtraceback(kind, error, lines)


def outside(trace: TracebackType | None) -> TracebackType | None:
    """Return the frames of a traceback before the first one in this package.

    Returns
    -------
    traceback or None
        The traceback itself if no frame is in this package, or the first one is.
    """
    frames = []
    step = trace
    while step is not None and not step.tb_frame.f_code.co_filename.startswith(FOLDER):
        frames.append(step)
        step = step.tb_next
    while frames and frames[-1].tb_frame.f_code.co_filename == contextlib.__file__:
        frames.pop()  # the lock around functions of this package
    if step is None or not frames:
        return trace
    shown = None
    for frame in reversed(frames):
        shown = TracebackType(shown, frame.tb_frame, frame.tb_lasti, frame.tb_lineno)
    return shown
