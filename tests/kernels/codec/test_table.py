"""The table of lights of a packed model."""

from contextlib import suppress

import numpy as np
import pytest

from eigengs_dr.relight.lights import LightTable
from eigengs_dr.relight.packed import read_table, table_bytes
from eigengs_dr.storage.npz import BadValue

RANDOM = np.random.default_rng(5)
LIGHTS = RANDOM.normal((0, 0, 2.5), size=(40, 3))
LIGHTS /= np.linalg.norm(LIGHTS, axis=1, keepdims=True)
SQUARES = np.array([0.1, 0.01, 1e-6, 0.0])
TABLE = LightTable(LIGHTS, RANDOM.normal(size=(40, 3, 5)), "thin_plate", 0.01)


@pytest.mark.parametrize("error", [1e-3, 1e-6, 1e-12])
def test_rounding_adds_the_error_that_it_may(error):
    content = table_bytes(TABLE, SQUARES, error, 33.5, 1.25)
    table, *figures = read_table(content, 4)
    change = np.square(table.values - TABLE.values).mean((0, 1)) @ [*SQUARES, 1]
    assert figures == [33.5, 1.25]
    assert 0.4 * error < change < 1.1 * error
    np.testing.assert_allclose(table.lights, TABLE.lights, atol=1e-4)


def test_damaged_tables_are_refused_or_finite():
    content = np.frombuffer(table_bytes(TABLE, SQUARES, 1e-4, 33.5, 1.0), np.uint8)
    for _ in range(200):
        damaged = content.copy()
        damaged[RANDOM.integers(len(content), size=3)] = RANDOM.integers(256, size=3)
        with suppress(BadValue):
            assert np.isfinite(read_table(damaged.tobytes(), 4)[0].values).all()
    for length in range(0, 120, 7):
        with pytest.raises(BadValue):
            read_table(content[:length].tobytes(), 4)
