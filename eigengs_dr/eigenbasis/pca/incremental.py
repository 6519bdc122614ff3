"""Incremental PCA: the mean and the principal components of images that come in blocks.

A state belongs to one channel. Its rows stay orthonormal in single precision, and their Gram matrix
is summed in double.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from ...backend.types import Doubles, Singles

BLOCK_BYTES = 768 << 20
"""Bytes of a block of images."""

MAX_BLOCK = 1024
"""Most images in a block: its Gram matrix has as many rows."""

EXTRA_SHARE = 0.25
"""Additional components from block to block, as a share of the components to keep."""


@dataclass(frozen=True, eq=False)
class EigenState:
    """State of an incremental PCA of one channel after some images.

    Attributes
    ----------
    count : int
        Number of images, m.
    mean : ndarray of float64, shape (d,)
        Mean of the images; d is the number of pixels.
    rows : ndarray of float32, shape (r, d)
        Orthonormal directions of largest scatter, descending.
    scatter : ndarray of float64, shape (r,)
        Sum over the images of the squared length along each row: m times the variance.
    squares : float
        Sum over the images of the squared distance to the mean.
    """

    count: int
    mean: Doubles
    rows: Singles
    scatter: Doubles
    squares: float

    def arrays(self) -> dict[str, NDArray]:
        """Return the state as plain arrays, for a checkpoint."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray]) -> EigenState:
        """Rebuild a state from the result of `arrays`; the next blocks then give equal bits."""
        numbers = {name: arrays[name].item() for name in ("count", "squares")}
        return cls(**{**arrays, **numbers})


def empty_state(size: tuple[int, int]) -> EigenState:
    """Return the state of no images of a size (width, height)."""
    pixels = size[0] * size[1]
    return EigenState(
        0, np.zeros(pixels), np.zeros((0, pixels), np.float32), np.zeros(0), squares=0.0
    )


def block_length(size: tuple[int, int]) -> int:
    """Return the number of images of a size (width, height) in a block of `BLOCK_BYTES`."""
    return max(1, min(MAX_BLOCK, BLOCK_BYTES // (12 * size[0] * size[1])))


def rank_for(components: int) -> int:
    """Return how many rows a state needs for `components` accurate components at the end."""
    return components + int(np.ceil(EXTRA_SHARE * components))


def merge(state: EigenState, block: Singles, rank: int) -> EigenState:
    """Add a block of images to a state, by one step of incremental PCA.

    With n images of mean m1 before and b new images of mean m2, the scatter matrix of all is ::

        S = S1 + S2 + n b / (n + b) (m1 - m2) (m1 - m2)^T

    (Ross et al. 2008, "Incremental learning for robust visual tracking", IJCV 77, eq. 3). Its
    eigenvectors follow from the Gram matrix of all rows, which is small. The result is exact but
    for rounding if there are at most `rank` directions.

    Parameters
    ----------
    state : EigenState
        The state before; it does not change.
    block : ndarray of float32, shape (b, d)
        The new images; the function overwrites them.
    rank : int
        Most rows to keep; see `rank_for`.

    Returns
    -------
    EigenState
    """
    n, b = state.count, len(block)
    if b == 0:
        return state
    mean = block.mean(axis=0, dtype=np.float64)
    # This shift towards the old mean gives the new images the scatter of both last terms.
    block -= (mean + np.sqrt(n / (n + b)) * (state.mean - mean)).astype(np.float32)
    rows, scatter, added = _add_rows(state, block, rank, n + b)
    mean = state.mean + b / (n + b) * (mean - state.mean)
    return EigenState(n + b, mean, rows, scatter, state.squares + added)


def merge_states(first: EigenState, second: EigenState, rank: int) -> EigenState:
    """Return the state of the images of two states, by the equation of `merge`."""
    if not second.count or not first.count:
        return second if second.count else first
    n, m = first.count, second.count
    shift = np.sqrt(n / (n + m) * m) * (second.mean - first.mean)
    block = np.vstack([second.rows, shift.astype(np.float32)])
    block[:-1] *= np.sqrt(second.scatter).astype(np.float32)[:, None]
    rows, scatter, _ = _add_rows(first, block, rank, n + m)
    mean = first.mean + m / (n + m) * (second.mean - first.mean)
    squares = first.squares + second.squares + float((shift**2).sum())
    return EigenState(n + m, mean, rows, scatter, squares)


def _add_rows(
    state: EigenState, block: Singles, rank: int, count: int
) -> tuple[Singles, Doubles, float]:
    """Add the rows of a block to the scatter matrix of a state; return the trace they add too."""
    old = len(state.rows)
    roots = np.sqrt(state.scatter)
    gram = np.zeros((old + len(block),) * 2)  # of [roots rows; block]; the upper right stays 0
    gram[np.arange(old), np.arange(old)] = state.scatter
    gram[old:, :old] = product(block, state.rows) * roots
    gram[old:, old:] = product(block, block)
    added = float(np.trace(gram[old:, old:]))
    values, weights = largest_eigenpairs(gram, rank, FLOOR * count * block.shape[1])
    weights[:old] *= roots[:, None]
    combine = weights.T.astype(np.float32)
    directions = combine[:, old:] @ block
    directions += combine[:, :old] @ state.rows
    return *orthonormalize(directions, values), added


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


def product(a: Singles, b: Singles) -> Doubles:
    """Return ``a b^T`` of long rows; pure single precision would lose small variances."""
    result = np.zeros((len(a), len(b)))
    for first in range(0, a.shape[1], COLUMNS):
        result += a[:, first : first + COLUMNS] @ b[:, first : first + COLUMNS].T
    return result


def largest_eigenpairs(gram: Doubles, most: int, floor: float) -> tuple[Doubles, Doubles]:
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
    return values[:kept], vectors[:, :kept] / np.sqrt(values[:kept])


def orthonormalize(rows: Singles, scatter: Doubles) -> tuple[Singles, Doubles]:
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


def orient(rows: Singles) -> Singles:
    """Give each row the sign that makes its entry of largest size positive, as scikit-learn does.

    The eigenvectors of a matrix have no sign of their own: without this rule, rounding would choose
    it.
    """
    positive = [row.max() >= -row.min() for row in rows]
    signs = np.where(positive, 1, -1).astype(np.float32)
    return rows * signs[:, None]
