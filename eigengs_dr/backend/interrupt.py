"""Ctrl-C between steps instead of inside one."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def defer_interrupts() -> Iterator[Callable[[], bool]]:
    """Remember Ctrl-C while a block runs, so that the block can end where it is whole.

    Inside a frozen function or a loop that is being traced, Dr.Jit turns `KeyboardInterrupt` into a
    `RuntimeError` and leaves the work half done. A second Ctrl-C does what it always did. Outside
    the main thread, which receives no signals, nothing changes.

    Yields
    ------
    callable
        ``pressed() -> bool``: whether Ctrl-C was pressed since the block began.

    Examples
    --------
    >>> with deferred() as pressed:
    ...     pressed()
    False
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    previous = signal.getsignal(signal.SIGINT)
    if previous in (None, signal.SIG_IGN):  # not Python's to handle, or not wanted
        yield lambda: False
        return
    presses = []

    def remember(number: int, frame: Any) -> None:
        presses.append(number)
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, remember)
    try:
        yield lambda: bool(presses)
    finally:
        signal.signal(signal.SIGINT, previous)
