"""Incremental PCA: the mean and the principal components of images that come in blocks.

Rows stay orthonormal in single precision, and their Gram matrix is summed in double.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

BLOCK_BYTES = 768 << 20
"""Bytes of a block of images."""

MAX_BLOCK = 1024
"""Most images in a block: its Gram matrix has as many rows."""

MARGIN = 0.25
"""Additional components from block to block, as a share of the components to keep."""

EXAMPLES = 16
"""Number of training images in a basis."""

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class EigenState:
    """State of an incremental PCA after some images.

    Attributes
    ----------
    count : int
        Number of images, m.
    seed : int
        Seed of the random examples.
    mean : ndarray of float64, shape (C, d)
        Mean of the images; d is the number of pixels.
    rows : tuple of C ndarrays of float32, shape (r_c, d)
        Orthonormal directions of largest scatter, descending.
    scatter : tuple of C ndarrays of float64, shape (r_c,)
        Sum over the images of the squared length along each row: m times the variance.
    squares : ndarray of float64, shape (C,)
        Sum over the images of the squared distance to the mean.
    examples : ndarray of float32, shape (n, C, d)
        At most `EXAMPLES` images, each with the same probability.
    lost : ndarray of float64, shape (C,)
        Bound on what truncation has taken: each step adds the largest scatter that it drops. The
        scatter of the images along any direction exceeds that of the state by at most as much, and
        so does each of its eigenvalues (Weyl): ``0 <= exact_j - scatter_j <= lost``.
    """

    count: int
    seed: int
    mean: NDArray[np.float64]
    rows: tuple[NDArray[np.float32], ...]
    scatter: tuple[NDArray[np.float64], ...]
    squares: NDArray[np.float64]
    examples: NDArray[np.float32]
    lost: NDArray[np.float64]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the state as plain arrays, for a checkpoint."""
        result: dict[str, NDArray[Any]] = {
            "count": np.array(self.count),
            "seed": np.array(self.seed),
            "mean": self.mean,
            "squares": self.squares,
            "examples": self.examples,
            "lost": self.lost,
        }
        for c, (rows, scatter) in enumerate(zip(self.rows, self.scatter, strict=True)):
            result |= {f"rows{c}": rows, f"scatter{c}": scatter}
        return result

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> EigenState:
        """Rebuild a state from the result of `arrays`; the next blocks then give equal bits."""
        channels = range(len(arrays["mean"]))
        arrays = {"lost": np.zeros(len(channels)), **arrays}  # absent in an older checkpoint
        return cls(
            int(arrays["count"]),
            int(arrays["seed"]),
            arrays["mean"],
            tuple(arrays[f"rows{c}"] for c in channels),
            tuple(arrays[f"scatter{c}"] for c in channels),
            arrays["squares"],
            arrays["examples"],
            arrays["lost"],
        )


def empty_state(size: tuple[int, int], seed: int = 0, channels: int = 3) -> EigenState:
    """Return the state of no images, with channels of a size (width, height)."""
    pixels = size[0] * size[1]
    return EigenState(
        count=0,
        seed=seed,
        mean=np.zeros((channels, pixels)),
        rows=(np.zeros((0, pixels), np.float32),) * channels,
        scatter=(np.zeros(0),) * channels,
        squares=np.zeros(channels),
        examples=np.zeros((0, channels, pixels), np.float32),
        lost=np.zeros(channels),
    )


