"""Frozen programs of Dr.Jit: traced once, replayed, and safe from the garbage collector."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

import drjit as dr


@contextmanager
def freeze_program(function: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Freeze a function with `drjit.freeze` during a block, and free its program after the block.

    While Dr.Jit 1.5 records a program, the process ends if Python frees another program or an array
    that shares NumPy's memory. The garbage collector frees such objects at any time if a reference
    cycle holds them. Therefore the collector is off during calls, and the block frees the program.

    Parameters
    ----------
    function : callable
        A function that `drjit.freeze` accepts.

    Yields
    ------
    callable
        The frozen function, with the arguments and the result of `function`.
    """
    program = dr.freeze(function)
    try:
        yield without_collector(program)
    finally:
        program.clear()


def without_collector(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that runs without Python's garbage collector.

    Lookups of a texture need it too: Mitsuba calls them while it records a program. If the
    collector frees another scene during the recording, the program loses the textures of that
    scene; it then ends the process or reads freed memory.

    Parameters
    ----------
    function : callable

    Returns
    -------
    callable
        With the arguments and the result of `function`.
    """

    @wraps(function)
    def call(*arguments: Any, **settings: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()
        try:
            return function(*arguments, **settings)
        finally:
            if collects:
                gc.enable()

    return call
