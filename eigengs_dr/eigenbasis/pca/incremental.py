"""Incremental PCA: the mean and the principal components of images that arrive in blocks.

A state belongs to one channel. Its rows remain orthonormal in single precision; their Gram matrix
is summed in double precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from ...backend.types import Doubles, Singles

BLOCK_BYTES = 768 << 20
"""Size of a block of images in bytes."""

MAX_BLOCK = 1024
"""Largest number of images in a block, and so of rows of its Gram matrix."""

EXTRA_SHARE = 0.25
"""Additional components that are kept between blocks, as a share of the final components."""


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
        Orthonormal directions of the largest scatter, descending.
    scatter : ndarray of float64, shape (r,)
        Sum over the images of the squared coefficient of each row: m times the variance.
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
        """Rebuild a state from the result of `arrays`; later results are bit-identical."""
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
    """Return the number of rows that a state needs for `components` accurate components."""
    return components + int(np.ceil(EXTRA_SHARE * components))


def merge(state: EigenState, block: Singles, rank: int) -> EigenState:
    """Add a block of images to a state, by one step of incremental PCA.

    With n earlier images of mean m1 and b new images of mean m2, the scatter matrix of all is ::

        S = S1 + S2 + n b / (n + b) (m1 - m2) (m1 - m2)^T

    (Ross et al. 2008, "Incremental learning for robust visual tracking", IJCV 77, eq. 3). Its
    eigenvectors follow from the Gram matrix of all rows, which is small. If there are at most
    `rank` directions, the result is exact except for rounding.

    Parameters
    ----------
    state : EigenState
        The earlier state; it is not changed.
    block : ndarray of float32, shape (b, d)
        The new images, which are overwritten.
    rank : int
        Largest number of rows to keep; see `rank_for`.

    Returns
    -------
    EigenState
    """
    n, b = state.count, len(block)
    if b == 0:
        return state
    mean = block.mean(axis=0, dtype=np.float64)
    # With this shift towards the old mean, the scatter of the new images includes the last term.
    block -= (mean + np.sqrt(n / (n + b)) * (state.mean - mean)).astype(np.float32)
    rows, scatter, added = _add_rows(state, block, rank, n + b)
    mean = state.mean + b / (n + b) * (mean - state.mean)
    return EigenState(n + b, mean, rows, scatter, state.squares + added)


def merge_states(first: EigenState, second: EigenState, rank: int) -> EigenState:
    """Return the state for the images of two states, by the equation of `merge`."""
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
    """Add the rows of a block to the scatter matrix of a state; also return the added trace."""
    old = len(state.rows)
    roots = np.sqrt(state.scatter)
    gram = np.zeros((old + len(block),) * 2)  # of [roots rows; block]; the upper right is unused
    gram[np.arange(old), np.arange(old)] = state.scatter
    gram[old:, :old] = product(block, state.rows) * roots
    gram[old:, old:] = product(block, block)
    added = float(np.trace(gram[old:, old:]))
    values, weights = largest_eigenpairs(gram, rank, MIN_VARIANCE * count * block.shape[1])
    weights[:old] *= roots[:, None]
    combine = weights.T.astype(np.float32)
    directions = combine[:, old:] @ block
    directions += combine[:, :old] @ state.rows
    return *orthonormalize(directions, values), added


MIN_VARIANCE = 1e-10
"""Smallest variance of a component per pixel, with 1 as white; smaller ones are rounding."""

MIN_EIGENVALUE_SHARE = 1e-8
"""Smallest eigenvalue relative to the total variance; smaller ones are rounding of the Gram
matrix."""

MAX_DRIFT = 1e-6
"""Largest entry of ``V V^T - 1`` for which the rows V are not orthonormalized again."""

SUM_PIXELS = 4096
"""Number of pixels that are summed in single precision before the sums are added in double."""

SUBSET_SHARE = 0.25
"""Share of the eigenvalues below which LAPACK's ``syevr`` computes only these: 300 of 2,048 take
0.8 s instead of 1.2 s, and the memory of one matrix instead of three. 375 of 631 would take 0.11 s
instead of 0.05 s."""


def product(a: Singles, b: Singles) -> Doubles:
    """Return ``a b^T`` for long rows; single precision alone would lose small variances."""
    result = np.zeros((len(a), len(b)))
    for first in range(0, a.shape[1], SUM_PIXELS):
        result += a[:, first : first + SUM_PIXELS] @ b[:, first : first + SUM_PIXELS].T
    return result


def largest_eigenpairs(gram: Doubles, limit: int, floor: float) -> tuple[Doubles, Doubles]:
    """Return the largest eigenvalues of a Gram matrix, and the weights of its rows.

    Parameters
    ----------
    gram : ndarray of float64, shape (n, n)
        Only the lower left is read; the matrix may be overwritten.
    limit : int
        Largest number of eigenvalues.
    floor : float
        Smallest eigenvalue to return.

    Returns
    -------
    values : ndarray of float64, shape (k,)
        Descending.
    weights : ndarray of float64, shape (n, k)
        Weights that combine the rows to unit vectors: eigenvectors divided by roots of eigenvalues.
    """
    n, trace = len(gram), np.trace(gram)
    if limit < SUBSET_SHARE * n:
        subset = [n - limit - 1, n - 1]
        # The transpose is in Fortran order, which LAPACK accepts without a copy.
        values, vectors = eigh(
            gram.T, lower=False, overwrite_a=True, subset_by_index=subset, check_finite=False
        )
    else:
        values, vectors = np.linalg.eigh(gram, UPLO="L")
    values, vectors = values[::-1], vectors[:, ::-1]
    kept = min(limit, int((values > max(floor, MIN_EIGENVALUE_SHARE * trace)).sum()))
    return values[:kept], vectors[:, :kept] / np.sqrt(values[:kept])


def orthonormalize(rows: Singles, scatter: Doubles) -> tuple[Singles, Doubles]:
    """Drop spurious rows, and make the others orthonormal again after rounding.

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
    # If the length of a row is far from 1, its eigenvalue is rounding, and the row is meaningless.
    valid = np.abs(np.diag(overlap) - 1) < 0.5
    if not valid.all():
        rows, scatter, overlap = rows[valid], scatter[valid], overlap[valid][:, valid]
    if np.abs(overlap - np.eye(len(rows))).max(initial=0) > MAX_DRIFT:
        # Gram-Schmidt from the largest scatter, so that errors are removed from small scatter.
        inverse = np.linalg.inv(np.linalg.cholesky(overlap))
        rows = inverse.astype(np.float32) @ rows
    return rows, scatter


def orient(rows: Singles) -> Singles:
    """Choose the sign of each row so that its largest absolute entry is positive.

    This is the rule of scikit-learn. The signs of eigenvectors are arbitrary: without a rule, they
    would depend on rounding.
    """
    positive = [row.max() >= -row.min() for row in rows]
    signs = np.where(positive, 1, -1).astype(np.float32)
    return rows * signs[:, None]
