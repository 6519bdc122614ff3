"""The adaptive placement by NumPy and SciPy alone, beside which its kernels are tested."""

import numpy as np
from scipy.ndimage import correlate1d
from scipy.spatial import cKDTree

from eigengs_dr.backend.arrays import types_in
from eigengs_dr.backend.selection import select
from eigengs_dr.codec.range_coder import hilbert_encode
from eigengs_dr.fitting.placement.adaptive import MAX_STRETCH, RELATIVE_SIZE
from eigengs_dr.fitting.placement.filters import TRUNCATION, Canvas
from eigengs_dr.gaussian.covariance import factor_from_covariance
from eigengs_dr.raster.binning.tiles import Grid
from eigengs_dr.raster.render import batch_to_tiles, to_tensor


def to_canvas(image, backend="llvm"):
    """The canvas of an image (H, W, C), of a map (H, W) or of a batch, and it in tile layout."""
    types, image = types_in(select(backend)), np.asarray(image, np.float32)
    image = image[..., None] if image.ndim == 2 else image
    images = len(image) if image.ndim == 4 else 1
    grid = Grid(image.shape[-2], image.shape[-3], images=images)
    return Canvas.of(types, grid), batch_to_tiles(types, image)


def to_pixels(canvas, values):
    """An image (H, W, C), or a map (H, W), from tile layout."""
    image = to_tensor(values, canvas.grid, canvas.channels(values)).numpy()
    return image[..., 0] if image.shape[-1] == 1 else image


def centers(x, y):
    """Centres (N, 2) from both of their rows."""
    return np.stack([x.numpy(), y.numpy()], axis=1)


def plain_blur(image, deviation):
    """Gaussian means over the pixels inside the image."""
    radius = max(1, int(np.ceil(TRUNCATION * deviation)))
    taps = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / deviation))

    def sums(values):
        return correlate1d(correlate1d(values, taps, 0, mode="constant"), taps, 1, mode="constant")

    image = np.asarray(image, np.float64)
    return sums(image) / sums(np.ones_like(image))


def plain_squared_hessian(image, noise):
    """The entries xx, yy and xy of ``sum_c H_c H_c``, shape (H, W, 3)."""
    wide = np.pad(np.asarray(image, np.float64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    middle = wide[1:-1, 1:-1]
    xx = wide[1:-1, 2:] - 2 * middle + wide[1:-1, :-2]
    yy = wide[2:, 1:-1] - 2 * middle + wide[:-2, 1:-1]
    xy = (wide[2:, 2:] - wide[2:, :-2] - wide[:-2, 2:] + wide[:-2, :-2]) / 4
    hessian = np.moveaxis(np.array([[xx, xy], [xy, yy]]), (0, 1), (3, 4))
    squared = (hessian @ hessian).sum(axis=2)
    return np.stack([squared[..., 0, 0] + noise, squared[..., 1, 1] + noise, squared[..., 0, 1]], 2)


def curve_order(height, width):
    """Row and column of the pixels of an image along a Hilbert curve."""
    y, x = np.indices((height, width)).reshape(2, -1)
    order = np.argsort(
        hilbert_encode(np.stack([x, y], 1), max(2, (max(height, width) - 1).bit_length()))
    )
    return y[order], x[order]


def plain_pieces(density, count, shift=0):
    """Centroids (count, 2) of pieces of equal mass of the curve, with its cuts moved back."""
    row, column = curve_order(*density.shape)
    mass = np.asarray(density, np.float64)[row, column]
    before = np.concatenate([[0], np.cumsum(mass)])
    cuts = np.linspace(0, before[-1], count + 1)
    cuts[1:-1] -= shift * before[-1] / count
    moments = [
        np.interp(cuts, before, np.concatenate([[0], np.cumsum(mass * (place + 0.5))]))
        for place in (column, row)
    ]
    return np.diff(moments, axis=1).T / np.diff(cuts)[:, None]


def plain_lloyd(mean, density):
    """Centroids of the pixels nearest to each centre; pixels with two of them must have no mass."""
    height, width = density.shape
    y, x = np.indices(density.shape).reshape(2, -1)
    pixel = np.floor(mean).clip(0, [width - 1, height - 1]) + 0.5
    _, owner = cKDTree(pixel).query(np.stack([x, y], 1) + 0.5)
    mass, left, top = (
        np.bincount(owner, density.ravel() * v, len(mean)) for v in (1, x + 0.5, y + 0.5)
    )
    moved = np.array(mean, np.float64)
    moved[mass > 0] = np.stack([left, top], 1)[mass > 0] / mass[mass > 0, None]
    return moved


def plain_shapes(energy, density):
    """Factors (N, 3) for entries (N, 3) of squared Hessians and densities (N,)."""
    xx, yy, xy = np.asarray(energy, np.float64).T
    values, axes = np.linalg.eigh(np.moveaxis(np.array([[xx, xy], [xy, yy]]), 2, 0))
    ratio = 1 + (MAX_STRETCH - 1) * (values[:, 1] - values[:, 0]) / values.sum(axis=1)
    variance = RELATIVE_SIZE**2 / density
    # Eigenvalues ascend: the first axis lies along the smallest second derivative.
    own = np.stack([variance * ratio, variance / ratio], 1)
    sigma = axes * own[:, None] @ axes.transpose(0, 2, 1)
    return factor_from_covariance(sigma[:, 0, 0], sigma[:, 0, 1], sigma[:, 1, 1])
