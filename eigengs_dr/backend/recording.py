"""Programs of Dr.Jit traced once and replayed, with the garbage collector kept out."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr


@contextmanager
def freeze_program(function: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Freeze a function by `drjit.freeze` for a block, and free its program after it.

    While Dr.Jit 1.5 records a program, the process ends if anything frees another program, or an
    array that borrows NumPy's memory. Both happen wherever the garbage collector comes upon what
    was left in a cycle, so it waits during calls; and the program is freed here, not by it.

    Parameters
    ----------
    function : callable
        See `drjit.freeze` for what it may do.

    Yields
    ------
    callable
        Takes and returns what the function does.
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
