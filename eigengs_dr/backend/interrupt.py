"""Interrupts that wait for the end of a step."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask a program to end: Ctrl-C sends SIGINT, schedulers and ``kill`` send SIGTERM."""


@contextmanager
def defer_interrupts() -> Iterator[Callable[[], bool]]:
    """Record Ctrl-C and SIGTERM during a block, so that the block can stop between two steps.

    Dr.Jit turns a `KeyboardInterrupt` inside a frozen function or a traced loop into a
    `RuntimeError`. The first signal is only recorded; a second signal has its usual effect. Only
    the main thread receives signals, so the block changes nothing in other threads.

    Yields
    ------
    callable
        ``pressed() -> bool``: whether the block has received a signal.

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
    # Python cannot restore a handler that is None; an ignored signal stays ignored.
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


@contextmanager
def terminate_as_interrupt() -> Iterator[None]:
    """Turn SIGTERM into a `KeyboardInterrupt` during a block, so that the block cleans up.

    A second SIGTERM ends the process. The block changes nothing in other threads than the main
    thread, nor where something else handles SIGTERM, such as `defer_interrupts`.

    Raises
    ------
    KeyboardInterrupt
        At SIGTERM.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
