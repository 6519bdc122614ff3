"""Ctrl-C and SIGTERM during a call: the call stops between two steps, or cleans up."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from .ending import end_program

Handler = Callable[[int, FrameType | None], object] | int | None
"""What `signal.getsignal` returns."""

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
        ``interrupted() -> bool``: whether the block has received a signal.

    Examples
    --------
    >>> with defer_interrupts() as interrupted:
    ...     interrupted()
    False
    """
    received: list[bool] = []
    with _first_signal(SIGNALS, _is_heard, lambda: received.append(True)):
        yield lambda: bool(received)


def _is_heard(handler: Handler) -> bool:
    # Python cannot restore a handler that is None; an ignored signal stays ignored.
    return handler not in (None, signal.SIG_IGN)


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

    with _first_signal(
        SIGNALS, lambda handler: handler in (signal.SIG_DFL, end_program), interrupt
    ):
        yield


@contextmanager
def _first_signal(
    numbers: Iterable[signal.Signals],
    replaced: Callable[[Handler], bool],
    react: Callable[[], None],
) -> Iterator[None]:
    """Call a function at the first signal in a block; a second one has its usual effect.

    This has an effect in the main thread only, for signals whose handler may be replaced.
    """
    handlers = {number: signal.getsignal(number) for number in numbers}
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
