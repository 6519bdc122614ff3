"""The sparse matrix of the weights of all Gaussians at all pixels."""

from __future__ import annotations

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ...backend.arrays import types_of, upload
from ...gaussian.gaussians import Gaussians
from ...raster.evaluate import weights
from ...raster.layout import pack_parameters, unpack_parameters
from ...raster.parameters import NUM_SHAPE_PARAMS, kernel_radius, kernel_shape

MAX_WEIGHTS = 1 << 28
"""Largest number of weights of a matrix; the weights and their indices then take 6 GiB."""


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
        If the ellipses have more than `MAX_WEIGHTS` pixels in all.
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
    if len(splat) == 0:  # Dr.Jit does not compute with no elements
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
    mean: NDArray[np.float64],
    factor: NDArray[np.float64],
    width: int,
    height: int,
    cutoff: float,
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
            f"the Gaussians cover {total:,} pixels in all, over {MAX_WEIGHTS:,}; use fewer, or a "
            "smaller size"
        )
    which = np.repeat(np.arange(len(low)), count)
    before = np.repeat(np.cumsum(count) - count, count)
    return which, (np.arange(len(which)) - before + low[which]).astype(np.int32)