def block_length(size: tuple[int, int]) -> int:
    """Return the number of images of a size (width, height) in a block of `BLOCK_BYTES`."""
    return max(1, min(MAX_BLOCK, BLOCK_BYTES // (12 * size[0] * size[1])))


def rank_for(components: int) -> int:
    """Return how many rows a state needs for `components` accurate components at the end."""
    return components + int(np.ceil(MARGIN * components))


def merge(state: EigenState, block: NDArray[np.float32], rank: Sequence[int]) -> EigenState:
    """Add a block of images to a state, by one step of incremental PCA.

    With n images of mean m1 before and b new images of mean m2, the scatter matrix of all is ::

        S = S1 + S2 + n b / (n + b) (m1 - m2) (m1 - m2)^T

    (Ross et al. 2008, "Incremental learning for robust visual tracking", IJCV 77, eq. 3). Its
    eigenvectors follow from the Gram matrix of all rows, which is small. The result is exact but
    for rounding if no channel has more than `rank` directions.

    Parameters
    ----------
    state : EigenState
        The state before; it does not change.
    block : ndarray of float32, shape (b, C, d)
        The new images; the function overwrites them.
    rank : sequence of C ints
        Most rows to keep of each channel; see `rank_for`.

    Returns
    -------
    EigenState
    """
    n, b = state.count, len(block)
    if b == 0:
        return state
    examples = np.stack(draw_examples(state.examples, block, n, state.seed))
    mean = block.mean(axis=0, dtype=np.float64)
    # This shift towards the old mean gives the new images the scatter of both last terms.
    block -= (mean + np.sqrt(n / (n + b)) * (state.mean - mean)).astype(np.float32)
    floor = FLOOR * (n + b) * block.shape[2]
    parts = [
        _add_rows(state.rows[c], state.scatter[c], block[:, c], most, floor)
        for c, most in enumerate(rank)
    ]
    return EigenState(
        count=n + b,
        seed=state.seed,
        mean=state.mean + b / (n + b) * (mean - state.mean),
        rows=tuple(part.rows for part in parts),
        scatter=tuple(part.scatter for part in parts),
        squares=state.squares + [part.added for part in parts],
        examples=examples,
        lost=state.lost + [part.dropped for part in parts],
    )


def merge_states(first: EigenState, second: EigenState, rank: Sequence[int]) -> EigenState:
    """Return the state of the images of two states, by the equation of `merge`.

    Parameters
    ----------
    first, second : EigenState
        States of different images; they do not change.
    rank : sequence of C ints
        Most rows to keep of each channel.

    Returns
    -------
    EigenState
    """
    if not second.count or not first.count:
        return second if second.count else first
    n, m = first.count, second.count
    shift = np.sqrt(n / (n + m) * m) * (second.mean - first.mean)
    floor = FLOOR * (n + m) * first.mean.shape[1]
    parts = []
    for c, most in enumerate(rank):
        scaled = np.sqrt(second.scatter[c]).astype(np.float32)[:, None] * second.rows[c]
        block = np.vstack([scaled, shift[c].astype(np.float32)])
        parts.append(_add_rows(first.rows[c], first.scatter[c], block, most, floor))
    return EigenState(
        count=n + m,
        seed=first.seed,
        mean=first.mean + m / (n + m) * (second.mean - first.mean),
        rows=tuple(part.rows for part in parts),
        scatter=tuple(part.scatter for part in parts),
        squares=first.squares + second.squares + (shift**2).sum(axis=1),
        examples=_join_examples(first, second),
        lost=first.lost + second.lost + [part.dropped for part in parts],
    )


class _Added(NamedTuple):
    """Rows and their scatter after a step, the trace it added, the largest value it dropped."""

    rows: NDArray[np.float32]
    scatter: NDArray[np.float64]
    added: float
    dropped: float


def _add_rows(
    rows: NDArray[np.float32],
    scatter: NDArray[np.float64],
    block: NDArray[np.float32],
    most: int,
    floor: float,
) -> _Added:
    """Add the rows of a block to a scatter matrix ``rows^T diag(scatter) rows``."""
    gram = _gram(rows, scatter, block)
    added = float(np.trace(gram[len(rows) :, len(rows) :]))
    values, weights, dropped = largest_eigenpairs(gram, most, floor)
    weights[: len(rows)] *= np.sqrt(scatter)[:, None]
    directions = _rotate(rows, block, weights.T.astype(np.float32))
    return _Added(*orthonormalize(directions, values), added, dropped)


def _gram(
    rows: NDArray[np.float32], scatter: NDArray[np.float64], block: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the Gram matrix of ``[sqrt(scatter) rows; block]``; the upper right stays 0."""
    r = len(rows)
    gram = np.zeros((r + len(block),) * 2)
    gram[np.arange(r), np.arange(r)] = scatter
    gram[r:, :r] = product(block, rows) * np.sqrt(scatter)
    gram[r:, r:] = product(block, block)
    return gram


def _rotate(
    rows: NDArray[np.float32], block: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Combine old rows and new images into new rows."""
    result = weights[:, len(rows) :] @ block
    result += weights[:, : len(rows)] @ rows
    return result


def draw_examples(
    examples: Iterable[Item], items: Iterable[Item], first: int, seed: int
) -> list[Item]:
    """Sample examples by reservoir: image i draws one of i + 1 places; the first places count.

    Parameters
    ----------
    examples : iterable
        The examples of the images before.
    items : iterable
        The next images, or their numbers.
    first : int
        Number of the first of them.
    seed : int

    Returns
    -------
    list
        At most `EXAMPLES` of `examples` and `items`.
    """
    drawn = list(examples)
    for i, item in enumerate(items, first):
        # One generator for each image, so that no generator is part of the state.
        place = i if i < EXAMPLES else np.random.default_rng((seed, i)).integers(i + 1)
        if place < EXAMPLES:
            drawn[place : place + 1] = [item]
    return drawn


def _join_examples(first: EigenState, second: EigenState) -> NDArray[np.float32]:
    """Draw examples of two states: each place takes one of a state by the share of its images."""
    n, m = first.count, second.count
    share = np.random.default_rng((first.seed, n, m)).random(EXAMPLES) < n / (n + m)
    waiting = [list(first.examples), list(second.examples)]
    joined = []
    for own in share:
        order = waiting if own else waiting[::-1]
        source = order[0] or order[1]
        if source:
            joined.append(source.pop(0))
    return np.stack(joined)


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
