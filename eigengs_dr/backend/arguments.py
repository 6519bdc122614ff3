"""Numbers that callers give: those of Python and of NumPy, but no truth values and no text."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from numbers import Integral, Real
from typing import Any, TypeVar

from .types import Record

Function = TypeVar("Function", bound=Callable[..., object])

KINDS: dict[str, type] = {"int": int, "int | None": int, "float": float, "float | None": float}
"""The type of number that an annotation stands for."""


def plain_numbers(values: Mapping[str, object], annotations: Mapping[str, str]) -> Record:
    """Return the numbers among named values as numbers of Python.

    Numbers of NumPy would promote Dr.Jit arrays to double precision, and JSON has none of them.

    Parameters
    ----------
    values : mapping of str to object
    annotations : mapping of str to str
        Annotations of the values; those of numbers are "int" and "float", perhaps with "| None".

    Raises
    ------
    ValueError
        If something else stands where a number belongs.
    """
    return {
        name: _plain(name, value, KINDS[annotations[name]])
        for name, value in values.items()
        if annotations.get(name) in KINDS and value is not None
    }


def _plain(name: str, value: object, kind: type) -> Any:
    # NumPy registers its numbers with these classes, and its truth values with none.
    if isinstance(value, bool) or not isinstance(value, Integral if kind is int else Real):
        must = "a whole number" if kind is int else "a number"
        raise ValueError(f"{name} is {value!r}; it must be {must}")
    return kind(value)


def takes_numbers(function: Function) -> Function:
    """Decorate a function whose numbers may be those of NumPy, see `plain_numbers`."""
    arguments = signature(function)
    annotations = {name: p.annotation for name, p in arguments.parameters.items()}
    if not any(annotation in KINDS for annotation in annotations.values()):
        return function

    @wraps(function)
    def call(*values: object, **options: object) -> object:
        bound = arguments.bind(*values, **options)
        bound.arguments.update(plain_numbers(bound.arguments, annotations))
        return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value]
