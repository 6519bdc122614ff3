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
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cholesky, solve_triangular

from ..backend.doors import class_of_doors
from ..gaussian.gaussians import Gaussians, with_colors
from ..image.color import RGB_TO_YCBCR, YCBCR_OFFSET, to_planes
from ..image.resize import resample
from .normal_equations import NormalEquations, squared_norms
from .truncation import min_ranks_per_channel, residual_energy

Planes = NDArray[np.float32]
Columns = NDArray[np.float64]


@class_of_doors
@dataclass(frozen=True, eq=False)
class ModelEncoder:
    """The functions that encode images by a model, with the values that all images share.

    Attributes
    ----------
    gaussians, weights, mean_image, low
        See `eigengs_dr.EigenGS`.
    """

    gaussians: Gaussians
    weights: tuple[Planes, ...]
    mean_image: Planes
    low: int

    @cached_property
    def equations(self) -> NormalEquations:
        """Factorised normal equations of all Gaussians."""
        return NormalEquations(self.gaussians, self.low)

    def project(self, image: Planes, target_psnr: float | None) -> tuple[Planes, ...]:
        """Return the coefficients of a checked image (H, W, 3); see `eigengs_dr.EigenGS.project`.

        A target is in dB. Because of the ridge on the diagonal of ``Psi~^T Psi~``, the actual error
        is smaller than the estimate.
        """
        pixels = resample(image, self.gaussians.width, self.gaussians.height)
        return self._coefficients(pixels, self._correlate(pixels), False, target_psnr)

    def reconstruct(
        self, coefficients: Sequence[ArrayLike], size: tuple[int, int] | None = None
    ) -> Gaussians:
        """Convert coefficients to Gaussians; see `eigengs_dr.EigenGS.reconstruct`."""
        shapes = [np.shape(values) for values in coefficients]
        limits = tuple(len(weights) for weights in self.weights)
        if len(shapes) != len(limits) or not all(
            len(shape) == 1 and shape[0] <= k for shape, k in zip(shapes, limits, strict=True)
        ):
            raise ValueError(f"coefficients have shapes {shapes}; expected up to {limits}")
        if not all(np.isfinite(np.asarray(values, np.float32)).all() for values in coefficients):
            raise ValueError("coefficients are not all finite in single precision; replace them")
        return self._colored(self._mean_colors + self._sum(coefficients), size)

    def encode(self, image: Planes, colors: str, mean: str, target_psnr: float | None) -> Gaussians:
        """Encode a checked image (H, W, 3) of any size; see `eigengs_dr.EigenGS.encode`."""
        check_coding(colors, mean, target_psnr)
        pixels = resample(image, self.gaussians.width, self.gaussians.height)
        correlations, centred = self._correlate(pixels), mean == "dense"
        if centred:
            correlations -= self._dense_mean_correlations
        if colors == "exact":
            columns = self.equations.solve(correlations)
        else:
            columns = self._sum(self._coefficients(pixels, correlations, centred, target_psnr))
            if not centred:
                columns += self._mean_colors
        return self._colored(columns, (image.shape[1], image.shape[0]))

    def _correlate(self, pixels: Planes) -> Columns:
        """Return ``[A 1]^T x`` of all channels of an image of the model's size, shape (N + 1, C).

        The conversion of RGB pixels D is affine: ``A^T (M D + o) = M A^T D + o A^T 1``. Converting
        the correlations is cheaper, as there are fewer Gaussians than pixels, and halves the
        rounding error of the colours of "coffee".
        """
        correlations = self.equations.correlate(np.moveaxis(pixels, 2, 0))
        if self.gaussians.space == "rgb":
            return correlations
        area = self.gaussians.width * self.gaussians.height
        black = np.outer(np.append(self.equations.coverage, area), YCBCR_OFFSET)
        return correlations @ RGB_TO_YCBCR.T + black

    def _colored(self, columns: Columns, size: tuple[int, int] | None) -> Gaussians:
        """Return the shapes of the model with new colours and background, scaled to a size."""
        result = with_colors(self.gaussians, columns, self.gaussians.space)
        return result.scaled(*size) if size else result

    @cached_property
    def _mean_colors(self) -> Columns:
        """Colours and background of the mean image, shape (N + 1, C)."""
        arrays = self.gaussians.to_arrays()
        return np.vstack([arrays["color"], arrays["background"]]).astype(np.float64)

    @cached_property
    def _mean_product(self) -> Columns:
        """Correlations of the rendered mean image with all Gaussians, shape (N + 1, C)."""
        return self.equations.product(self._mean_colors)

    @cached_property
    def _dense_mean_correlations(self) -> Columns:
        """Correlations of the pixels of the mean image, shape (N + 1, C)."""
        return self.equations.correlate(self.mean_image)

    @cached_property
    def _factors(self) -> list[Columns]:
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
        self, pixels: Planes, correlations: Columns, centred: bool, target_psnr: float | None
    ) -> tuple[Planes, ...]:
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
                lengths = self.equations.error(self._mean_colors, correlations, lengths)
            pairs = zip(lengths, halves, strict=True)
            residuals = [residual_energy(total, y**2) for total, y in pairs]
            counts = min_ranks_per_channel(residuals, planes.size, target_psnr)
        return tuple(
            _solve(factor[:k, :k], y[:k], transposed=True).astype(np.float32)
            for factor, y, k in zip(self._factors, halves, counts, strict=True)
        )

    def _sum(self, coefficients: Sequence[ArrayLike]) -> Columns:
        """Return ``sum_j a_j psi_nj`` of each channel, shape (N + 1, C)."""
        columns = np.zeros((self.weights[0].shape[1], len(self.weights)))
        for c, (weights, given) in enumerate(zip(self.weights, coefficients, strict=True)):
            values = np.asarray(given, np.float32)
            if len(values):  # a channel without components keeps the sum 0
                columns[:, c] = np.einsum("j,jn->n", values, weights[: len(values)])
        return columns


def _solve(lower: Columns, right: NDArray, transposed: bool = False) -> Columns:
    """Solve ``L x = b`` or ``L^T x = b``, which may be empty."""
    if not len(right):
        return right.astype(np.float64)
    return solve_triangular(
        lower, right, trans="T" if transposed else "N", lower=True, check_finite=False
    )


def check_coding(colors: str, mean: str, target_psnr: float | None) -> None:
    """Raise ValueError if options of `eigengs_dr.EigenGS.encode` are unknown or contradictory.

    Parameters
    ----------
    colors, mean, target_psnr
        See `eigengs_dr.EigenGS.encode`.
    """
    for name, value, valid in (
        ("colors", colors, ("exact", "projected")),
        ("mean", mean, ("gaussians", "dense")),
    ):
        if value not in valid:
            raise ValueError(f"{name} {value!r} is unknown; use one of {', '.join(valid)}")
    if colors == "exact" and target_psnr is not None:
        raise ValueError("target_psnr chooses components; use it with colors 'projected'")
