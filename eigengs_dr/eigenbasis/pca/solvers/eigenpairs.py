"""Eigenvectors of a Gram matrix, and rows that stay orthonormal in single precision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

FLOOR = 1e-10
"""Smallest variance of a component, per pixel (1 is white); below, it is rounding."""

NOISE = 1e-8
"""Smallest eigenvalue, as a share of all variance; below, it is rounding of the Gram matrix."""

DRIFT = 1e-6
"""Largest entry of ``V V^T - 1`` without a correction of the rows V."""

COLUMNS = 4096
"""Number of pixels to sum in single precision, before the sums are added in double."""

FEW = 0.25
"""Share of the eigenvalues below which LAPACK's ``syevr`` finds only these: of 2,048, 300 take
0.8 s instead of 1.2, and the memory of one matrix instead of three. Of 631, 375 take 0.11 s instead
of 0.05."""


def product(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return ``a b^T`` of long rows; pure single precision would lose small variances.

    Parameters
    ----------
    a, b : ndarray of float32, shapes (m, d) and (n, d)

    Returns
    -------
    ndarray of float64, shape (m, n)
    """
    result = np.zeros((len(a), len(b)))
    for first in range(0, a.shape[1], COLUMNS):
        result += a[:, first : first + COLUMNS] @ b[:, first : first + COLUMNS].T
    return result


def largest_eigenpairs(
    gram: NDArray[np.float64], most: int, floor: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the largest eigenvalues of a Gram matrix, and the weights of its rows.

    Parameters
    ----------
    gram : ndarray of float64, shape (n, n)
        Only the lower left is read; the function may overwrite the matrix.
    most : int
        Largest number of eigenvalues.
    floor : float
        Smallest eigenvalue to return.

    Returns
    -------
    values : ndarray of float64, shape (k,)
        Descending.
    weights : ndarray of float64, shape (n, k)
        The weights that make unit vectors of the rows: eigenvectors by roots of eigenvalues.
    dropped : float
        The next eigenvalue, or 0.
    """
    n, trace = len(gram), np.trace(gram)
    if most < FEW * n:
        wanted = [n - most - 1, n - 1]
        # The transpose is in Fortran's order, which LAPACK takes without a copy.
        values, vectors = eigh(
            gram.T, lower=False, overwrite_a=True, subset_by_index=wanted, check_finite=False
        )
    else:
        values, vectors = np.linalg.eigh(gram, UPLO="L")
    values, vectors = values[::-1], vectors[:, ::-1]
    kept = min(most, int((values > max(floor, NOISE * trace)).sum()))
    dropped = max(0.0, float(values[kept])) if kept < len(values) else 0.0
    return values[:kept], vectors[:, :kept] / np.sqrt(values[:kept]), dropped


def orthonormalize(
    rows: NDArray[np.float32], scatter: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Drop spurious rows and make the others orthonormal again after rounding.

    Parameters
    ----------
    rows : ndarray of float32, shape (k, d)
    scatter : ndarray of float64, shape (k,)
        Eigenvalues, descending.

    Returns
    -------
    rows : ndarray of float32, shape (l, d)
        ``l <= k``
    scatter : ndarray of float64, shape (l,)
    """
    overlap = product(rows, rows)
    # If the length of a row is far from 1, its eigenvalue is rounding and the row means nothing.
    real = np.abs(np.diag(overlap) - 1) < 0.5
    if not real.all():
        rows, scatter, overlap = rows[real], scatter[real], overlap[real][:, real]
    if np.abs(overlap - np.eye(len(rows))).max(initial=0) > DRIFT:
        # Gram-Schmidt, largest scatter first, so that errors leave the rows of small scatter.
        inverse = np.linalg.inv(np.linalg.cholesky(overlap))
        rows = inverse.astype(np.float32) @ rows
    return rows, scatter


def orient(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give each row the sign that makes its entry of largest size positive, as scikit-learn does.

    The eigenvectors of a matrix have no sign of their own: without this rule, rounding would choose
    it.

    Parameters
    ----------
    rows : ndarray of float32, shape (k, d)

    Returns
    -------
    ndarray of float32, shape (k, d)
    """
    positive = [row.max() >= -row.min() for row in rows]
    signs = np.where(positive, 1, -1).astype(np.float32)
    return rows * signs[:, None]
