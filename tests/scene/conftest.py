"""The variant of Mitsuba that tests of scenes run in."""

import drjit as dr
import pytest

import eigengs_dr as eg


@pytest.fixture(autouse=True)
def variant():
    """The variant llvm_ad_rgb with the plugins; then that before."""
    mi = pytest.importorskip("mitsuba", reason="the scenes need mitsuba")
    before = mi.variant()
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("the llvm backend is not there")
    mi.set_variant("llvm_ad_rgb")
    eg.register_plugins()
    yield
    if before:
        mi.set_variant(before)
