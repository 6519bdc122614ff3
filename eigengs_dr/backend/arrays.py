"""Array types of one Dr.Jit backend and precision, copies of NumPy arrays, and exact arithmetic.

On cuda, Dr.Jit 1.5 uses approximate instructions: `drjit.rcp` and `drjit.rsqrt` of double
precision have 20 bits (PTX: ``rcp.approx.ftz.f64``). This package uses the two functions of this
module instead.

The last functions are the uses of `drjit.detail`, which Dr.Jit may change in any version;
``tests/kernels/detail/`` shows what each of them is needed for.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import NamedTuple, TypeVar

import drjit as dr
import numpy as np

from . import types as kinds
from .selection import BACKENDS
from .types import DrJitArray, Rows, Values

Kind = TypeVar("Kind", bound=DrJitArray)
Number = TypeVar("Number", kinds.Float, Rows)


class ArrayTypes(NamedTuple):
    """The array types of one backend and one float precision."""

    Int: type[kinds.UInt]
    UInt: type[kinds.UInt]
    Bool: type[kinds.Bool]
    UInt2: type
    Float: type[kinds.Float]
    Float2: type[kinds.Rows]
    Float3: type[kinds.Rows]
    FloatX: type[kinds.Rows]
    Tensor: type[kinds.Tensor]
    backend: str
    bits: int


MODULES = tuple(f"drjit.{backend}.ad" for backend in BACKENDS)
"""Modules of Dr.Jit whose arrays have derivatives."""


def types_of(array: DrJitArray) -> ArrayTypes:
    """Return the array types with the backend and the precision of a Dr.Jit array.

    Parameters
    ----------
    array : Dr.Jit array
        A floating-point array of any depth from ``drjit.llvm.ad`` or that of another backend.

    Returns
    -------
    ArrayTypes

    Raises
    ------
    TypeError
        If the array is no floating-point array of such a module.
    """
    leaf = dr.leaf_t(array)
    module = leaf.__module__
    if module not in MODULES or not dr.is_float_v(leaf):
        raise TypeError(
            f"expected float arrays of {' or '.join(MODULES)}, "
            f"got {type(array).__module__}.{type(array).__name__}"
        )
    return _types(module, 64 if dr.type_v(leaf) == dr.VarType.Float64 else 32)


def types_in(module: ModuleType, bits: int = 32) -> ArrayTypes:
    """Return the types of a module of `eigengs_dr.backend.selection.select`, of 32 or 64 bits."""
    return _types(module.__name__, bits)


@cache  # nearly every function asks
def _types(module: str, bits: int) -> ArrayTypes:
    suffix = "64" if bits == 64 else ""
    names = ["Int32", "UInt32", "Bool", "Array2u"]
    names += [name + suffix for name in ("Float", "Array2f", "Array3f", "ArrayXf", "TensorXf")]
    classes = [getattr(sys.modules[module], name) for name in names]
    return ArrayTypes._make([*classes, module.split(".")[1], bits])


MAX_CACHED_VALUES = 1 << 22
"""Largest number of values of an image whose memory is kept for the next image, because new pages
take time: without this, the start of a fit of 512x512 pixels took 1.6 times as long. Recorded
programs must not release memory, so this is at least
`eigengs_dr.backend.recording.LARGEST_RECORDED`."""


def release_memory(values: int) -> None:
    """Return the free memory of Dr.Jit and of the C library to the system.

    Both cache freed memory. After a stage of a fit that takes much memory, no later stage
    allocates blocks of these sizes.

    Parameters
    ----------
    values : int
        Size of the image of this stage. Memory is released above `MAX_CACHED_VALUES`.
    """
    if values <= MAX_CACHED_VALUES:
        return
    dr.flush_malloc_cache()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # only glibc has it
        if trim is not None:
            trim(0)


def upload(kind: type[Kind], values: Values) -> Kind:
    """Copy a NumPy array into memory that Dr.Jit owns.

    ``kind(values)`` may share NumPy's memory, which may be unaligned. Dr.Jit then replaces packet
    gathers by single gathers, which are 10 times slower, and traces a frozen function again.

    Parameters
    ----------
    kind : type
        Dr.Jit type of a flat array, e.g. ``drjit.llvm.ad.Float``, or of a tensor.
    values : ndarray, shape (n,), or any shape for a tensor
        Any dtype that converts to `kind`.

    Returns
    -------
    Dr.Jit array of type `kind`, same shape
        Evaluated.
    """
    if dr.is_tensor_v(kind):
        return kind(upload(dr.array_t(kind), values.ravel()), values.shape)
    return upload_rows(kind, [values])[0]


def upload_rows(kind: type[Kind], rows: Iterable[Values]) -> list[Kind]:
    """Copy flat NumPy arrays as `upload` does, but wait only once for all copies."""
    targets = []
    for values in rows:
        if dr.backend_v(kind) != dr.JitBackend.LLVM:
            target = kind(np.ascontiguousarray(values))
        else:
            target = dr.empty(kind, len(values))
            target.numpy()[:] = values  # a view: the host writes to Dr.Jit's memory
        targets.append(target)
    dr.eval(targets)
    dr.sync_thread()  # the copies may read the caller's memory until here
    return targets


def eval_pending_scatters(rows: list[kinds.Float]) -> list[kinds.Float]:
    """Return rows after evaluating their pending scatters, if there are any.

    Dr.Jit 1.5 ends the process ("dirty variable") if several rows with pending scatters are
    scattered at once, as `drjit.ravel` does. `drjit.concat`, `drjit.ravel` and users' scatters
    produce such rows.
    """
    dr.eval([row for row in rows if row.state == dr.VarState.Dirty])
    return rows


def gather_run(
    types: ArrayTypes,
    source: kinds.Float | kinds.UInt,
    index: kinds.UInt,
    length: int,
    active: kinds.Mask,
) -> list:
    """Gather ``source[index * length : (index + 1) * length]``, in packets if the length is even.

    Returns a list of `length` Floats. A source of UInt32 holds two in each word, see `in_pairs`.
    """
    shape, kind = (length, dr.width(index)), types.FloatX
    if dr.is_integral_v(source):
        words = dr.gather(
            dr.uint32_array_t(kind), source, index, active, shape=(length // 2, shape[1])
        )
        halves = [half for word in words for half in (word << 16, word & 0xFFFF0000)]
        return [dr.reinterpret_array(types.Float, half) for half in halves]
    if dr.type_v(source) == dr.VarType.Float16:
        kind = dr.float16_array_t(kind)
    return list(dr.gather(kind, source, index, active, shape=shape))


def in_pairs(types: ArrayTypes, values: list) -> list:
    """Return Floats in single precision as UInt32 words of two, which `gather_run` reads.

    Each is rounded to bfloat16, the upper half of its bits: the range of a Float, and a relative
    error of at most 2^-8.
    """
    bits = [dr.reinterpret_array(types.UInt, value) + 0x8000 for value in values]
    pairs = zip(bits[::2], bits[1::2], strict=True)
    return [(first >> 16) | (second & 0xFFFF0000) for first, second in pairs]


def rcp(x: Number) -> Number:
    """Return ``1 / x``, accurate to the last bits in double precision on every backend.

    Parameters
    ----------
    x : Float, shape (N,), or an array of several Floats
        In single or double precision.

    Returns
    -------
    Same type as `x`
        Differentiable once. Single precision has the relative error of `drjit.rcp`, at most 2e-7.
    """
    if not _is_double(x):
        return dr.rcp(x)
    value = 1 / dr.detach(x)
    return _with_slope(value, -dr.square(value), x)


def rsqrt(x: Number) -> Number:
    """Return ``1 / sqrt(x)``, accurate to the last bits in double precision on every backend.

    Parameters
    ----------
    x : Float, shape (N,), or an array of several Floats
        In single or double precision.

    Returns
    -------
    Same type as `x`
        Differentiable once. Single precision has the relative error of `drjit.rsqrt`, at most 4e-7.
    """
    if not _is_double(x):
        return dr.rsqrt(x)
    value = 1 / dr.sqrt(dr.detach(x))
    return _with_slope(value, -0.5 * value * dr.square(value), x)


@dataclass(frozen=True)
class Divisor:
    """An integer divisor in arrays; a literal would compile a program for each value.

    LLVM and PTX divide slowly by an array (llvm lane by lane). Multiplication by the reciprocal is
    exact: with ``2^(s-1) < d <= 2^s`` and ``m = ceil(2^(31+s) / d)``, the quotient of n < 2^31 is
    ``n m >> 31 + s`` (Granlund and Montgomery, "Division by Invariant Integers using
    Multiplication", 1994).

    Attributes
    ----------
    divisor : UInt32, shape (1,)
    multiplier : UInt32, shape (1,)
        The number m, in [2^31, 2^32).
    shift : UInt32, shape (1,)
        The number s.
    """

    divisor: kinds.UInt
    multiplier: kinds.UInt
    shift: kinds.UInt

    def divmod(self, n: kinds.UInt) -> tuple[kinds.UInt, kinds.UInt]:
        """Return the quotient and the remainder of UInt32 below 2^31."""
        quotient = dr.mul_hi(n + n, self.multiplier) >> self.shift
        return quotient, n - quotient * self.divisor


def make_divisor(types: ArrayTypes, value: int) -> Divisor:
    """Return the `Divisor` of an integer in [1, 2^31)."""
    shift = (value - 1).bit_length()
    multiplier = -(-(1 << (31 + shift)) // value)
    return Divisor(*(dr.opaque(types.UInt, v) for v in (value, multiplier, shift)))


def _with_slope(value: Number, slope: Number, x: Number) -> Number:
    """Attach the derivative `slope` with respect to x; Dr.Jit's own would use `drjit.rcp`."""
    return dr.replace_grad(value, slope * x) if dr.grad_enabled(x) else value


def _is_double(x: DrJitArray) -> bool:
    return bool(dr.type_v(x) == dr.VarType.Float64)


def scope(backend: dr.JitBackend) -> int:
    """Return the number of the current scope of a `drjit.JitBackend` in this thread.

    In a program, Dr.Jit places the operations of an earlier scope before those of a later one, and
    merges equal operations only within a scope. Nested calls, loops and branches begin new scopes.
    """
    return int(dr.detail.scope(backend))


def new_scope(backend: dr.JitBackend) -> None:
    """Begin a new scope."""
    dr.detail.new_scope(backend)


def kernel_misses() -> tuple[int, ...]:
    """Return how many kernels were missing in memory so far: read from the disk, and compiled."""
    return tuple(dr.detail.launch_stats()[1:])


def indices_of(arrays: object) -> tuple[int, ...]:
    """Return the indices by which Dr.Jit identifies the variables in nested arrays."""
    return tuple(dr.detail.collect_indices(arrays))


def sorting_index(digit: kinds.UInt, values: int) -> kinds.UInt:
    """Return the permutation that sorts digits below `values` stably; fast on cuda only."""
    return dr.detail.block_mkperm(digit, dr.width(digit), values)
