"""Encoding of images as Gaussians of a model: least squares on its shapes or on its components.

Coefficients solve least squares on the rendered components Psi~: on all, or on the fewest for a
PSNR. With the Cholesky factor L of ``Psi~^T Psi~``, the coefficients of an image x are
``a = L^-T y`` with ``y = L^-1 Psi~^T x``. The entries of y are the coefficients on the components
after Gram-Schmidt orthonormalisation. Therefore the residual of the first k components is
``|x|^2 - sum_(j <= k) y_j^2``, and their coefficients follow from the leading blocks of L and y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from ..backend.types import ArrayLike, Doubles, Singles
from ..gaussian.gaussians import Gaussians
from ..image.color import RGB_TO_YCBCR, YCBCR_OFFSET
from ..image.resize import resample
from ..image.space import to_planes
from .normal_equations import NormalEquations, squared_norms
from .truncation import min_ranks_per_channel, residual_energy


@dataclass(frozen=True, eq=False)
class ModelEncoder:
    """The functions that encode images by a model, with the values that all images share.

    Attributes
    ----------
    gaussians, weights, mean_image, low
        See `eigengs_dr.EigenGS`.
    """

    gaussians: Gaussians
    weights: tuple[Singles, ...]
    mean_image: Singles
    low: int

    @cached_property
    def equations(self) -> NormalEquations:
        """Factorised normal equations of all Gaussians."""
        return NormalEquations(self.gaussians, self.low)

    def project(self, image: Singles, target_psnr: float | None) -> tuple[Singles, ...]:
        """Return the coefficients of a checked image (H, W, 3); see `eigengs_dr.EigenGS.project`.

        A target is in dB. Because of the ridge on the diagonal of ``Psi~^T Psi~``, the actual error
        is smaller than the estimate.
        """
        pixels = resample(image, self.gaussians.width, self.gaussians.height)
        return self._coefficients(pixels, self._correlate(pixels), False, target_psnr)

    def columns(
        self, image: Singles, colors: str, centred: bool, target_psnr: float | None
    ) -> Doubles:
        """Return the colours and the background of a checked image (H, W, 3), shape (N + 1, C).

        If `centred`, they do not include the mean image; for the others see
        `eigengs_dr.EigenGS.encode`.
        """
        pixels = resample(image, self.gaussians.width, self.gaussians.height)
        correlations = self._correlate(pixels)
        if centred:
            correlations -= self._dense_mean_correlations
        if colors == "exact":
            return self.equations.solve(correlations)
        coefficients = self._coefficients(pixels, correlations, centred, target_psnr)
        return self.sum(coefficients) if centred else self.sum(coefficients) + self.mean_colors

    def _correlate(self, pixels: Singles) -> Doubles:
        """Return ``[A 1]^T x`` of all channels of an image of the model's size, shape (N + 1, C).

        The conversion of RGB pixels D is affine: ``A^T (M D + o) = M A^T D + o A^T 1``. Converting
        the correlations is cheaper, as there are fewer Gaussians than pixels, and halves the
        rounding error of the colours of "coffee".
        """
        correlations = self.equations.correlate(np.moveaxis(pixels, 2, 0))
        if self.gaussians.space.identical:
            return correlations
        area = self.gaussians.width * self.gaussians.height
        black = np.outer(np.append(self.equations.coverage, area), YCBCR_OFFSET)
        return correlations @ RGB_TO_YCBCR.T + black

    @cached_property
    def mean_colors(self) -> Doubles:
        """Colours and background of the mean image, shape (N + 1, C)."""
        arrays = self.gaussians.to_arrays()
        return np.vstack([arrays["color"], arrays["background"]]).astype(np.float64)

    @cached_property
    def _mean_product(self) -> Doubles:
        """Correlations of the rendered mean image with all Gaussians, shape (N + 1, C)."""
        return self.equations.product(self.mean_colors)

    @cached_property
    def _dense_mean_correlations(self) -> Doubles:
        """Correlations of the pixels of the mean image, shape (N + 1, C)."""
        return self.equations.correlate(self.mean_image)

    @cached_property
    def _factors(self) -> list[Doubles]:
        """Cholesky factors L of ``Psi~^T Psi~``, one for each channel."""
        factors = []
        for rows in self.weights:
            # Double precision and a ridge, because in some models there are more components than
            # Gaussians, or two components have nearly equal renderings.
            double = rows.astype(np.float64)
            gram = double @ self.equations.product(double.T)
            gram += np.eye(len(gram)) * (1e-9 * np.trace(gram) / max(1, len(gram)) + 1e-30)
            factors.append(cholesky(gram, lower=True) if len(gram) else gram)
        return factors

    def _coefficients(
        self, pixels: Singles, correlations: Doubles, centred: bool, target_psnr: float | None
    ) -> tuple[Singles, ...]:
        """Solve least squares on the rendered components for an image of the model's size.

        `centred` correlations do not include the mean image.
        """
        products = correlations if centred else correlations - self._mean_product
        halves = []
        for c, (weights, factor) in enumerate(zip(self.weights, self._factors, strict=True)):
            # Not BLAS, whose threads wait for those of Dr.Jit and vice versa: twice as slow.
            right = np.einsum("jn,n->j", weights, products[:, c].astype(np.float32))
            halves.append(_solve(factor, right))
        counts: Sequence[int] = [len(y) for y in halves]
        if target_psnr is not None:
            planes = to_planes(pixels, self.gaussians.space).reshape(self.mean_image.shape)
            if centred:
                lengths = squared_norms(planes - self.mean_image)
            else:
                lengths = squared_norms(planes)
                lengths = self.equations.error(self.mean_colors, correlations, lengths)
            pairs = zip(lengths, halves, strict=True)
            residuals = [residual_energy(total, y**2) for total, y in pairs]
            counts = min_ranks_per_channel(residuals, planes.size, target_psnr)
        return tuple(
            _solve(factor[:k, :k], y[:k], transposed=True).astype(np.float32)
            for factor, y, k in zip(self._factors, halves, counts, strict=True)
        )

    def sum(self, coefficients: Sequence[ArrayLike]) -> Doubles:
        """Return ``sum_j a_j psi_nj`` of each channel, shape (N + 1, C)."""
        columns = np.zeros((self.weights[0].shape[1], len(self.weights)))
        for c, (weights, given) in enumerate(zip(self.weights, coefficients, strict=True)):
            values = np.asarray(given, np.float32)
            if len(values):  # a channel without components keeps the sum 0
                columns[:, c] = np.einsum("j,jn->n", values, weights[: len(values)])
        return columns


def _solve(lower: Doubles, right: NDArray, transposed: bool = False) -> Doubles:
    """Solve ``L x = b`` or ``L^T x = b``, which may be empty."""
    if not len(right):
        return right.astype(np.float64)
    return solve_triangular(
        lower, right, trans="T" if transposed else "N", lower=True, check_finite=False
    )
