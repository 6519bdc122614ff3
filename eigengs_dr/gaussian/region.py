"""The part of a set that a region shows, in NumPy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .file import SetData


def crop(
    data: SetData,
    corner: tuple[float, float],
    size: tuple[int, int],
    scale: tuple[float, float] = (1.0, 1.0),
) -> SetData:
    """Return the Gaussians that touch a region, as a set of the region's own size.

    Parameters
    ----------
    data : SetData
        See `eigengs_dr.gaussian.file.read`.
    corner : (float, float)
        x and y of the upper left corner of the region, in native pixels of the set.
    size : (int, int)
        Width and height of the region in pixels of the result.
    scale : (float, float), optional
        Pixels of the result for a native pixel, along x and y.

    Returns
    -------
    SetData
        It renders as the region does in the whole set, up to rounding. The Gaussians keep their
        order. The set may be empty: then the region shows the background alone.
    """
    mean = data.arrays["mean"]
    seen = np.ones(len(mean), bool)
    for axis, reach in enumerate(reaches(data)):
        half = 0.5 * size[axis] / scale[axis]
        away = np.abs(mean[:, axis] - np.float32(corner[axis] + half))
        seen &= away <= reach * np.float32(1.001) + np.float32(half + 1)
    arrays = {name: values[seen] for name, values in data.arrays.items() if name != "background"}
    arrays["background"] = data.arrays["background"]
    x, y = scale
    arrays["mean"] = ((arrays["mean"].astype(np.float64) - corner) * scale).astype(np.float32)
    arrays["factor"] = (arrays["factor"] / np.array([x, y, y])).astype(np.float32)
    return data._replace(arrays=arrays, size=size)


def reaches(data: SetData) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return how far from its mean each Gaussian reaches along x and along y, in native pixels."""
    a, b, c = data.arrays["factor"].T
    # The covariance (F^T F)^-1 has the entries xx = (1 + (b / c)^2) / a^2 and yy = 1 / c^2.
    across = data.cutoff * np.hypot(np.float32(1), b / c) / a
    return across.astype(np.float32), (data.cutoff / c).astype(np.float32)
