"""Array types of one Dr.Jit backend and precision, and copies of NumPy arrays."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterable
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray


class ArrayTypes(NamedTuple):
    """The array types of one backend and one float precision."""

    Float: Any
    Int: Any
    UInt: Any
    Bool: Any
    Float2: Any
    Float3: Any
    Float4: Any
    UInt2: Any
    FloatX: Any
    Tensor: Any
    backend: str
    bits: int


def types_of(array: Any) -> ArrayTypes:
    """Return the array types with the backend and the precision of a Dr.Jit array.

    Parameters
    ----------
    array : Dr.Jit array
        A floating-point array of any depth from ``drjit.llvm.ad`` or ``drjit.cuda.ad``.

    Returns
    -------
    ArrayTypes

    Raises
    ------
    TypeError
        If the array is not a floating-point array of ``drjit.llvm.ad`` or ``drjit.cuda.ad``.
    """
    leaf = dr.leaf_t(array)
    module = leaf.__module__
    if module not in ("drjit.llvm.ad", "drjit.cuda.ad") or not dr.is_float_v(leaf):
        raise TypeError(
            "expected float arrays of drjit.llvm.ad or drjit.cuda.ad, "
            f"got {type(array).__module__}.{type(array).__name__}"
        )
    return _types(module, 64 if dr.type_v(leaf) == dr.VarType.Float64 else 32)


def types_in(module: Any, bits: int = 32) -> ArrayTypes:
    """Return the types of ``drjit.llvm.ad`` or ``drjit.cuda.ad`` with 32 or 64 bits a float."""
    return _types(module.__name__, bits)


def _types(module: str, bits: int) -> ArrayTypes:
    names = sys.modules[module]
    suffix = "64" if bits == 64 else ""

    def of(name: str) -> Any:
        return getattr(names, name + suffix)

    return ArrayTypes(
        Float=of("Float"),
        Int=names.Int32,
        UInt=names.UInt32,
        Bool=names.Bool,
        Float2=of("Array2f"),
        Float3=of("Array3f"),
        Float4=of("Array4f"),
        UInt2=names.Array2u,
        FloatX=of("ArrayXf"),
        Tensor=of("TensorXf"),
        backend=module.split(".")[1],
        bits=bits,
    )


def release_memory() -> None:
    """Give memory that is free back to the system: that of Dr.Jit, and that of the C library.

    Both keep what was freed for later. After a step of a fit that takes much memory, nothing later
    asks for blocks of these sizes.
    """
    dr.flush_malloc_cache()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc; others have none
        if trim is not None:
            trim(0)


def upload(kind: Any, values: NDArray[Any]) -> Any:
    """Copy a flat NumPy array into memory that Dr.Jit owns.

    ``kind(values)`` may share NumPy's memory, which may be unaligned. Dr.Jit then replaces packet
    gathers by single gathers, which are 10 times slower, and traces a frozen function again.

    Parameters
    ----------
    kind : type
        Dr.Jit array type, e.g. ``drjit.llvm.ad.Float``.
    values : ndarray, shape (n,)
        Any dtype that converts to `kind`.

    Returns
    -------
    Dr.Jit array of type `kind`, shape (n,)
        Evaluated.
    """
    return upload_rows(kind, [values])[0]


def upload_tensor(kind: Any, values: NDArray[Any]) -> Any:
    """Copy a NumPy array of any shape into a Dr.Jit tensor, as `upload` does.

    Parameters
    ----------
    kind : type
        Dr.Jit tensor type, e.g. ``drjit.llvm.ad.TensorXf``.
    values : ndarray
    """
    return kind(upload(dr.array_t(kind), values.ravel()), values.shape)


def upload_rows(kind: Any, rows: Iterable[NDArray[Any]]) -> list:
    """Copy flat NumPy arrays as `upload` does, but wait only once for all copies."""
    targets = []
    for values in rows:
        if dr.backend_v(kind) == dr.JitBackend.CUDA:
            target = kind(np.ascontiguousarray(values))
        else:
            target = dr.empty(kind, len(values))
            target.numpy()[:] = values  # a view: the host writes to memory of Dr.Jit
        targets.append(target)
    dr.eval(targets)
    dr.sync_thread()  # the copies may read the caller's memory until here
    return targets
