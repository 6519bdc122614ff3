"""The words of annotations: arrays of Dr.Jit, and arrays of NumPy.

Which types of Dr.Jit an array has, of llvm or cuda, in single or double precision, is known at run
time only: the same code serves all. What a checker can know is what an array holds, and that is
what these names say. It then refuses a mask where a number belongs, or a row for several rows.
Functions of Dr.Jit itself take and return anything, as far as a checker sees.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

PathLike = str | os.PathLike[str]
"""The path of a file or a folder, or a URL."""

Doubles = NDArray[np.float64]
Singles = NDArray[np.float32]
Floats = NDArray[np.floating]
"""Floats of NumPy: of double, of single, of either precision."""

Integers = NDArray[np.int64]
"""Integers of NumPy."""

Values = NDArray[Any]
"""A NumPy array of any dtype."""

Arrays = dict[str, Values]
"""Arrays of NumPy by their names, as in a file."""

Record = dict[str, Any]
"""Numbers, texts and lists of them by their names, as in JSON."""

if TYPE_CHECKING:
    from typing_extensions import Self

    Other = TypeVar("Other", contravariant=True)

    class DrJitArray:
        """What all arrays of Dr.Jit have."""

        index: int
        state: object
        shape: tuple[int, ...]

        def __init__(self, *values: object) -> None: ...
        def __len__(self) -> int: ...
        def __eq__(self, other: object) -> bool: ...
        def numpy(self) -> Singles:
            """Return a copy, or a view."""

    class Bool(DrJitArray):
        """A mask."""

        def __and__(self, other: Bool | bool) -> Bool: ...
        def __invert__(self) -> Bool: ...

        __or__ = __xor__ = __rand__ = __ror__ = __and__

    class Numbers(DrJitArray, Generic[Other]):
        """What computes with others: the type parameter."""

        def __add__(self, other: Other) -> Self: ...
        def __neg__(self) -> Self: ...

        __sub__ = __mul__ = __radd__ = __rsub__ = __rmul__ = __add__

        def __lt__(self, other: Other) -> Bool: ...

        __le__ = __gt__ = __ge__ = __lt__

    class UInt(Numbers["UInt | int"]):
        """Integers of 32 bits, with or without a sign."""

        def __getitem__(self, place: int) -> int: ...
        def __invert__(self) -> UInt: ...
        def __and__(self, other: UInt | int) -> UInt: ...

        __or__ = __xor__ = __lshift__ = __rshift__ = __floordiv__ = __mod__ = __and__

    class Float(Numbers["Float | UInt | float"]):
        """Floats."""

        def __getitem__(self, place: int) -> float: ...
        def __truediv__(self, other: Float | UInt | float) -> Float: ...

        __rtruediv__ = __truediv__

    class Rows(Numbers["Rows | Float | float"]):
        """Several rows of floats: an Array2f, Array3f or ArrayXf."""

        def __getitem__(self, row: int) -> Float: ...
        def __setitem__(self, row: int, value: Float) -> None: ...
        def __iter__(self) -> Iterator[Float]: ...
        def __truediv__(self, other: Rows | Float | float) -> Rows: ...

    class Tensor(DrJitArray):
        """A tensor of floats."""

        array: Float

        def __getitem__(self, part: object) -> Tensor: ...

else:  # whatever Dr.Jit gives

    class DrJitArray:
        """Stands for the arrays of Dr.Jit in annotations alone."""

    Bool = UInt = Float = Rows = Tensor = DrJitArray

Mask = Bool | bool
"""A mask, or one truth value for all."""

FloatLike = Float | float
"""Floats, or one number for all."""
