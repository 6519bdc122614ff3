"""How Ctrl-C or SIGTERM ends the program ``eigengs-dr``, from its first line on.

A `KeyboardInterrupt` may be raised at any line: during an import it becomes an error that blames
the installation, and inside Dr.Jit an abort. The program therefore raises none: it deletes its
temporary files and exits, except in blocks that stop by themselves, see
`eigengs_dr.backend.interrupts`. Programs that import the package keep their signal handlers.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys

TYPE_CHECKING = False  # importing `typing` or `contextlib` would delay the handlers
if TYPE_CHECKING:
    from collections.abc import Callable

NAME = "eigengs-dr"
"""Name of the program; every line on standard error starts with it."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells define it, and after SIGTERM."""

_undo: dict[object, Callable[[], object]] = {}
"""Functions that the program calls before it exits, the last one first."""

_stderr = -1
"""A copy of standard error, which is redirected while Dr.Jit is imported."""


def is_program() -> bool:
    """Return whether this process is the program itself, not one that imports the package."""
    words = sys.orig_argv[1:3]
    script = os.path.splitext(os.path.basename(words[0]))[0] if words else ""
    return script == NAME or words == ["-m", "eigengs_dr"]


def end_at_signals() -> None:
    """Make Ctrl-C and SIGTERM end this process with one line; an ignored signal stays ignored."""
    global _stderr
    try:
        _stderr = os.dup(2)
    except OSError:
        _stderr = -1  # it is closed
    atexit.register(_ignore_signals)
    defaults = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    for number, handler in defaults.items():
        if signal.getsignal(number) == handler:
            signal.signal(number, end_program)


def end_program(number: int, frame: object) -> None:
    """Handle a signal: delete unfinished files, then end the process."""
    _ignore_signals()
    for undo in reversed([*_undo.values()]):
        try:
            undo()
        except Exception:
            continue  # the next run deletes it
    try:
        clear = b"\r\033[K" if os.isatty(_stderr) else b""  # the line may hold a progress bar
        os.write(_stderr, clear + f"{NAME}: interrupted\n".encode())
    finally:
        os._exit(INTERRUPTED)


def _ignore_signals() -> None:
    """Ignore signals: the exit is under way, and Python is about to drop its handlers."""
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
