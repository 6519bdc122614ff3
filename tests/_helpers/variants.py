"""Variants of Mitsuba, as parameters of tests."""

import pytest


def on_both(kind):
    """The variant of a kind of colour, such as "rgb", for each backend."""
    return [f"llvm_ad_{kind}", pytest.param(f"cuda_ad_{kind}", marks=pytest.mark.gpu)]


BOTH_RGB = on_both("rgb")
"""The variants of tests that name none."""


def in_variants(names):
    """Run a test in these variants instead."""
    return pytest.mark.parametrize("variant", names, indirect=True)


in_all = in_variants([*BOTH_RGB, *on_both("mono"), *on_both("spectral")])
