"""Progress bars for long calls, in a terminal or a notebook."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from inspect import signature
from typing import Any, TypeVar

DELAY = 2.0
"""Seconds before a bar appears."""

Progress = Callable[..., None] | bool | None
"""Values of the argument ``progress``, see `shows_progress`."""

Function = TypeVar("Function", bound=Callable[..., object])


def shows_progress(function: Function) -> Function:
    """Decorate a function with an argument ``progress``, so that it shows a progress bar.

    None and True show a bar after `DELAY` seconds, in a notebook or if standard error is a
    terminal. False shows nothing. A function is called as ``progress(done, total, row)``.
    """
    arguments = signature(function)

    @wraps(function)
    def call(*values: object, **options: object) -> object:
        bound = arguments.bind(*values, **options)
        with progress_bar(bound.arguments.get("progress"), function.__name__) as show:
            bound.arguments["progress"] = show
            return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value]


@contextmanager
def progress_bar(progress: Progress = None, name: str = "") -> Iterator[Callable[..., None] | None]:
    """Show a bar during a block, and yield a function that updates it.

    Parameters
    ----------
    progress : bool or callable, optional
        See `shows_progress`.
    name : str, optional
        Text before the bar.

    Yields
    ------
    callable or None
        ``show(done, total, row)``, optionally with a label as the first argument; a new label
        restarts the bar. The bar shows ``psnr_rgb`` of the row, or its loss; the row may be left
        out. None if no bar is visible.
    """
    if callable(progress):
        yield progress
        return
    if not (progress is None or isinstance(progress, bool)):
        raise ValueError(f"progress is {progress!r}; pass True, False or a function")
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
                    if bar.n:  # otherwise the bar would appear at once
                        bar.reset()
            done, bar.total, *rest = values
            row = rest[0] if rest else None
            figures = row if isinstance(row, dict) else {"psnr_rgb": getattr(row, "psnr_rgb", None)}
            if figures.get("psnr_rgb") is not None:
                bar.set_postfix_str(f"psnr_rgb {figures['psnr_rgb']:.2f} dB", refresh=False)
            elif "loss" in figures:
                bar.set_postfix_str(f"loss {figures['loss']:.4g}", refresh=False)
            bar.update(done - bar.n)

        yield show


def _is_watched() -> bool:
    """Return whether a bar is visible, in a notebook or in a terminal."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is not None and hasattr(shell, "kernel"):
        return True
    try:
        return bool(sys.stderr.isatty())
    except (AttributeError, ValueError):  # there is none, it has no such method, or it is closed
        return False
