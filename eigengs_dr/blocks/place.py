"""Where the Gaussians of a block start: the adaptive placement, of one density over all blocks.

Every Gaussian belongs to one block, which places it in its core. The density depends on the pixels
around the core too, so that it is the density of the whole image.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..fitting.placement.adaptive import (
    density_from_hessian,
    lloyd_step,
    normalize_density,
    shapes_from_hessian,
    stratify_along_hilbert,
)
from ..fitting.placement.density import nearest_center, scale_by_owner
from .grid import Block

Array = NDArray[np.floating]


class OldSet(NamedTuple):
    """What a fit has shown about the density.

    Attributes
    ----------
    mean : ndarray, shape (N, 2)
        Means of the Gaussians of a window, in its pixels.
    ratio : ndarray, shape (N,)
        See `eigengs_dr.fitting.placement.density.density_ratio`.
    """

    mean: Array
    ratio: Array


def window_density(image: Array, spacing: float, old: OldSet | None = None) -> NDArray[np.float32]:
    """Return the density of Gaussians in a window, up to a factor that all windows share.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        The window.
    spacing : float
        Mean distance of the Gaussians of the whole image, in pixels.
    old : OldSet, optional
        By default the density follows the second derivatives alone.

    Returns
    -------
    ndarray of float32, shape (H, W)
    """
    density = density_from_hessian(image, spacing)
    if old is not None:
        scale_by_owner(density, nearest_center(old.mean, density.shape), old.ratio)
    return density


def place_block(
    image: Array, block: Block, count: int, spacing: float, old: OldSet | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place and shape the Gaussians of a block.

    Parameters
    ----------
    image : ndarray, shape (H, W, C)
        The window of the block, in the space of the squared error.
    block : Block
    count : int
        Number of Gaussians, from 1 to the pixels of the core.
    spacing, old
        See `window_density`.

    Returns
    -------
    mean : ndarray, shape (count, 2)
        In pixels of the window; all lie in the core.
    factor : ndarray, shape (count, 3)
        See `eigengs_dr.Gaussians`.
    """
    density = window_density(image, spacing, old)
    rows, columns = block.core
    inside = normalize_density(density[rows, columns].copy(), count)
    density[rows, columns] = inside
    mean = lloyd_step(stratify_along_hilbert(inside, count), inside)
    mean += np.array([columns.start, rows.start])
    return mean, shapes_from_hessian(mean, density, image, spacing)
