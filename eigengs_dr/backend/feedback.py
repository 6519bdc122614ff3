"""What a user sees and presses: pictures in a notebook, bars, warnings, Ctrl-C."""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from inspect import signature
from typing import Any, TypeVar

from .ending import end_program

HTML: list[Callable[[Any], str]] = []
"""The function that makes HTML of objects; `eigengs_dr` puts that of the viewer here."""

DELAY = 2.0
"""Seconds before a bar appears."""

Function = TypeVar("Function", bound=Callable[..., Any])


def printable(text: str) -> str:
    """Escape what may not reach a terminal: control characters, and bytes that are no UTF-8."""
    return "".join(c if c.isprintable() else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    number = ord(character)
    is_byte = 0xDC80 <= number <= 0xDCFF  # as Python keeps bytes of names
    return f"\\x{number - 0xDC00:02x}" if is_byte else repr(character)[1:-1]


def to_html(value: Any) -> str:
    """Return what a notebook shows of an object of this package: pictures and figures."""
    return HTML[0](value)


def shows_progress(function: Function) -> Function:
    """Decorate a function with an argument ``progress``, so that it shows a bar by itself.

    None and True make a bar that appears after `DELAY` seconds, in a notebook or if standard error
    is a terminal. False shows nothing. A function ``progress(done, total, row)`` is called.
    """
    arguments = signature(function)

    @wraps(function)
    def call(*values: Any, **options: Any) -> Any:
        bound = arguments.bind(*values, **options)
        with progress_bar(bound.arguments.get("progress"), function.__name__) as show:
            bound.arguments["progress"] = show
            return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value]


@contextmanager
def progress_bar(progress: Any = None, name: str = "") -> Iterator[Callable[..., None] | None]:
    """Show a bar during a block, and return what reports progress.

    Parameters
    ----------
    progress : bool or callable, optional
        See `shows_progress`.
    name : str, optional
        What stands before the bar.

    Yields
    ------
    callable or None
        ``show(done, total, row)``, or with a label before these; a new label restarts the bar. The
        bar shows ``psnr_rgb`` of the row, which may be left out. None if nobody sees a bar.
    """
    if callable(progress):
        yield progress
        return
    if progress is False or not _is_watched():
        yield None
        return
    from tqdm.auto import tqdm

    with tqdm(desc=name, delay=DELAY, leave=False) as bar:

        def show(*values: Any) -> None:
            if isinstance(values[0], str):
                label, *values = values  # type: ignore[assignment]
                if label != bar.desc:
                    bar.set_description_str(label, refresh=False)
                    if bar.n:  # else it would be shown at once
                        bar.reset()
            done, bar.total, *rest = values
            row = rest[0] if rest else None
            psnr = row.get("psnr_rgb") if isinstance(row, dict) else getattr(row, "psnr_rgb", None)
            if psnr is not None:
                bar.set_postfix_str(f"psnr_rgb {psnr:.2f} dB", refresh=False)
            bar.update(done - bar.n)

        yield show


def _is_watched() -> bool:
    """Return whether somebody sees a bar: in a notebook, or in a terminal."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is not None and hasattr(shell, "kernel"):
        return True
    return sys.stderr is not None and sys.stderr.isatty()


Handler = Any
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

    A second signal ends the process. The block changes nothing in other threads than the main
    thread, nor where something else handles a signal, such as `defer_interrupts`.

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

    In the main thread alone, and for signals whose handler may be replaced.
    """
    handlers = {number: signal.getsignal(number) for number in numbers}
    handlers = {number: old for number, old in handlers.items() if replaced(old)}
    if threading.current_thread() is not threading.main_thread():
        handlers = {}

    def restore() -> None:
        for number, old in handlers.items():
            signal.signal(number, old)

    def handle(number: int, frame: Any) -> None:
        restore()
        react()

    for number in handlers:
        signal.signal(number, handle)
    try:
        yield
    finally:
        restore()


OWN = ("eigengs_dr", "contextlib", "functools")
"""Modules between the fault and the user's line."""


def warn(text: str) -> None:
    """Warn of something in the line outside of this package that called it."""
    frame, level = sys._getframe(), 1
    while frame.f_globals.get("__name__", "").partition(".")[0] in OWN and frame.f_back:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, stacklevel=level)
