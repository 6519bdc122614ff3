"""Variants of Mitsuba: parameters of tests, the fixture that sets them, and what needs OptiX."""

import drjit as dr
import pytest

import eigengs_dr as eg

NO_OPTIX = "Could not initialize OptiX"
"""What Mitsuba says of a scene in a cuda variant where the driver lacks OptiX."""


def on_both(kind):
    """The variant of a kind of colour, such as "rgb", for each backend."""
    return [f"llvm_ad_{kind}", pytest.param(f"cuda_ad_{kind}", marks=pytest.mark.gpu)]


BOTH_RGB = on_both("rgb")
"""The variants of tests that name none."""


def in_variants(names):
    """Run a test in these variants instead."""
    return pytest.mark.parametrize("variant", names, indirect=True)


in_all = in_variants([*BOTH_RGB, *on_both("mono"), *on_both("spectral")])

BOTH_RGB_AND_SLOW_SPECTRAL = [
    *BOTH_RGB,
    pytest.param("llvm_ad_spectral", marks=pytest.mark.slow),
    *on_both("spectral")[1:],
]


@pytest.fixture(params=BOTH_RGB)
def variant(request):
    """A variant with the plugins, by default llvm_ad_rgb and cuda_ad_rgb; then that before."""
    mi = pytest.importorskip("mitsuba", reason="the plugins need mitsuba")
    before = mi.variant()
    if request.param.startswith("llvm") and not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("the llvm backend is not there")
    mi.set_variant(request.param)
    eg.register_plugins()
    yield request.param
    if before:
        mi.set_variant(before)


@pytest.hookimpl(wrapper=True)
def skip_without_optix():
    """Skip a test that builds a scene on a GPU, or a simulated one, without OptiX."""
    try:
        return (yield)
    except RuntimeError as error:
        if NO_OPTIX not in str(error):
            raise
        pytest.skip("no OptiX: scenes in cuda variants were not tested")
