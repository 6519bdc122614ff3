"""The inverse of a sparse symmetric matrix in dense blocks, for many right-hand sides at once.

Nested dissection parts the unknowns by their positions: a separator S, and leaves that couple only
with S. With the blocks ``D_i`` of the leaves, their couplings ``E_i`` with S and the Schur
complement ``C = A_SS - sum_i E_i^T D_i^-1 E_i``, the solution is

    ``x_S = C^-1 (b_S - sum_i E_i^T D_i^-1 b_i)``,  ``x_i = D_i^-1 (b_i - E_i x_S)``.

These are dense matrix products. For 48 columns of 5,000 Gaussians they take a quarter of the time
of back-substitutions by SuperLU, and their error is as large. For a few columns they are no faster.

References
----------
A. George: Nested dissection of a regular finite element mesh. SIAM J. Numer. Anal. 10, 1973.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LEAF = 300
"""Approximate number of unknowns of a leaf. 5,000 Gaussians on a grid then have 16 leaves of 160 to
260, and a separator of 1,290, which needs the fewest products."""

MAX_ENTRIES = 1 << 23
"""Largest number of entries of the blocks, in 32 MiB; 5,000 Gaussians on a grid have 3 million."""

Matrix = NDArray[np.float32]
Indices = NDArray[np.int64]


class Leaf(NamedTuple):
    """Unknowns that couple only with each other and with the separator.

    Attributes
    ----------
    rows : ndarray of int64, shape (n,)
    inverse : ndarray of float32, shape (n, n)
        ``D^-1``.
    neighbours : ndarray of int64, shape (s,)
        Places in the separator of the unknowns that couple with this leaf.
    coupling : ndarray of float32, shape (n, s)
        ``E`` without its zero columns.
    """

    rows: Indices
    inverse: Matrix
    neighbours: Indices
    coupling: Matrix


class BlockInverse(NamedTuple):
    """The inverse of a sparse symmetric matrix; see the module.

    Attributes
    ----------
    leaves : list of Leaf
    separator : ndarray of int64, shape (s,)
    schur_inverse : ndarray of float32, shape (s, s)
        ``C^-1``.
    """

    leaves: list[Leaf]
    separator: Indices
    schur_inverse: Matrix

    def solve(self, columns: Matrix) -> Matrix:
        """Return ``A^-1`` times columns, both of shape (N, M)."""
        result, sums = np.empty_like(columns), columns[self.separator]
        for leaf in self.leaves:
            sums[leaf.neighbours] -= leaf.coupling.T @ (leaf.inverse @ columns[leaf.rows])
        shared = self.schur_inverse @ sums
        result[self.separator] = shared
        for leaf in self.leaves:
            left = columns[leaf.rows] - leaf.coupling @ shared[leaf.neighbours]
            result[leaf.rows] = leaf.inverse @ left
        return result


def invert(matrix: Any, positions: NDArray[np.floating]) -> BlockInverse | None:
    """Invert a sparse symmetric matrix in double precision.

    Parameters
    ----------
    matrix : csr_array of float64, shape (N, N)
        Positive definite.
    positions : ndarray, shape (N, 2)
        Unknowns that are close to each other should have close positions.

    Returns
    -------
    BlockInverse or None
        None if the blocks have more than `MAX_ENTRIES` entries.
    """
    depth = max(0, round(np.log2(len(positions) / LEAF)))
    parts, separator = _dissect(matrix, positions, np.arange(len(positions)), depth)
    if sum(len(rows) ** 2 for rows in [*parts, separator]) > MAX_ENTRIES:
        return None
    schur = matrix[separator][:, separator].toarray()
    leaves = []
    for rows in parts:
        own = matrix[rows]
        inverse, edge = np.linalg.inv(own[:, rows].toarray()), own[:, separator]
        neighbours = np.unique(edge.indices).astype(np.int64)
        coupling = edge[:, neighbours].toarray()
        schur[np.ix_(neighbours, neighbours)] -= coupling.T @ inverse @ coupling
        single = inverse.astype(np.float32), coupling.astype(np.float32)
        leaves.append(Leaf(rows, single[0], neighbours, single[1]))
    return BlockInverse(leaves, separator, np.linalg.inv(schur).astype(np.float32))


def _dissect(
    matrix: Any, positions: NDArray[np.floating], rows: Indices, depth: int
) -> tuple[list[Indices], Indices]:
    """Halve unknowns along their longer axis `depth` times; return leaves and the separator.

    The separator of two halves are the unknowns of the first that couple with the second.
    """
    if depth == 0 or len(rows) < 2:
        return [rows], rows[:0]
    axis = int(np.argmax(np.ptp(positions[rows], axis=0)))
    order = rows[np.argsort(positions[rows, axis], kind="stable")]
    first, second = order[: len(order) // 2], order[len(order) // 2 :]
    touches = np.diff(matrix[first][:, second].indptr) > 0
    separator, first = first[touches], first[~touches]
    leaves = []
    for half in (first, second):
        inner, between = _dissect(matrix, positions, half, depth - 1)
        leaves += [part for part in inner if len(part)]
        separator = np.concatenate([separator, between])
    return leaves, separator
