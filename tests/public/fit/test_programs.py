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

MORE = {"llvm": 0, "cuda": 5}
"""Programs that a size may add: on cuda, two searches, the keys and the two passes of a sort depend
on the number of bits of a size."""


@pytest.mark.parametrize("sizes", [WHOLE, OVERHANGING], ids=["whole", "overhanging"])
def test_fits_of_all_sizes_share_their_programs(backend, sizes):
    """The first size comes twice: what was compiled lets the next call look for flushed kernels."""
    programs = []
    for width, height, count in (sizes[0], *sizes):
        image = np.random.default_rng(0).uniform(0, 1, (height, width, 3))
        with launches() as launched:
            eg.fit(image, count, iterations=30, backend=backend)
        programs.append({kernel.hash for kernel in jit(launched)})
    first, again, *others = programs
    assert first and all(len(other - (first | again)) <= MORE[backend] for other in others)
