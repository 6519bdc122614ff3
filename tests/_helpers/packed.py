"""What tests of packed sets share."""

import tracemalloc
from contextlib import contextmanager
from functools import cache

import pytest

import eigengs_dr as eg
from _helpers.families import family


@cache
def small_fit():
    """A fit of 100 splats, and its image."""
    image = family(1, side=32, seed=7)[0]
    return eg.fit(image, 100, iterations=150, backend="llvm").gaussians, image


@contextmanager
def few_groups():
    """Let Gaussians of 4 groups instead of 16 make up for the rounding, in a third of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("eigengs_dr.packing.rounding.MAX_GROUPS", 4)
        yield


def peak(work):
    """Most bytes that Python and NumPy hold at once, beside what they held before."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
