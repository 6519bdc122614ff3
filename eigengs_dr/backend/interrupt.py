"""Ctrl-C and SIGTERM between steps instead of inside one."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask a program to end: Ctrl-C, and the one that schedulers and ``kill`` send."""


@contextmanager
def defer_interrupts() -> Iterator[Callable[[], bool]]:
    """Remember Ctrl-C and SIGTERM while a block runs, so that the block can end where it is whole.

    Inside a frozen function or a loop that is being traced, Dr.Jit turns `KeyboardInterrupt` into a
    `RuntimeError` and leaves the work half done. A second signal does what it did before the block.
    Outside the main thread, which receives no signals, nothing changes.

    Yields
    ------
    callable
        ``pressed() -> bool``: whether a signal came since the block began.

    Examples
    --------
    >>> with defer_interrupts() as pressed:
    ...     pressed()
    False
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    # None is a handler that is not Python's; an ignored signal stays ignored.
    handlers = {n: old for n, old in handlers.items() if old not in (None, signal.SIG_IGN)}
    received = []

    def remember(number: int, frame: Any) -> None:
        received.append(number)
        restore()

    def restore() -> None:
        for number, old in handlers.items():
            signal.signal(number, old)

    for number in handlers:
        signal.signal(number, remember)
    try:
        yield lambda: bool(received)
    finally:
        restore()
