"""The fewest components of each channel, against all that there are."""

import itertools
import warnings

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from eigengs_dr.eigenbasis.truncation import min_ranks_per_channel, residual_energy


@given(
    st.tuples(*[hnp.arrays(float, st.integers(0, 4), elements=st.floats(0, 5)) for _ in "abc"]),
    st.floats(1, 30),
)
@settings(max_examples=60)
def test_no_fewer_components_do(gains, target):
    left = [residual_energy(values.sum() + 0.1, values) for values in gains]
    allowed = 7 * 10 ** (-target / 10)
    ways = itertools.product(*[range(len(rows)) for rows in left])
    enough = [w for w in ways if left[0][w[0]] + left[1][w[1]] + left[2][w[2]] <= allowed - 1e-9]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = min_ranks_per_channel(left, 7, target)
    reached = sum(rows[k] for rows, k in zip(left, found, strict=True))
    if enough:
        assert sum(found) <= min(map(sum, enough))
        assert reached <= allowed + 1e-9
    else:
        assert reached <= allowed + 1e-9 or found == tuple(map(len, gains))


def test_components_that_add_nothing_are_left_out():
    none = np.zeros(1)
    assert min_ranks_per_channel([np.array([2, 1, 1, 0.5]), none, none], 10, 10) == (1, 0, 0)
