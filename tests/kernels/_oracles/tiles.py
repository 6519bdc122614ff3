"""Images in tile layout, for tests of kernels."""

import numpy as np

from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.raster import render
from eigengs_dr.raster.tiles import Grid


def to_tiles(image, backend="llvm"):
    """An image (H, W, C), a map (H, W) or a batch, and its grid."""
    image = np.asarray(image, np.float32)
    image = image[..., None] if image.ndim == 2 else image
    images = len(image) if image.ndim == 4 else 1
    grid = Grid(image.shape[-2], image.shape[-3], images=images)
    return render.to_tiles(types_in(select(backend)), image), grid


def to_map(values, grid):
    """A map (H, W) from tile layout."""
    return render.to_tensor(values, grid, 1).numpy()[..., 0]
