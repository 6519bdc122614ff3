"""Names of types for annotations: Dr.Jit and NumPy arrays.

The Dr.Jit type of an array (llvm or cuda, single or double precision) is known at run time only,
because the same code serves all of them. These names tell a type checker what an array holds, so
that it rejects a mask in the place of a number, or one row in the place of several. To a checker,
Dr.Jit's own functions take and return anything.
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
"""NumPy floats in double, in single and in either precision."""

Integers = NDArray[np.int64]
"""NumPy integers."""

Values = NDArray[Any]
"""A NumPy array of any dtype."""

Arrays = dict[str, Values]
"""NumPy arrays by name, as in a file."""

Record = dict[str, Any]
"""Numbers, strings and lists by name, as in JSON."""

if TYPE_CHECKING:
    from typing_extensions import Self

    Other = TypeVar("Other", contravariant=True)

    class DrJitArray:
        """Attributes of all Dr.Jit arrays."""

        index: int
        state: object
        shape: tuple[int, ...]

        def __init__(self, *values: object) -> None: ...
        def __len__(self) -> int: ...
        def __eq__(self, other: object) -> bool: ...
        def numpy(self) -> Singles:
            """Return a copy or a view."""

    class Bool(DrJitArray):
        """A mask."""

        def __and__(self, other: Bool | bool) -> Bool: ...
        def __invert__(self) -> Bool: ...

        __or__ = __xor__ = __rand__ = __ror__ = __and__

    class Numbers(DrJitArray, Generic[Other]):
        """Arrays with arithmetic; the type parameter is the type of the other operand."""

        def __add__(self, other: Other) -> Self: ...
        def __neg__(self) -> Self: ...

        __sub__ = __mul__ = __radd__ = __rsub__ = __rmul__ = __add__

        def __lt__(self, other: Other) -> Bool: ...

        __le__ = __gt__ = __ge__ = __lt__

    class UInt(Numbers["UInt | int"]):
        """32-bit integers, signed or unsigned."""

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

else:

    class DrJitArray:
        """Placeholder for Dr.Jit arrays, used in annotations only."""

    Bool = UInt = Float = Rows = Tensor = DrJitArray

Mask = Bool | bool
"""A mask, or one boolean for all."""

FloatLike = Float | float
"""Floats, or one number for all."""
