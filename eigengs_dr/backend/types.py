"""Names of types for annotations: Dr.Jit and NumPy arrays.

The Dr.Jit type of an array (llvm or cuda, single or double precision) is known at run time only,
because the same code serves all of them. To type checkers, these names are those of the backend
that Dr.Jit chooses, in single precision: a user's checker reads Dr.Jit's own stubs. The checks of
this repository read ``typings/`` instead, where an array is known by what it holds.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing
from numpy.typing import NDArray

PathLike = str | os.PathLike[str]
"""The path of a file or a folder."""

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

Texture = Any
"""A ``mitsuba.Texture`` of the current variant."""

if TYPE_CHECKING:
    import drjit
    from drjit.auto import ad

    DrJitArray = drjit.AnyArray
    Bool = ad.Bool
    UInt = ad.UInt
    Float = ad.Float
    Array2f = ad.Array2f
    Array3f = ad.Array3f
    Rows = ad.ArrayXf
    Tensor = ad.TensorXf
else:

    class DrJitArray:
        """Placeholder for Dr.Jit arrays, used in annotations only."""

    Bool = UInt = Float = Array2f = Array3f = Rows = Tensor = DrJitArray

ArrayLike = numpy.typing.ArrayLike | DrJitArray
"""What `numpy.asarray` takes, and tensors of Dr.Jit."""

Mask = Bool | bool
"""A mask, or one boolean for all."""

FloatLike = Float | float
"""Floats, or one number for all."""
