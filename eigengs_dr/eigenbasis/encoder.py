"""Images to Gaussians of a model: colours by least squares on its shapes or on its components.

Coefficients are least squares on the rendered components: on all, or on the fewest for a PSNR.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from ..fitting.solvers.normal_equations import NormalEquations, squared_norms
from ..gaussian.gaussians import Gaussians, with_colors
from ..image.color import RGB_TO_YCBCR, YCBCR_OFFSET, to_planes
from ..image.resize import resample
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


Planes = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Encoder:
    """What images of one model share, and the functions that need it.

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
        """Normal equations of all Gaussians, with their factors."""
        return NormalEquations(self.gaussians, self.low)

    def project(self, image: Planes, target_psnr: float | None) -> Coefficients:
        """Return the coefficients of a checked image (H, W, 3); see `eigengs_dr.EigenGS.project`.

        Parameters
        ----------
        image : ndarray of float32, shape (H, W, 3)
        target_psnr : float or None
        """
        pixels = self.resized(image)
        return self._coefficients(pixels, self._correlate([pixels]), False, target_psnr)

    def reconstruct(
        self, coefficients: Sequence[Any], size: tuple[int, int] | None = None
    ) -> Gaussians:
        """Turn coefficients into Gaussians; see `eigengs_dr.EigenGS.reconstruct`.

        Parameters
        ----------
        coefficients : sequence of C array_like, shape (m_c,)
        size : (int, int), optional

        Raises
        ------
        ValueError
            If there is not one array for each channel, or one has too many coefficients.
        """
        shapes = [np.shape(values) for values in coefficients]
        most = tuple(len(weights) for weights in self.weights)
        if len(shapes) != len(most) or not all(
            len(shape) == 1 and shape[0] <= k for shape, k in zip(shapes, most, strict=True)
        ):
            raise ValueError(f"coefficients have shapes {shapes}; expected up to {most}")
        return self._colored(self._mean_coefficients + self._sum(coefficients), size)

    def encode(
        self, images: list[Planes], colors: str, mean: str, target_psnr: float | None
    ) -> list[Gaussians]:
        """Encode checked images of any size together; see `eigengs_dr.EigenGS.encode`.

        Parameters
        ----------
        images : list of ndarray of float32, shape (H, W, 3)
        colors, mean, target_psnr
            Checked by `eigengs_dr.eigenbasis.encoder.check_encoding`.
        """
        sizes = [(pixels.shape[1], pixels.shape[0]) for pixels in images]
        resized = [self.resized(pixels) for pixels in images]
        channels, centred = len(self.weights), mean == "dense"
        correlations = self._correlate(resized)
        if centred:
            correlations -= np.tile(self._dense_mean_correlations, len(images))
        parts = [slice(k, k + channels) for k in range(0, correlations.shape[1], channels)]
        if colors == "exact":
            solved = self.equations.solve(correlations)
            return [
                self._colored(solved[:, part], size)
                for part, size in zip(parts, sizes, strict=True)
            ]
        result = []
        for part, size, pixels in zip(parts, sizes, resized, strict=True):
            products = correlations[:, part]
            coefficients = self._coefficients(pixels, products, centred, target_psnr)
            if centred:
                result.append(self._colored(self._sum(coefficients), size))
            else:
                result.append(self.reconstruct(coefficients, size))
        return result

    def resized(self, pixels: Planes) -> Planes:
        """Return an image at the size of the model."""
        width, height = self.gaussians.width, self.gaussians.height
        same = pixels.shape[:2] == (height, width)
        return pixels if same else resample(pixels, width, height)

    def _correlate(self, images: list[Planes]) -> NDArray[np.float64]:
        """Return ``[A 1]^T x`` of all channels of images of the model's size, shape (N + 1, C M).

        The conversion of RGB pixels D is affine: ``A^T (M D + o) = M A^T D + o A^T 1``. There are
        fewer Gaussians than pixels, and the colours of "coffee" have half of the rounding error.
        """
        [planes, *others] = [np.moveaxis(pixels, 2, 0) for pixels in images]
        if others:
            # An array that NumPy makes has pixels, not planes, in its memory.
            whole = np.empty((3 * len(images), *planes.shape[1:]), np.float32)
            planes = np.concatenate([planes, *others], out=whole)
        found = self.equations.correlate(planes)
        if self.gaussians.space == "rgb":
            return found
        for k in range(0, found.shape[1], 3):
            found[:, k : k + 3] = found[:, k : k + 3] @ RGB_TO_YCBCR.T + self._offsets
        return found

    @cached_property
    def _offsets(self) -> NDArray[np.float64]:
        """Correlations of a black image in YCbCr, shape (N + 1, 3)."""
        pixels = self.gaussians.width * self.gaussians.height
        return np.outer(np.append(self.equations.coverage, pixels), YCBCR_OFFSET)

    def _colored(
        self, coefficients: NDArray[np.float64], size: tuple[int, int] | None
    ) -> Gaussians:
        """Return the shapes of the model with colours and background, scaled to a size."""
        result = with_colors(self.gaussians, coefficients, self.gaussians.space)
        return result.scaled(*size) if size else result

    @cached_property
    def _mean_coefficients(self) -> NDArray[np.float64]:
        """Colours and background of the mean image, shape (N + 1, C)."""
        arrays = self.gaussians.to_arrays()
        return np.vstack([arrays["color"], arrays["background"]]).astype(np.float64)

    @cached_property
    def _mean_product(self) -> NDArray[np.float64]:
        """Correlations of the rendered mean image with all Gaussians, shape (N + 1, C)."""
        return self.equations.product(self._mean_coefficients)

    @cached_property
    def _dense_mean_correlations(self) -> NDArray[np.float64]:
        """Correlations of the pixels of the mean image, shape (N + 1, C)."""
        return self.equations.correlate(self.mean_image)

    @cached_property
    def _projector(self) -> ComponentProjector:
        """Least squares on the rendered components."""
        return ComponentProjector(self.equations, self.weights)

    def _coefficients(
        self,
        pixels: Planes,
        correlations: NDArray[np.float64],
        centred: bool,
        target_psnr: float | None,
    ) -> Coefficients:
        """Solve least squares on the rendered components for an image of the model's size.

        `centred` correlations lack the mean image.
        """
        products = correlations if centred else correlations - self._mean_product
        if target_psnr is None:
            return self._projector.coefficients(products)
        planes = to_planes(pixels, self.gaussians.space).reshape(self.mean_image.shape)
        if centred:
            lengths = squared_norms(planes - self.mean_image)
        else:
            lengths = squared_norms(planes)
            lengths = self.equations.error(self._mean_coefficients, correlations, lengths)
        return self._projector.coefficients_for_psnr(products, lengths, planes.size, target_psnr)

    def _sum(self, coefficients: Sequence[Any]) -> NDArray[np.float64]:
        """Return ``sum_j a_j psi_nj`` of each channel, shape (N + 1, C)."""
        columns = []
        for weights, values in zip(self.weights, coefficients, strict=True):
            column, values = np.zeros(weights.shape[1], np.float32), np.asarray(values, np.float32)
            if len(values):  # an empty einsum was NaN once, in one of some ten runs of the tests
                np.einsum("j,jn->n", values, weights[: len(values)], out=column)
            columns.append(column)
        return np.stack(columns, axis=1).astype(np.float64)


def check_encoding(colors: str, mean: str, target_psnr: float | None) -> None:
    """Raise ValueError for options of `eigengs_dr.EigenGS.encode` that are unknown or contradict.

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
