"""All uses of `drjit.detail`, which Dr.Jit may change in any version.

``tests/backend/test_detail.py`` shows what each of them is needed for.
"""

from __future__ import annotations

import drjit as dr

from .types import UInt


def llvm_version() -> tuple[int, ...]:
    """Return the version of the libLLVM that Dr.Jit has loaded."""
    return tuple(dr.detail.llvm_version())


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


def sorting_index(digit: UInt, values: int) -> UInt:
    """Return the permutation that sorts digits below `values` stably; fast on cuda only."""
    return dr.detail.block_mkperm(digit, dr.width(digit), values)
