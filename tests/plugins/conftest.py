"""The variant of Mitsuba that tests of plugins run in, and what needs OptiX."""

import pytest

import eigengs_dr as eg
from _helpers.variants import BOTH_RGB
from eigengs_dr.backend.selection import BackendError, select

NO_OPTIX = "Could not initialize OptiX"
"""What Mitsuba says of a scene in a cuda variant where the driver lacks OptiX."""


@pytest.fixture(params=BOTH_RGB)
def variant(request):
    """A variant with the plugins, by default llvm_ad_rgb and cuda_ad_rgb; then that before."""
    mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
    before = mi.variant()
    try:
        select("cuda" if request.param.startswith("cuda") else "llvm")
    except BackendError as error:
        pytest.skip(str(error))
    mi.set_variant(request.param)
    eg.register_plugins()
    yield request.param
    if before:
        mi.set_variant(before)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call():
    """Skip a test that builds a scene on a GPU, or a simulated one, without OptiX."""
    try:
        return (yield)
    except RuntimeError as error:
        if NO_OPTIX not in str(error):
            raise
        pytest.skip("no OptiX: scenes in cuda variants were not tested")
