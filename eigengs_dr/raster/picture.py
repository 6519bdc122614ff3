"""The picture of a set, read by strips of rows: a large one is in memory once."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.recording import exclusive
from ..gaussian.gaussians import Gaussians
from ..image.color import from_sum, to_picture
from .binning.tiles import TILE
from .limits import check_index_range
from .render import bin_gaussians, decode_parameters, rasterize


@exclusive()
def picture_rows(gaussians: Gaussians) -> Callable[[slice], NDArray[np.floating]]:
    """Render a set at its native size; return a function that reads rows of the picture.

    The rendering stays in tile layout, so that no second image is in memory.

    Parameters
    ----------
    gaussians : Gaussians

    Returns
    -------
    callable
        ``read(rows)`` for a slice of rows returns an array (rows, width, C): these rows of
        `eigengs_dr.raster.render.picture_of`. Threads may read at the same time.

    Raises
    ------
    ValueError
        As `eigengs_dr.raster.render.render`.
    """
    gaussians = dr.detach(gaussians)
    check_index_range(gaussians.width, gaussians.height, gaussians.channels, TILE)
    lists = bin_gaussians(gaussians, adjoint=False)
    image = rasterize(decode_parameters(gaussians), lists, gaussians.cutoff)
    grid, channels = lists.grid, gaussians.channels
    side = grid.tile[1]
    # Pixels and channels share an axis: a row of a tile is then copied as one run.
    tiles = image.numpy().reshape(grid.ny, grid.nx, side, grid.tile[0] * channels)

    def read(rows: slice) -> NDArray[np.floating]:
        first, last = rows.start // side, -(-rows.stop // side)
        whole = tiles[first:last].transpose(0, 2, 1, 3)
        whole = whole.reshape((last - first) * side, -1, channels)
        part = whole[rows.start - first * side : rows.stop - first * side, : grid.width]
        return to_picture(gaussians.space, from_sum(gaussians.space, part))

    return read
