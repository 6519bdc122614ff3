"""Types of the backends, as kernels take them."""

import pytest

from eigengs_dr.backend.arrays import _types


@pytest.fixture(params=[32, 64])
def types(backend, request):
    """Types of a backend in single and in double precision."""
    return _types(f"drjit.{backend}.ad", request.param)
