"""Ctrl-C and SIGTERM: how they end the program ``eigengs-dr``, and how a block stops or cleans up.

A `KeyboardInterrupt` may be raised at any line: during an import it becomes an error that blames
the installation, and inside Dr.Jit an abort. From its first line on, the program therefore raises
none: it deletes its temporary files and exits, except in the blocks of `defer_interrupts` and
`terminate_as_interrupt`. Programs that import the package keep their signal handlers.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

NAME = "eigengs-dr"
"""Name of the program; every line on standard error starts with it."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells define it, and after SIGTERM."""

_undo: dict[object, Callable[[], object]] = {}
"""Functions that the program calls before it exits, the last one first."""

_stderr = -1
"""A copy of standard error, which is redirected while Dr.Jit is imported."""

Handler = Callable[[int, FrameType | None], object] | int | None
"""What `signal.getsignal` returns."""

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask a program to end: Ctrl-C sends SIGINT, schedulers and ``kill`` send SIGTERM."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM ended a call between two steps.

    Attributes
    ----------
    result : object
        What the call has finished; its documentation says of which type.
    """

    def __init__(self, result: Any, message: str) -> None:
        super().__init__(message)
        self.result = result

    def __reduce__(self) -> tuple:
        return type(self), (self.result, str(self))


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
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def undone_at_end(undo: Callable[[], object]) -> Iterator[None]:
    """Call a function if a signal ends the program during a block."""
    key = object()
    _undo[key] = undo
    try:
        yield
    finally:
        del _undo[key]


@contextmanager
def defer_interrupts() -> Iterator[Callable[[], bool]]:
    """Record Ctrl-C and SIGTERM during a block, so that the block can stop between two steps.

    Dr.Jit turns a `KeyboardInterrupt` inside a frozen function or a traced loop into a
    `RuntimeError`. The first signal is only recorded; a second signal has its usual effect. Only
    the main thread receives signals, so the block changes nothing in other threads.

    Yields
    ------
    callable
        ``interrupted() -> bool``: whether the block has received a signal.

    Examples
    --------
    >>> with defer_interrupts() as interrupted:
    ...     interrupted()
    False
    """
    received: list[bool] = []
    # Python cannot restore a handler that is None; an ignored signal stays ignored.
    ignored = None, signal.SIG_IGN
    with _first_signal(lambda handler: handler not in ignored, lambda: received.append(True)):
        yield lambda: bool(received)


@contextmanager
def terminate_as_interrupt() -> Iterator[None]:
    """Turn Ctrl-C and SIGTERM into a `KeyboardInterrupt` during a block, so that it cleans up.

    A second signal ends the process. The block has an effect in the main thread only, and leaves
    alone signals that something else handles, such as `defer_interrupts`.

    Raises
    ------
    KeyboardInterrupt
        At a signal.
    """

    def interrupt() -> None:
        raise KeyboardInterrupt

    with _first_signal(lambda handler: handler in (signal.SIG_DFL, end_program), interrupt):
        yield


@contextmanager
def _first_signal(replaced: Callable[[Handler], bool], react: Callable[[], None]) -> Iterator[None]:
    """Call a function at the first signal in a block; a second one has its usual effect.

    This has an effect in the main thread only, for signals whose handler may be replaced.
    """
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    handlers = {number: old for number, old in handlers.items() if replaced(old)}
    if threading.current_thread() is not threading.main_thread():
        handlers = {}

    def restore() -> None:
        for number, old in handlers.items():
            signal.signal(number, old)

    def handle(number: int, frame: object) -> None:
        restore()
        react()

    for number in handlers:
        signal.signal(number, handle)
    try:
        yield
    finally:
        restore()
