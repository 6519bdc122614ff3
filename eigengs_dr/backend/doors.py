"""Doors: the entry points of the package, and the one place where these take the lock of Dr.Jit.

A public function that uses Dr.Jit is a door, and so is each public method of a class of doors.
Functions that are only called from doors need no lock. Work that starts elsewhere takes
`exclusive` itself: a group of images, a block, a task of a cluster.
"""

from __future__ import annotations

from functools import wraps
from inspect import isfunction
from typing import TypeVar, cast

from .arguments import Function, takes_numbers
from .recording import exclusive

Kind = TypeVar("Kind", bound=type)


def door(function: Function) -> Function:
    """Decorate a public function that uses Dr.Jit.

    No other thread uses Dr.Jit during a call. Without the lock, threads crash the process or hang,
    see `eigengs_dr.backend.recording`. NumPy numbers are accepted, see `takes_numbers`. Errors of
    functions of the user pass as they are.
    """
    plain = takes_numbers(function)

    @wraps(function)
    def call(*values: object, **options: object) -> object:
        with exclusive():
            try:
                return plain(*values, **options)
            except RuntimeError as error:
                if isinstance(error.__cause__, StopIteration):  # generators change its type
                    raise error.__cause__ from None
                raise

    return cast(Function, call)


def class_of_doors(kind: Kind) -> Kind:
    """Decorate a class: its public methods and ``[...]`` become doors, its properties do not."""
    for name, member in list(vars(kind).items()):
        if name.startswith("_") and name != "__getitem__":
            continue
        if isinstance(member, classmethod):
            setattr(kind, name, classmethod(door(member.__func__)))
        elif isfunction(member):
            setattr(kind, name, door(member))
    return kind
