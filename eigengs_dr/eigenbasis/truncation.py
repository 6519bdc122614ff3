"""How the error falls from component to component, and how few of them are enough.

On orthonormal components a channel x of an image, less the mean image, with the coefficients w_j,
has the error ::

    left(k) = |x|^2 - sum_(j <= k) w_j^2

after the first k, so one cumulative sum tells it for every k. On average over a family, w_j^2 is
the eigenvalue lambda_j, and |x|^2 the sum of them all.

For a family, components of all channels are taken in one order, that of falling eigenvalues; for
one image, each channel has as many as makes the fewest in all.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MIN_MSE = 1e-12
"""Mean squared error below which all is rounding in single precision: 120 dB."""

Values = NDArray[np.float64]


class TruncationCurve(NamedTuple):
    """How much better an image is shown by 0, 1, 2, ..., n components.

    Attributes
    ----------
    counts : ndarray of int64, shape (n + 1, C)
        How many these are of each channel.
    psnr : ndarray of float64, shape (n + 1,)
        In dB, ascending, at most 120: of the channels as they are, neither clamped nor rounded,
        with peak 1. That is psnr_ycbcr where they are Y, Cb and Cr.
    """

    counts: NDArray[np.int64]
    psnr: Values

    def rank_for_psnr(self, target_psnr: float) -> tuple[int, ...]:
        """Find the fewest components of each channel that reach a PSNR.

        Parameters
        ----------
        target_psnr : float
            In dB.

        Returns
        -------
        tuple of C ints

        Raises
        ------
        ValueError
            If the target is no positive number.

        Warns
        -----
        UserWarning
            If all components do not reach it; the result is all of them.
        """
        check_target(target_psnr)
        enough = self.psnr >= target_psnr
        if not enough.any():
            _warn_out_of_reach(target_psnr, self.counts[-1], self.psnr[-1])
        return tuple(self.counts[enough.argmax() if enough.any() else -1].tolist())

    def explained_variance_ratio(self) -> Values:
        """Return the share of the error without components that each number of them takes away.

        Returns
        -------
        ndarray of float64, shape (n + 1,)
            From 0 up to 1. Where the error is that of the training images, it is their variance.
        """
        return 1 - 10 ** ((self.psnr[0] - self.psnr) / 10)


def curve_from_residuals(
    eigenvalues: Sequence[Values], left: Sequence[Values], entries: int
) -> TruncationCurve:
    """Put the channels together.

    Parameters
    ----------
    eigenvalues : sequence of C ndarrays, shape (k_c,)
        Variances along the components, descending.
    left : sequence of C ndarrays of float64, shape (k_c + 1,) or (M, k_c + 1)
        Squared error of a channel, summed over its pixels, after 0, 1, ..., k_c of its components;
        of one image, or of each of M.
    entries : int
        Pixels times channels, H W C.

    Returns
    -------
    Fall
        With the mean PSNR of the M images.
    """
    channels = range(len(eigenvalues))
    order = np.argsort(-np.concatenate(eigenvalues), kind="stable")
    channel = np.repeat(channels, [len(values) for values in eigenvalues])[order]
    added = channel[:, None] == np.array(channels)
    counts = np.vstack([np.zeros(len(channels), np.int64), np.cumsum(added, axis=0)])
    error = sum(rows[..., n] for rows, n in zip(left, counts.T, strict=True)) / entries
    return TruncationCurve(counts, np.atleast_2d(_decibels(error)).mean(axis=0))


def curve_from_eigenvalues(
    eigenvalues: Sequence[Values], variance: Values, entries: int
) -> TruncationCurve:
    """Tell how the error of the training images falls: that of their PCA, by eigenvalues alone.

    Parameters
    ----------
    eigenvalues, entries
        See `curve_from_residuals`.
    variance : ndarray of float64, shape (C,)
        Sum of all eigenvalues of a channel, of kept components or not.

    Returns
    -------
    Fall
        With the PSNR of the mean error. Images that were not trained on have a larger one.
    """
    left = [
        residual_energy(total, values) for total, values in zip(variance, eigenvalues, strict=True)
    ]
    return curve_from_residuals(eigenvalues, left, entries)


def min_ranks_per_channel(
    left: Sequence[Values], entries: int, target_psnr: float
) -> tuple[int, ...]:
    """Find the fewest components in all that reach a PSNR for one image, each channel's apart.

    Parameters
    ----------
    left : sequence of 3 ndarrays, shape (k_c + 1,)
        See `curve_from_residuals`; descending.
    entries : int
        Pixels times channels.
    target_psnr : float
        In dB.

    Returns
    -------
    tuple of 3 ints
        Raises and warns as `TruncationCurve.fewest` does.
    """
    check_target(target_psnr)
    first, second, third = left
    allowed = entries * 10 ** (-target_psnr / 10) - second[:, None] - third
    needed = np.searchsorted(-first, -allowed)  # of the first channel, for all numbers of the rest
    total = needed + np.arange(len(second))[:, None] + np.arange(len(third))
    total[needed == len(first)] = sum(map(len, left))
    if total.min() == sum(map(len, left)):
        last = sum(rows[-1] for rows in left) / entries
        counts = tuple(len(rows) - 1 for rows in left)
        _warn_out_of_reach(target_psnr, counts, float(_decibels(last)))
        return counts
    j, k = np.unravel_index(total.argmin(), total.shape)
    return int(needed[j, k]), int(j), int(k)


def residual_energy(total: float, gains: Values) -> Values:
    """``total - sum_(i <= n) gains_i`` for n = 0, 1, ..., k: shape (k + 1,) of gains (k,)."""
    return total - np.concatenate([[0.0], np.cumsum(gains, dtype=np.float64)])


def check_target(target_psnr: float) -> None:
    """Raise ValueError unless a PSNR is a positive number."""
    if not 0 < target_psnr < math.inf:
        raise ValueError(f"target_psnr is {target_psnr}; expected a number of dB above 0")


def _decibels(error: NDArray[np.float64] | float) -> Values:
    return -10 * np.log10(np.maximum(error, MIN_MSE))


def _warn_out_of_reach(target_psnr: float, counts: Iterable[int], reached: float) -> None:
    every = "+".join(map(str, counts))
    warnings.warn(
        f"{target_psnr:g} dB are out of reach: all {every} components have {reached:.2f}",
        stacklevel=3,
    )
