"""What the package needs of `drjit.detail`: if a test fails, what it names has to be mended."""

import drjit as dr
import numpy as np

from eigengs_dr.backend.arrays import (
    indices_of,
    kernel_misses,
    new_scope,
    scope,
    sorting_index,
    types_in,
)
from eigengs_dr.backend.selection import select


def test_libllvm_says_its_version():
    """`select` refuses versions that crash; `doctor` and reports show it."""
    if dr.has_backend(dr.JitBackend.LLVM):
        assert dr.detail.llvm_version() >= (8, 0, 0)


def test_scopes_are_numbered(backend):
    """`record` begins one after a replay, or programs after it are compiled twice; a texture uses
    a lookup again only within one, or it could belong to a branch that has ended."""
    kind = dr.backend_v(select(backend).Float)
    before = scope(kind)
    assert scope(kind) == before
    new_scope(kind)
    assert scope(kind) != before


def test_missing_kernels_are_counted(backend):
    """A flush of kernels is noticed by them: programs from before would end the process."""
    one = dr.opaque(select(backend).UInt32, 1)
    dr.eval(one ^ 0x1234567)
    before = kernel_misses()
    dr.eval(one ^ 0x1234567)
    assert kernel_misses() == before
    dr.eval(one ^ 0x1234567 ^ (one << 3))
    assert kernel_misses() != before


def test_variables_have_numbers(backend):
    """A texture knows by them that it is asked twice for the same points."""
    types = types_in(select(backend))
    one, other = types.Float(1, 2), types.Float2([3, 4], [5, 6])
    numbers = indices_of([one, other])
    assert len(set(numbers)) == 3 and numbers == indices_of([one, other])
    assert indices_of([types.Float(1, 2)]) != indices_of([one])


def test_digits_are_sorted_stably(backend):
    """Lists of Gaussians on cuda are made by it; an order that changes gives other bits."""
    digits = np.random.default_rng(0).integers(0, 16, 500)
    index = sorting_index(types_in(select(backend)).UInt(digits.astype(np.uint32)), 16)
    np.testing.assert_array_equal(index.numpy(), np.argsort(digits, kind="stable"))
