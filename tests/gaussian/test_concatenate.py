"""Several sets as one."""

from dataclasses import replace

import numpy as np
import pytest

from _helpers.sets import COUNT, NAMES, random_scene
from eigengs_dr.backend.selection import select
from eigengs_dr.gaussian.gaussians import concatenate


def test_concatenation(backend):
    """Splats one after the other, backgrounds added."""
    parts = [random_scene(seed, count) for seed, count in ((0, COUNT), (1, 3), (2, 1))]
    sets = [p.on(backend) for p in parts]
    shared = [0.5, 0.25, 0.75]  # by all splats of a set
    sets[1].factor = select(backend).Array3f(shared)
    parts[1].factor[:] = shared
    joined = concatenate(sets)
    expected = {name: np.concatenate([getattr(p, name) for p in parts]) for name in NAMES[:3]}
    background = 3 * parts[0].background.astype(np.float32)
    assert len(joined) == COUNT + 4
    found = joined.to_arrays()
    np.testing.assert_allclose(found.pop("background"), background, rtol=1e-6)
    for name, value in found.items():
        np.testing.assert_array_equal(value, np.float32(expected[name]))
    assert concatenate(sets[:1]) is sets[0]


def test_concatenation_of_nothing():
    with pytest.raises(ValueError, match="no sets"):
        concatenate([])


def test_concatenation_of_what_differs(backend):
    first = random_scene().on(backend)
    others = [
        random_scene(size=(9, 9)).on(backend),
        random_scene(channels=1).on(backend),
        replace(first, space="rgb"),
        random_scene().on(backend, 64),
    ]
    for other in others:
        with pytest.raises(ValueError, match="sets differ") as error:
            concatenate([first, other])
        assert "\n" not in str(error.value)
