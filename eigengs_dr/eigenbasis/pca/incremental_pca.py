"""Incremental PCA: the mean and the principal components of images that come in blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK_BYTES = 768 << 20
"""Bytes of a block of images."""

MAX_BLOCK = 1024
"""Most images in a block: its Gram matrix has as many rows."""

MARGIN = 0.25
"""Additional components from block to block, as a share of the components to keep."""

EXAMPLES = 16
"""Number of training images in a basis."""

FLOOR = 1e-10
"""Smallest variance of a component, per pixel (1 is white); below, it is rounding."""

NOISE = 1e-8
"""Smallest eigenvalue, as a share of all variance; below, it is rounding of the Gram matrix."""

DRIFT = 1e-6
"""Largest entry of ``V V^T - 1`` without a correction of the rows V."""

COLUMNS = 4096
"""Number of pixels to sum in single precision, before the sums are added in double."""


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
    """

    count: int
    seed: int
    mean: NDArray[np.float64]
    rows: tuple[NDArray[np.float32], ...]
    scatter: tuple[NDArray[np.float64], ...]
    squares: NDArray[np.float64]
    examples: NDArray[np.float32]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the state as plain arrays, for a checkpoint."""
        result: dict[str, NDArray[Any]] = {
            "count": np.array(self.count),
            "seed": np.array(self.seed),
            "mean": self.mean,
            "squares": self.squares,
            "examples": self.examples,
        }
        for c, (rows, scatter) in enumerate(zip(self.rows, self.scatter, strict=True)):
            result |= {f"rows{c}": rows, f"scatter{c}": scatter}
        return result

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> EigenState:
        """Rebuild a state from the result of `arrays`; the next blocks then give equal bits."""
        channels = range(len(arrays["mean"]))
        return cls(
            int(arrays["count"]),
            int(arrays["seed"]),
            arrays["mean"],
            tuple(arrays[f"rows{c}"] for c in channels),
            tuple(arrays[f"scatter{c}"] for c in channels),
            arrays["squares"],
            arrays["examples"],
        )


def empty_state(size: tuple[int, int], seed: int = 0) -> EigenState:
    """Return the state of no images, with three channels of a size (width, height)."""
    if seed < 0:
        raise ValueError(f"seed is {seed}; expected no negative number")
    pixels = size[0] * size[1]
    return EigenState(
        count=0,
        seed=seed,
        mean=np.zeros((3, pixels)),
        rows=(np.zeros((0, pixels), np.float32),) * 3,
        scatter=(np.zeros(0),) * 3,
        squares=np.zeros(3),
        examples=np.zeros((0, 3, pixels), np.float32),
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
    examples = _draw_examples(state, block)
    mean = block.mean(axis=0, dtype=np.float64)
    # This shift towards the old mean gives the new images the scatter of both last terms.
    block -= (mean + np.sqrt(n / (n + b)) * (state.mean - mean)).astype(np.float32)
    rows, scatter, squares = [], [], []
    for c, most in enumerate(rank):
        gram = _gram(state.rows[c], state.scatter[c], block[:, c])
        squares.append(np.trace(gram[len(state.rows[c]) :, len(state.rows[c]) :]))
        values, weights = _largest_eigenpairs(gram, most, FLOOR * (n + b) * block.shape[2])
        weights[: len(state.rows[c])] *= np.sqrt(state.scatter[c])[:, None]
        directions = _rotate(state.rows[c], block[:, c], weights.T.astype(np.float32))
        directions, values = _orthonormalize(directions, values)
        rows.append(directions)
        scatter.append(values)
    return EigenState(
        count=n + b,
        seed=state.seed,
        mean=state.mean + b / (n + b) * (mean - state.mean),
        rows=tuple(rows),
        scatter=tuple(scatter),
        squares=state.squares + squares,
        examples=examples,
    )


def _gram(
    rows: NDArray[np.float32], scatter: NDArray[np.float64], block: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the Gram matrix of ``[sqrt(scatter) rows; block]``; the upper right stays 0."""
    r = len(rows)
    gram = np.zeros((r + len(block),) * 2)
    gram[np.arange(r), np.arange(r)] = scatter
    gram[r:, :r] = _product(block, rows) * np.sqrt(scatter)
    gram[r:, r:] = _product(block, block)
    return gram


def _product(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return ``a b^T`` of long rows; pure single precision would lose small variances."""
    result = np.zeros((len(a), len(b)))
    for first in range(0, a.shape[1], COLUMNS):
        result += a[:, first : first + COLUMNS] @ b[:, first : first + COLUMNS].T
    return result


def _largest_eigenpairs(
    gram: NDArray[np.float64], most: int, floor: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the largest eigenvalues, descending, and the weights of rows in unit eigenvectors."""
    values, vectors = np.linalg.eigh(gram, UPLO="L")
    values, vectors = values[::-1][:most], vectors[:, ::-1][:, :most]
    significant = values > max(floor, NOISE * np.trace(gram))
    return values[significant], vectors[:, significant] / np.sqrt(values[significant])


def _rotate(
    rows: NDArray[np.float32], block: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Combine old rows and new images into new rows."""
    result = weights[:, len(rows) :] @ block
    result += weights[:, : len(rows)] @ rows
    return result


def _orthonormalize(
    rows: NDArray[np.float32], scatter: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Drop spurious rows and make the others orthonormal again after rounding."""
    overlap = _product(rows, rows)
    # If the length of a row is far from 1, its eigenvalue is rounding and the row means nothing.
    real = np.abs(np.diag(overlap) - 1) < 0.5
    if not real.all():
        rows, scatter, overlap = rows[real], scatter[real], overlap[real][:, real]
    if np.abs(overlap - np.eye(len(rows))).max(initial=0) > DRIFT:
        # Gram-Schmidt, largest scatter first, so that errors leave the rows of small scatter.
        inverse = np.linalg.inv(np.linalg.cholesky(overlap))
        rows = inverse.astype(np.float32) @ rows
    return rows, scatter


def _draw_examples(state: EigenState, block: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sample examples by reservoir: image i draws one of i + 1 places; the first places count."""
    examples = list(state.examples)
    for i, image in enumerate(block, state.count):
        # One generator for each image, so that no generator is part of the state.
        place = i if i < EXAMPLES else np.random.default_rng((state.seed, i)).integers(i + 1)
        if place < EXAMPLES:
            examples[place : place + 1] = [image.copy()]
    return np.stack(examples)
