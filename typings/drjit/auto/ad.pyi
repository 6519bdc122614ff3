"""Types of arrays by what they hold, whatever their backend and precision are.

They reject a mask in the place of a number, or one row in the place of several.
"""

from collections.abc import Iterator
from typing import Generic, TypeVar

from drjit import AnyArray
from typing_extensions import Self

Other = TypeVar("Other", contravariant=True)

class Bool(AnyArray):
    """A mask."""

    def __and__(self, other: Bool | bool) -> Bool: ...
    def __invert__(self) -> Bool: ...

    __or__ = __xor__ = __rand__ = __ror__ = __and__

class Numbers(AnyArray, Generic[Other]):
    """Arrays with arithmetic; the type parameter is the type of the other operand."""

    def __add__(self, other: Other) -> Self: ...
    def __neg__(self) -> Self: ...

    __sub__ = __mul__ = __radd__ = __rsub__ = __rmul__ = __add__

    def __lt__(self, other: Other) -> Bool: ...

    __le__ = __gt__ = __ge__ = __lt__

class UInt(Numbers[UInt | int]):
    """32-bit integers, signed or unsigned."""

    def __getitem__(self, place: int) -> int: ...
    def __invert__(self) -> UInt: ...
    def __and__(self, other: UInt | int) -> UInt: ...

    __or__ = __xor__ = __lshift__ = __rshift__ = __floordiv__ = __mod__ = __and__

class Float(Numbers[Float | UInt | float]):
    """Floats."""

    def __getitem__(self, place: int) -> float: ...
    def __truediv__(self, other: Float | UInt | float) -> Float: ...

    __rtruediv__ = __truediv__

class ArrayXf(Numbers[ArrayXf | Float | float]):
    """Several rows of floats, of any number."""

    def __getitem__(self, row: int) -> Float: ...
    def __setitem__(self, row: int, value: Float) -> None: ...
    def __iter__(self) -> Iterator[Float]: ...
    def __truediv__(self, other: ArrayXf | Float | float) -> ArrayXf: ...

Array2f = ArrayXf
Array3f = ArrayXf

class TensorXf(AnyArray):
    """A tensor of floats."""

    array: Float

    def __getitem__(self, part: object) -> TensorXf: ...
