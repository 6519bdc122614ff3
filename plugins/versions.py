"""The one place for what Mitsuba 3.9 does differently from what its interface says."""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import cache, partial
from operator import methodcaller
from typing import Any

import mitsuba as mi
import numpy as np

Texture = Any
"""A ``mitsuba.Texture`` of the current variant."""


def register(kind: str, name: str, create: Callable[[mi.Properties], Any]) -> None:
    """Register a plugin ("texture", "emitter" or "bsdf") with the current variant."""
    getattr(mi, f"register_{kind}")(name, reason_first(create))


@cache
def columns_beyond() -> tuple[int, int]:
    """Return how many columns an ``envmap`` repeats beyond its left and its right border.

    Mitsuba 3.9 repeats one on both sides, and others one on the right side alone.
    """
    columns = 4
    black = mi.Bitmap(np.zeros((columns, columns, 3), np.float32))
    small = mi.load_dict({"type": "envmap", "bitmap": black})
    beyond = mi.traverse(small)["data"].shape[1] - columns
    return beyond // 2, beyond - beyond // 2


_ended: Generator[None] = (_ for _ in ())
_ended.close()  # its method `throw` raises an error, and adds no traceback


def reason_first(create: Callable[[mi.Properties], Any]) -> type:
    """Return a class that calls `create` and raises its errors without a traceback.

    Mitsuba prints an error of a plugin as nanobind does: the traceback, then what went wrong. Every
    Python function that an error passes adds to the traceback. So `__new__` returns the error, and
    ``__init__``, which runs no Python code, raises it.
    """

    class Created:
        made = create

        def __new__(cls, props: mi.Properties) -> Any:
            try:
                return create(props)
            except Exception as error:
                refusal = object.__new__(cls)
                refusal.end = partial(_ended.throw, error.with_traceback(None))
                return refusal

        end: Callable[[], None]
        __init__ = property(methodcaller("end"))

    return Created
