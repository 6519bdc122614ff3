"""The best colours of many images on the same shapes, by one sparse factorisation.

Column n of A holds the weights of Gaussian n at all pixels. The best colours c and background b of
an image D minimise ``|A c + b 1 - D|^2``. ``A^T A`` depends only on the shapes: it is factorised
once, and each image costs one product and one back-substitution. For a single image,
`eigengs_dr.fitting.solve` is cheaper.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise, repeat
from operator import matmul
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from ..backend.arrays import types_of, upload
from ..backend.types import Doubles, Singles
from ..gaussian.gaussians import Gaussians
from ..image.pixels import available_cores
from ..raster.evaluate import weights
from ..raster.parameters import (
    NUM_SHAPE_PARAMS,
    kernel_radius,
    kernel_shape,
    pack_parameters,
    unpack_parameters,
)

THREADS = min(4, available_cores())
"""Number of threads that share a sparse product; SciPy releases the interpreter lock. The result
does not depend on it."""

BATCH = 48
"""Number of columns of one sparse product."""

STRIP_PIXELS = 2048
"""Number of pixels that are transposed at once; the planes of a strip fit into the cache."""

RIDGE = 1e-4
"""Value added to the diagonal of ``A^T A``, relative to the mean of the diagonal. It bounds the
colours of Gaussians that overlap strongly, without a visible effect."""


class FactoredBlock(NamedTuple):
    """Consecutive Gaussians whose colours are solved for together.

    Attributes
    ----------
    rows : slice
        Range of the Gaussians.
    factor : SuperLU
        Factorisation of ``A^T A + ridge`` in single precision, which halves the memory that is read
        for every image; its rounding error is below the ridge.
    background_response : ndarray of float64, shape (n,)
        ``h = (A^T A + ridge)^-1 A^T 1``: a background b changes the colours by ``-b h``.
    """

    rows: slice
    factor: SuperLU
    background_response: Doubles


def _divide(factor: SuperLU, sums: Doubles) -> Doubles:
    """Return ``(A^T A + ridge)^-1`` times a column (n,) or columns (n, M)."""
    return factor.solve(np.asarray(sums, np.float32, order="F")).astype(np.float64)


_POOL = ThreadPoolExecutor(THREADS, thread_name_prefix="columns")
"""The threads of sparse products; they start at the first one."""


class NormalEquations:
    """Factorised equations ``(A^T A + ridge) c = A^T (D - b)`` for any number of images D.

    The solution is exact or, with `low`, computed for two blocks of Gaussians one after the other.

    The background is a dense column of ones next to A, and not part of the sparse factor: block
    elimination computes it from two sums. A column of coefficients holds N colours and, last, the
    background.

    Parameters
    ----------
    gaussians : Gaussians
        Shapes and native size; the colours are ignored.
    low : int, optional
        If positive, the first `low` Gaussians and the background fit the image, and the other
        Gaussians fit the residual. If large Gaussians precede small ones, this solution is about
        0.1 dB worse than the exact one, in which large numbers cancel; after refinement, the exact
        one is 1 dB worse.

    Raises
    ------
    ValueError
        If the equations are singular to working precision because shapes are too similar.
    """

    def __init__(self, gaussians: Gaussians, low: int = 0) -> None:
        self.count = len(gaussians)
        self.width, self.height = gaussians.width, gaussians.height
        matrix = weight_matrix(gaussians)
        double = matrix.astype(np.float64)
        self.gram = (double @ double.T).tocsr()
        self.coverage = np.asarray(matrix.sum(axis=1), np.float64)
        ends = [self.count * k // THREADS for k in range(THREADS + 1)]
        self.shares = [matrix[slice(*pair)] for pair in pairwise(ends)]
        ends = [0, low, self.count] if low else [0, self.count]
        self.blocks = [self._block(slice(*pair)) for pair in pairwise(ends)]

    def _block(self, rows: slice) -> FactoredBlock:
        """Factorise the equations of some Gaussians."""
        gram = self.gram[rows, rows]
        ridge = max(RIDGE * gram.diagonal().mean(), 1e-12)
        system = (gram + diags_array(np.full(gram.shape[0], ridge))).tocsr()
        try:
            factor = splu(
                system.tocsc().astype(np.float32),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                relax=1,  # with the default, back-substitution takes 1.1 times as long
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise ValueError(
                f"the equations of the Gaussians' colours are singular ({error}); use shapes that "
                "differ more"
            ) from None
        coverage = self.coverage[rows]
        response = _divide(factor, coverage)  # with one step of iterative refinement
        response = response + _divide(factor, coverage - system @ response)
        return FactoredBlock(rows, factor, response)

    def correlate(self, images: Singles) -> Doubles:
        """Return ``A^T D`` and, in the last row, ``1^T D``.

        Parameters
        ----------
        images : ndarray of float32, shape (M, H, W)
            M planes of the native size. The 3 planes of one image may be views of it, such as
            ``numpy.moveaxis(pixels, 2, 0)``.

        Returns
        -------
        ndarray of float64, shape (N + 1, M)
            Cost: one sparse product for `BATCH` planes.
        """
        result = np.empty((self.count + 1, len(images)))
        for first in range(0, len(images), BATCH):
            planes = images[first : first + BATCH]
            products = _POOL.map(matmul, self.shares, repeat(_columns(planes)))
            result[:-1, first : first + len(planes)] = np.vstack(list(products))
        # Summing along the axis of rows first is fast for planes and for interleaved pixels.
        result[-1] = images.sum(axis=1).sum(axis=1, dtype=np.float64)
        return result

    def solve(self, correlations: Doubles) -> Doubles:
        """Return the least-squares coefficients for the result of `correlate`.

        Parameters
        ----------
        correlations : ndarray of float64, shape (N + 1, M)

        Returns
        -------
        ndarray of float64, shape (N + 1, M)
            With two blocks, the second fits the residual of the first.
        """
        first, *others = self.blocks
        sums, total = correlations[first.rows], correlations[-1]
        pixels = self.width * self.height
        response = first.background_response
        free = pixels - response @ self.coverage[first.rows]
        # If the Gaussians alone can form a constant, the background is not determined: use 0.
        background = (total - response @ sums) / free if free > 1e-6 * pixels else 0 * total
        coefficients = np.zeros(correlations.shape)
        coefficients[-1] = background
        coefficients[first.rows] = _divide(first.factor, sums) - np.outer(response, background)
        for block in others:
            residual = correlations - self.product(coefficients)
            coefficients[block.rows] = _divide(block.factor, residual[block.rows])
        return coefficients

    def product(self, coefficients: Doubles) -> Doubles:
        """Return ``[A 1]^T [A 1] x`` for coefficients x of shape (N + 1, M)."""
        colors, background = coefficients[:-1], coefficients[-1:]
        pixels = self.width * self.height
        return np.vstack(
            [
                self.gram @ colors + self.coverage[:, None] * background,
                self.coverage @ colors + pixels * background[0],
            ]
        )

    def error(
        self, coefficients: Doubles, correlations: Doubles, squared_norms: Doubles
    ) -> Doubles:
        """Return ``|A c + b 1 - D|^2`` of M images from inner products, without rendering.

        Parameters
        ----------
        coefficients, correlations : ndarray of float64, shape (N + 1, M)
        squared_norms : ndarray of float64, shape (M,)
            ``|D|^2``; the result is accurate to about 1e-6 of this number.

        Returns
        -------
        ndarray of float64, shape (M,)
        """
        product = self.product(coefficients)
        error = squared_norms + ((product - 2 * correlations) * coefficients).sum(axis=0)
        return np.maximum(error, 0)


def _columns(planes: Singles) -> Singles:
    """Return planes (M, H, W) as columns (H W, M); a view of interleaved pixels is not copied."""
    pixels = np.moveaxis(planes, 0, 2)
    if pixels.flags.c_contiguous:
        return pixels.reshape(-1, len(planes))
    flat = planes.reshape(len(planes), -1)
    columns = np.empty(flat.shape[::-1], np.float32)
    for first in range(0, len(columns), STRIP_PIXELS):
        columns[first : first + STRIP_PIXELS] = flat[:, first : first + STRIP_PIXELS].T
    return columns


def squared_norms(planes: Singles) -> Doubles:
    """Return ``|D|^2`` of every plane D, shape (M,), for planes (M, H, W)."""
    return np.einsum("nij,nij->n", planes, planes, dtype=np.float64)


MAX_WEIGHTS = 1 << 28
"""Largest number of weights of a matrix, which take 6 GiB with their indices."""


def weight_matrix(gaussians: Gaussians) -> csr_array:
    """Return the weights of every Gaussian at every pixel of the native size: the transpose of A.

    Parameters
    ----------
    gaussians : Gaussians
        N Gaussians; the colours are ignored.

    Returns
    -------
    csr_array of float32, shape (N, H * W)
        Row n holds the weights of Gaussian n, by `eigengs_dr.raster.evaluate.weights`. Each pixel
        inside an ellipse takes 8 bytes in the result, and 30 bytes during the computation.

    Raises
    ------
    ValueError
        If the ellipses have more than `MAX_WEIGHTS` pixels in total.
    """
    arrays = gaussians.to_arrays()
    splat, x, y = _pixels_inside(
        arrays["mean"].astype(np.float64),
        arrays["factor"].astype(np.float64),
        gaussians.width,
        gaussians.height,
        gaussians.cutoff,
    )
    size = (len(gaussians), gaussians.width * gaussians.height)
    if len(splat) == 0:  # Dr.Jit does not support empty arrays here
        return csr_array(size, dtype=np.float32)
    types = types_of(gaussians.mean)
    with dr.suspend_grad():
        packed = pack_parameters(kernel_shape(gaussians))
        shape = unpack_parameters(packed, upload(types.UInt, splat), NUM_SHAPE_PARAMS)
        px, py = (upload(types.Float, (p + 0.5).astype(np.float32)) for p in (x, y))
        [values] = weights(shape, px, py, (1, 1), kernel_radius(gaussians.cutoff))
    columns = y * gaussians.width + x
    starts = np.concatenate([[0], np.cumsum(np.bincount(splat, minlength=len(gaussians)))])
    return csr_array((values.numpy(), columns, starts.astype(np.int32)), shape=size)


def _pixels_inside(
    mean: Doubles, factor: Doubles, width: int, height: int, cutoff: float
) -> tuple[NDArray[np.uint32], NDArray[np.int32], NDArray[np.int32]]:
    """List (Gaussian, x, y) of the pixels inside each ellipse, row by row.

    On the row at distance dy, ``|F (x - mu)| <= cutoff`` is
    ``|a dx + b dy| <= sqrt(cutoff^2 - (c dy)^2)``.
    """
    a, b, c = factor.T
    reach = cutoff / c
    low = np.clip(np.ceil(mean[:, 1] - reach - 0.5), 0, height).astype(np.int32)
    high = np.clip(np.floor(mean[:, 1] + reach - 0.5) + 1, low, height).astype(np.int32)
    splat, y = _expand(low, high)
    dy = y + 0.5 - mean[splat, 1]
    half = np.sqrt(np.maximum(cutoff**2 - (c[splat] * dy) ** 2, 0)) / a[splat]
    middle = mean[splat, 0] - b[splat] / a[splat] * dy
    low = np.clip(np.ceil(middle - half - 0.5), 0, width).astype(np.int32)
    high = np.clip(np.floor(middle + half - 0.5) + 1, low, width).astype(np.int32)
    row, x = _expand(low, high)
    return splat[row].astype(np.uint32), x, y[row]


def _expand(
    low: NDArray[np.int32], high: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the integers of the ranges [low, high), each with the index of its range."""
    count = high - low
    total = int(count.sum(dtype=np.int64))
    if total > MAX_WEIGHTS:
        raise ValueError(
            f"the Gaussians cover {total:,} pixels in total, the limit is {MAX_WEIGHTS:,}; use "
            "fewer, or a smaller size"
        )
    index = np.repeat(np.arange(len(low)), count)
    before = np.repeat(np.cumsum(count) - count, count)
    return index, (np.arange(len(index)) - before + low[index]).astype(np.int32)
