"""Frozen programs of Dr.Jit: traced once, replayed, and safe from the garbage collector."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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

    def call(*arguments: Any) -> Any:
        running = gc.isenabled()
        gc.disable()
        try:
            return program(*arguments)
        finally:
            if running:
                gc.enable()

    try:
        yield call
    finally:
        program.clear()
