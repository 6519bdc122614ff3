"""The end of the program ``eigengs-dr`` by Ctrl-C or SIGTERM, from its first line on.

A `KeyboardInterrupt` may be raised in any line: in an import it becomes an error that blames the
installation, in Dr.Jit an abort. So the program raises none. It deletes its temporary files and
ends, but in blocks that end their work by themselves, see `eigengs_dr.backend.interrupts`. What
uses the package as a library has the signals as they were.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys

TYPE_CHECKING = False  # `typing` and `contextlib` take longer than all else before the first line
if TYPE_CHECKING:
    from collections.abc import Callable

NAME = "eigengs-dr"
"""Name of the program; every line on standard error starts with it."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells define it, and after SIGTERM."""

_undo: dict[object, Callable[[], object]] = {}
"""What the program calls before it ends, the last first."""

_stderr = -1
"""A copy of standard error, which an import of Dr.Jit hides for a moment."""


def is_program() -> bool:
    """Return whether this process is the program itself, and none that imports the package."""
    words = sys.orig_argv[1:3]
    script = os.path.splitext(os.path.basename(words[0]))[0] if words else ""
    return script == NAME or words == ["-m", "eigengs_dr"]


def end_at_signals() -> None:
    """Let Ctrl-C and SIGTERM end this process with one line; an ignored signal stays ignored."""
    global _stderr
    try:
        _stderr = os.dup(2)
    except OSError:
        _stderr = -1  # it is closed
    atexit.register(_ignore_signals)
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    for number, handler in usual.items():
        if signal.getsignal(number) == handler:
            signal.signal(number, end_program)


def end_program(number: int, frame: object) -> None:
    """End the process as the handler of a signal; what is under way is deleted first."""
    _ignore_signals()
    for undo in reversed([*_undo.values()]):
        try:
            undo()
        except Exception:
            continue  # the next run deletes it
    try:
        clear = b"\r\033[K" if os.isatty(_stderr) else b""  # a bar may stand there
        os.write(_stderr, clear + f"{NAME}: interrupted\n".encode())
    finally:
        os._exit(INTERRUPTED)


def _ignore_signals() -> None:
    """Ignore signals: from here on the end takes no time, and Python forgets its handlers."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


class undone_at_end:
    """Call a function if a signal ends the program during a block."""

    def __init__(self, undo: Callable[[], object]) -> None:
        self.undo = undo

    def __enter__(self) -> None:
        _undo[self] = self.undo

    def __exit__(self, *error: object) -> None:
        del _undo[self]
