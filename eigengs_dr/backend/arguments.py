"""Checks of numeric arguments: Python and NumPy numbers are accepted, booleans and text are not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from numbers import Integral, Real
from typing import Any, TypeVar

from .types import Record

Function = TypeVar("Function", bound=Callable[..., object])

KINDS: dict[str, type] = {"int": int, "int | None": int, "float": float, "float | None": float}
"""The numeric type that each annotation stands for."""


def plain_numbers(values: Mapping[str, object], annotations: Mapping[str, str]) -> Record:
    """Return the numbers among named values as Python numbers.

    NumPy numbers would promote Dr.Jit arrays to double precision, and JSON cannot store them.

    Parameters
    ----------
    values : mapping of str to object
    annotations : mapping of str to str
        Annotations of the values. Those of numbers are "int" or "float", optionally with "| None".

    Raises
    ------
    ValueError
        If an argument that is annotated as a number has another type.
    """
    return {
        name: _plain(name, value, KINDS[annotations[name]])
        for name, value in values.items()
        if annotations.get(name) in KINDS
        and not (value is None and annotations[name].endswith("None"))
    }


def _plain(name: str, value: object, kind: type) -> Any:
    # NumPy registers its numbers with these classes, but not its booleans.
    if isinstance(value, bool) or not isinstance(value, Integral if kind is int else Real):
        expected = "a whole number" if kind is int else "a number"
        raise ValueError(f"{name} is {value!r}; it must be {expected}")
    return kind(value)


def takes_numbers(function: Function) -> Function:
    """Decorate a function so that it accepts NumPy numbers, see `plain_numbers`."""
    arguments = signature(function)
    annotations = {name: p.annotation for name, p in arguments.parameters.items()}
    if not any(annotation in KINDS for annotation in annotations.values()):
        return function

    @wraps(function)
    def call(*values: object, **options: object) -> object:
        try:
            bound = arguments.bind(*values, **options)
        except TypeError as error:  # as Python says it, which names the function
            raise TypeError(f"{function.__qualname__}() {error}") from None
        bound.arguments.update(plain_numbers(bound.arguments, annotations))
        return function(*bound.args, **bound.kwargs)

    return call  # type: ignore[return-value]
