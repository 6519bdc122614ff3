"""All that this package takes from `drjit.detail`, which Dr.Jit may change in any version.

``tests/backend/test_detail.py`` says what breaks with each of them.
"""

from __future__ import annotations

import drjit as dr

from .types import UInt


def llvm_version() -> tuple[int, ...]:
    """Return the version of the libLLVM that Dr.Jit has loaded."""
    return tuple(dr.detail.llvm_version())


def cuda_device() -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the version of CUDA that the driver knows, and the capability of the first GPU."""
    return dr.detail.cuda_version(), dr.detail.cuda_compute_capability()


def scope(backend: dr.JitBackend) -> int:
    """Return the number of the current scope of a `drjit.JitBackend`, in this thread.

    Dr.Jit puts operations of an earlier scope before those of a later one in a program, and merges
    equal operations of one scope alone. Nested calls, loops and branches begin another.
    """
    return int(dr.detail.scope(backend))


def new_scope(backend: dr.JitBackend) -> None:
    """Begin another scope."""
    dr.detail.new_scope(backend)


def indices_of(arrays: object) -> tuple[int, ...]:
    """Return the numbers that Dr.Jit gives to the variables in nested arrays while they live."""
    return tuple(dr.detail.collect_indices(arrays))


def sorting_index(digit: UInt, values: int) -> UInt:
    """Return the index that sorts digits below `values`, stably; cuda only sorts so fast."""
    return dr.detail.block_mkperm(digit, dr.width(digit), values)
