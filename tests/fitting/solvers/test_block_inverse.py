"""The block inverse against a dense solution."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from eigengs_dr.fitting.solvers import normal_equations as block_inverse


def neighbours_on_a_grid(width, height, reach):
    """A positive definite matrix that couples points of a grid within a distance."""
    y, x = np.mgrid[:height, :width].reshape(2, -1)
    positions = np.stack([x, y], axis=1).astype(np.float32)
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    matrix = np.where(distance < reach, np.exp(-distance), 0)
    return csr_array(matrix + np.eye(len(matrix))), positions


@pytest.mark.parametrize(("leaf", "parts"), [(20, 32), (100, 4), (1000, 1)])
@pytest.mark.parametrize("order", ["rows", "random"])
def test_solutions(leaf, parts, order, monkeypatch):
    monkeypatch.setattr(block_inverse, "LEAF", leaf)
    matrix, positions = neighbours_on_a_grid(30, 17, 2.5)
    generator = np.random.default_rng(0)
    if order == "random":
        shuffled = generator.permutation(len(positions))
        matrix, positions = matrix[shuffled][:, shuffled], positions[shuffled]
    inverse = block_inverse.invert(matrix, positions)
    assert 1 <= len(inverse.leaves) <= parts
    every = np.concatenate([inverse.separator, *[leaf.rows for leaf in inverse.leaves]])
    assert np.array_equal(np.sort(every), np.arange(len(positions)))
    columns = generator.normal(size=(len(positions), 7)).astype(np.float32)
    expected = np.linalg.solve(matrix.toarray(), columns)
    np.testing.assert_allclose(inverse.solve(columns), expected, atol=1e-5)


def test_everything_couples():
    """No leaves are left; the separator holds all."""
    count = 700
    matrix = csr_array(np.full((count, count), 0.1) + np.eye(count))
    inverse = block_inverse.invert(matrix, np.random.default_rng(0).uniform(size=(count, 2)))
    columns = np.ones((count, 2), np.float32)
    np.testing.assert_allclose(inverse.solve(columns), columns / (1 + 0.1 * count), rtol=1e-3)


def test_blocks_that_are_too_large(monkeypatch):
    monkeypatch.setattr(block_inverse, "MAX_ENTRIES", 1000)
    assert block_inverse.invert(*neighbours_on_a_grid(12, 10, 2.5)) is None
