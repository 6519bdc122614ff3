"""Least squares on the rendered components of a model: on all, or on the fewest for a PSNR."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from ..fitting.solvers.normal_equations import NormalEquations
from .pca.truncation import min_ranks_per_channel, residual_energy

Coefficients = tuple[NDArray[np.float32], ...]


class ComponentProjector:
    """Projector of images onto the rendered components Psi~ of each channel.

    With the Cholesky factor L of ``Psi~^T Psi~``, the coefficients of an image x are
    ``a = L^-T y`` with ``y = L^-1 Psi~^T x``. The entries of y are the coefficients on the
    components after Gram-Schmidt orthonormalisation. Therefore the first k components leave the
    error ``|x|^2 - sum_(j <= k) y_j^2``, and their coefficients follow from the leading blocks of
    L and y.

    Parameters
    ----------
    equations : NormalEquations
        Normal equations of the N Gaussians.
    weights : sequence of C ndarrays of float32, shape (k_c, N + 1)
        See `eigengs_dr.EigenGS`.
    """

    def __init__(self, equations: NormalEquations, weights: Sequence[NDArray[np.float32]]) -> None:
        self.weights = weights
        self.factors: list[Any] = []
        for rows in weights:
            # Double precision and a ridge: in some models components outnumber the Gaussians, or
            # two components render alike.
            double = rows.astype(np.float64)
            gram = double @ equations.product(double.T)
            gram += np.eye(len(gram)) * (1e-9 * np.trace(gram) / max(1, len(gram)) + 1e-30)
            self.factors.append(cho_factor(gram, lower=True) if len(gram) else None)

    def coefficients(self, correlations: NDArray[np.float64]) -> Coefficients:
        """Return the coefficients on all components.

        Parameters
        ----------
        correlations : ndarray of float64, shape (N + 1, C)
            ``[A 1]^T x`` of each channel of an image x, less the mean image.

        Returns
        -------
        tuple of C ndarrays of float32, shape (k_c,)
        """
        result = []
        for rhs, factor in zip(self._inner_products(correlations), self.factors, strict=True):
            solution = cho_solve(factor, rhs, check_finite=False) if len(rhs) else rhs
            result.append(solution.astype(np.float32))
        return tuple(result)

    def coefficients_for_psnr(
        self,
        correlations: NDArray[np.float64],
        squares: NDArray[np.float64],
        entries: int,
        target_psnr: float,
    ) -> Coefficients:
        """Return the coefficients on the fewest components that reach a PSNR.

        Parameters
        ----------
        correlations
            See `coefficients`.
        squares : ndarray of float64, shape (C,)
            ``|x|^2`` of each channel.
        entries : int
            Number of pixels times channels.
        target_psnr : float
            In dB; see `eigengs_dr.eigenbasis.pca.truncation`. The ridge on the
            diagonal of ``Psi~^T Psi~`` makes the real error smaller than the estimate.

        Returns
        -------
        tuple of C ndarrays of float32, shape (m_c,)
            With ``m_c <= k_c``.
        """
        halves = [
            solve_triangular(factor[0], rhs, lower=True, check_finite=False) if len(rhs) else rhs
            for rhs, factor in zip(self._inner_products(correlations), self.factors, strict=True)
        ]
        pairs = zip(squares, halves, strict=True)
        residuals = [residual_energy(total, y.astype(np.float64) ** 2) for total, y in pairs]
        counts = min_ranks_per_channel(residuals, entries, target_psnr)
        result = []
        for y, factor, k in zip(halves, self.factors, counts, strict=True):
            solution = y[:k]
            if k:
                lower = factor[0][:k, :k]
                solution = solve_triangular(lower, solution, "T", lower=True, check_finite=False)
            result.append(solution.astype(np.float32))
        return tuple(result)

    def _inner_products(self, correlations: NDArray[np.float64]) -> list[NDArray[np.float32]]:
        """Return ``Psi~^T x`` of each channel."""
        # Not BLAS: its threads and those of Dr.Jit wait for each other, which is twice as slow.
        return [
            np.einsum("jn,n->j", weights, correlations[:, c].astype(np.float32))
            for c, weights in enumerate(self.weights)
        ]
