"""Types of arrays."""

import drjit as dr
import numpy as np
import pytest

from eigengs_dr.backend.arrays import types_of, upload
from eigengs_dr.backend.selection import select


def test_types_of(types):
    for array in (types.Float(1), types.Float3(1), types.FloatX([[1, 2]]), types.Tensor([1.0])):
        assert types_of(array) == types
    assert dr.type_v(types.Float) == getattr(dr.VarType, f"Float{types.bits}")


def test_types_of_refuses_what_has_no_backend_or_no_derivatives(backend):
    others = dr.scalar.ArrayXf([1.0]), 1.0, np.ones(3)
    for array in (*others, select(backend).UInt32(1), getattr(dr, backend).Float(1)):
        with pytest.raises(TypeError, match="expected float arrays"):
            types_of(array)


@pytest.mark.parametrize("offset", [0, 1, 3])
@pytest.mark.parametrize("count", [0, 1, 17])
def test_upload_copies(types, count, offset):
    """From memory of any alignment, and from values of another dtype."""
    values = np.arange(offset + count, dtype=np.float32)[offset:]
    single, integers = upload(types.Float, values), upload(types.UInt, values.astype(np.int64))
    values += 1
    for found in (single, integers):
        np.testing.assert_array_equal(found.numpy(), values - 1)
