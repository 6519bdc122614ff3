"""What a notebook or a terminal shows, made of objects of the folders above this one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from inspect import signature
from pkgutil import resolve_name
from typing import Any, TypeVar

NOTEBOOK = "eigengs_dr.viewer.notebook:to_html"
"""The function that makes HTML of objects, imported when a notebook shows the first."""

DELAY = 2.0
"""Seconds before a bar appears."""

Function = TypeVar("Function", bound=Callable[..., Any])


def to_html(value: Any) -> str:
    """Return what a notebook shows of an object of this package: pictures and figures."""
    html: str = resolve_name(NOTEBOOK)(value)
    return html


def shows_progress(function: Function) -> Function:
    """Decorate a function with an argument ``progress``, so that it shows a bar by itself.

    None and True make a bar that appears after `DELAY` seconds, in a notebook or if standard error
    is a terminal. False shows nothing. A function ``progress(done, total, row)`` is called.
    """
    arguments = signature(function)

    @wraps(function)
    def call(*values: Any, **options: Any) -> Any:
        bound = arguments.bind(*values, **options)
        with _reporter(bound.arguments.get("progress"), function.__name__) as show:
            bound.arguments["progress"] = show
            return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value]


@contextmanager
def _reporter(progress: Any, name: str) -> Iterator[Callable[..., None] | None]:
    """Return what reports progress: a function, or None."""
    if callable(progress):
        yield progress
        return
    if progress is False or not _is_watched():
        yield None
        return
    from tqdm.auto import tqdm

    with tqdm(desc=name, delay=DELAY, leave=False) as bar:

        def show(*values: Any) -> None:
            if isinstance(values[0], str):  # the name of a stage is first
                bar.set_description_str(values[0], refresh=False)
                values = values[1:]
            done, total, *rest = values
            row = rest[0] if rest else None
            bar.total = total
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
