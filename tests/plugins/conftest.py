"""The variant of Mitsuba that tests of plugins run in."""

import drjit as dr
import pytest

import eigengs_dr as eg


@pytest.fixture
def variant(request):
    """The variant that a test names by a marker, by default llvm_ad_rgb; then that before."""
    mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
    before = mi.variant()
    name = getattr(request, "param", "llvm_ad_rgb")
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("the llvm backend is not there")
    mi.set_variant(name)
    eg.register_plugins()
    yield name
    if before:
        mi.set_variant(before)
