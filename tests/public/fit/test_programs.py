"""Programs of Dr.Jit: one serves images of every size, and sets of every number of Gaussians."""

import numpy as np
import pytest

import eigengs_dr as eg
from _helpers.kernels import jit, launches

WHOLE = [(60, 68, 290), (96, 40, 500), (64, 104, 301)]
"""Width, height and number of Gaussians; the width is a power of two or not. Dr.Jit merges programs
of like size, therefore no two arrays of one rendering may happen to have the same size."""

OVERHANGING = [(61, 67, 290), (97, 39, 500)]
"""Sizes that are no multiples of a tile."""

sizes = pytest.mark.parametrize("sizes", [WHOLE, OVERHANGING], ids=["whole", "overhanging"])

MORE = {"llvm": 0, "cuda": 5}
"""Programs that a size may add: on cuda, two searches, the keys and the two passes of a sort depend
on the number of bits of a size."""


def picture(width, height, seed=0):
    y, x = (v[..., None] for v in np.mgrid[:height, :width])
    wave = 0.5 + 0.3 * np.sin(x / 7 + np.arange(3)) * np.cos(y / 5)
    return (wave + np.random.default_rng(seed).normal(0, 0.05, wave.shape)).astype(np.float32)


def programs_of(call, *arguments):
    """Return the names of the programs that a call runs."""
    with launches() as launched:
        call(*arguments)
    assert jit(launched)
    return {kernel.hash for kernel in jit(launched)}


def check_sharing(backend, call, sizes):
    """The programs of the first size serve the others.

    It comes twice: what was compiled lets the next call look whether kernels were flushed.
    """
    one, again, *others = (programs_of(call, *size) for size in (sizes[0], *sizes))
    for other in others:
        assert len(other - (one | again)) <= MORE[backend]


@sizes
def test_fits_of_all_sizes_share_their_programs(backend, sizes):
    def fit(width, height, count):
        eg.fit(picture(width, height), gaussians=count, iterations=30, backend=backend)

    check_sharing(backend, fit, sizes)


def test_fits_of_many_images_share_their_programs(backend):
    def fit(width, height, count):
        photos = [picture(width, height, seed) for seed in range(2 + count // 500)]
        list(eg.fit_many(photos, gaussians=count, iterations=10, backend=backend))

    check_sharing(backend, fit, WHOLE)
