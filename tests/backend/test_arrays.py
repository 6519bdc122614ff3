"""Types of arrays."""

import drjit as dr
import numpy as np
import pytest

from eigengs_dr.backend.arrays import types_of
from eigengs_dr.backend.selection import select


def test_types_of(types):
    for array in (types.Float(1), types.Float3(1), types.FloatX([[1, 2]]), types.Tensor([1.0])):
        assert types_of(array) == types
    assert dr.type_v(types.Float) == getattr(dr.VarType, f"Float{types.bits}")


@pytest.mark.parametrize("array", [dr.scalar.ArrayXf([1.0]), 1.0, np.ones(3)])
def test_types_of_refuses_what_has_no_backend(array):
    with pytest.raises(TypeError):
        types_of(array)


def test_types_of_refuses_integers_and_arrays_without_derivatives(backend):
    for array in (select(backend).UInt32(1), getattr(dr, backend).Float(1)):
        with pytest.raises(TypeError, match="expected float arrays"):
            types_of(array)
