"""Truncation curves: the error by the number of components, and the rank for a PSNR.

Let x be a channel of an image minus the mean image, and w_j its coefficients on orthonormal
components. The residual of the first k components is ::

    residual(k) = |x|^2 - sum_(j <= k) w_j^2

so one cumulative sum gives the error for every k. On average over a family of images, w_j^2 is the
eigenvalue lambda_j, and |x|^2 is the sum of all eigenvalues.

For a family, the curve adds the components of all channels in the order of descending eigenvalues.
For a single image, each channel has its own rank, and the sum of the ranks is minimal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.messages import warn
from ..backend.types import Doubles

MIN_MSE = 1e-12
"""Lower bound of mean squared errors, 120 dB; smaller errors are rounding of single precision."""


class TruncationCurve(NamedTuple):
    """The PSNR of PCA with 0, 1, 2, ..., n components.

    Attributes
    ----------
    counts : ndarray of int64, shape (n + 1, C)
        Number of components of each channel.
    psnr : ndarray of float64, shape (n + 1,)
        PSNR of all channels in dB, ascending, at most 120. Values are neither clamped nor rounded,
        and the peak is 1: for the channels Y, Cb and Cr, it is psnr_ycbcr.
    """

    counts: NDArray[np.int64]
    psnr: Doubles

    def rank_for_psnr(self, target_psnr: float) -> tuple[int, ...]:
        """Return the fewest components of each channel that reach a PSNR.

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
            If the target is not a positive number.

        Warns
        -----
        UserWarning
            If all components miss the target; the result then has all of them.
        """
        check_target(target_psnr)
        reaches = self.psnr >= target_psnr
        if not reaches.any():
            _warn_out_of_reach(target_psnr, self.counts[-1], self.psnr[-1])
        return tuple(self.counts[reaches.argmax() if reaches.any() else -1].tolist())

    def explained_variance_ratio(self) -> Doubles:
        """Return the share of the initial error that the first 0, 1, ..., n components remove.

        Returns
        -------
        ndarray of float64, shape (n + 1,)
            Ascending from 0 to at most 1. For the training images, the initial error is their
            variance.
        """
        return 1 - 10 ** ((self.psnr[0] - self.psnr) / 10)


def curve_from_residuals(
    eigenvalues: Sequence[Doubles], residuals: Sequence[Doubles], entries: int
) -> TruncationCurve:
    """Build the curve of all channels from the residuals of each.

    Parameters
    ----------
    eigenvalues : sequence of C ndarrays, shape (k_c,)
        Variances along the components, descending.
    residuals : sequence of C ndarrays of float64, shape (k_c + 1,) or (M, k_c + 1)
        Squared error of a channel, summed over its pixels, after 0, 1, ..., k_c components, for
        one image or for M images.
    entries : int
        Number of pixels times number of channels, H W C.

    Returns
    -------
    TruncationCurve
        The mean PSNR of the M images.
    """
    channels = range(len(eigenvalues))
    order = np.argsort(-np.concatenate(eigenvalues), kind="stable")
    channel = np.repeat(channels, [len(values) for values in eigenvalues])[order]
    one_hot = channel[:, None] == np.array(channels)
    counts = np.vstack([np.zeros(len(channels), np.int64), np.cumsum(one_hot, axis=0)])
    error = sum(rows[..., n] for rows, n in zip(residuals, counts.T, strict=True)) / entries
    return TruncationCurve(counts, np.atleast_2d(_decibels(error)).mean(axis=0))


def curve_from_eigenvalues(
    eigenvalues: Sequence[Doubles], variance: Doubles, entries: int
) -> TruncationCurve:
    """Build the curve of the training images from the eigenvalues.

    Parameters
    ----------
    eigenvalues, entries
        See `curve_from_residuals`.
    variance : ndarray of float64, shape (C,)
        Sum of all eigenvalues of each channel, including those of dropped components.

    Returns
    -------
    TruncationCurve
        The PSNR of the mean error. Other images have a larger error.
    """
    residuals = [
        residual_energy(total, values) for total, values in zip(variance, eigenvalues, strict=True)
    ]
    return curve_from_residuals(eigenvalues, residuals, entries)


def min_ranks_per_channel(
    residuals: Sequence[Doubles], entries: int, target_psnr: float
) -> tuple[int, ...]:
    """Return the ranks of the channels with the smallest sum that reach a PSNR for one image.

    Parameters
    ----------
    residuals : sequence of 3 ndarrays, shape (k_c + 1,)
        See `curve_from_residuals`; descending.
    entries : int
        Number of pixels times number of channels.
    target_psnr : float
        In dB.

    Returns
    -------
    tuple of 3 ints
        Errors and warnings as for `TruncationCurve.rank_for_psnr`.
    """
    check_target(target_psnr)
    first, second, third = residuals
    allowed = entries * 10 ** (-target_psnr / 10) - second[:, None] - third
    needed = np.searchsorted(-first, -allowed)  # rank of the first channel for all other ranks
    total = needed + np.arange(len(second))[:, None] + np.arange(len(third))
    total[needed == len(first)] = sum(map(len, residuals))
    if total.min() == sum(map(len, residuals)):
        last = sum(rows[-1] for rows in residuals) / entries
        counts = tuple(len(rows) - 1 for rows in residuals)
        _warn_out_of_reach(target_psnr, counts, float(_decibels(last)))
        return counts
    j, k = np.unravel_index(total.argmin(), total.shape)
    return int(needed[j, k]), int(j), int(k)


def residual_energy(total: float, gains: Doubles) -> Doubles:
    """Return ``total - sum_(i <= n) gains_i`` for n = 0, 1, ..., k, shape (k + 1,)."""
    return total - np.concatenate([[0.0], np.cumsum(gains, dtype=np.float64)])


def check_target(target_psnr: float) -> None:
    """Raise ValueError unless a target PSNR is a positive number."""
    if not 0 < target_psnr < math.inf:
        raise ValueError(f"target_psnr is {target_psnr}; expected a number above 0, in dB")


def _decibels(error: Doubles | float) -> Doubles:
    return -10 * np.log10(np.maximum(error, MIN_MSE))


def _warn_out_of_reach(target_psnr: float, counts: Iterable[int], reached: float) -> None:
    numbers = "+".join(map(str, counts))
    warn(f"{target_psnr:g} dB is out of reach: all {numbers} components reach {reached:.2f}")


CHANNELS = {"ycbcr": ("Y", "Cb", "Cr"), "rgb": ("R", "G", "B")}
"""Names of the channels of a space."""


def name_components(space: str, counts: Iterable[int]) -> str:
    """Return the number of components of each channel as text, e.g. "230 Y, 60 Cb, 60 Cr"."""
    return ", ".join(f"{n} {name}" for n, name in zip(counts, CHANNELS[space], strict=True))
