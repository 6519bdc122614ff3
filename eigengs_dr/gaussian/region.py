"""The part of a set inside a region."""

from __future__ import annotations

from collections.abc import Sequence
from operator import index

import numpy as np
from numpy.typing import NDArray

from .file import SetData

Region = tuple[int, int, int, int]
"""Left, top, width and height, in native pixels of a set."""


def check_region(name: str, region: Sequence[int], size: tuple[int, int]) -> Region:
    """Return a region, or raise ValueError unless it is inside an image of (width, height)."""
    values = [index(v) for v in region]
    if len(values) != 4:
        raise ValueError(f"{name} is {values}; expected left, top, width and height in pixels")
    left, top, width, height = values
    inside = 0 <= left <= size[0] - width and 0 <= top <= size[1] - height
    if not inside or min(width, height) < 1:
        raise ValueError(
            f"{name} {left},{top},{width},{height} is not inside the image of "
            f"{size[0]}x{size[1]} pixels"
        )
    return left, top, width, height


def crop(
    data: SetData,
    corner: tuple[float, float],
    size: tuple[int, int],
    scale: tuple[float, float] = (1.0, 1.0),
) -> SetData:
    """Return the Gaussians that touch a region, as a set with the size of the region.

    Parameters
    ----------
    data : SetData
        See `eigengs_dr.gaussian.file.read_set`.
    corner : (float, float)
        x and y of the upper left corner of the region, in native pixels of the set.
    size : (int, int)
        Width and height of the region in pixels of the result.
    scale : (float, float), optional
        Pixels of the result per native pixel, along x and y.

    Returns
    -------
    SetData
        Its rendering equals the region in the rendering of the full set, up to rounding. The
        Gaussians keep their order. The set is empty if the region shows only the background.
    """
    mean = data.arrays["mean"]
    touches = np.ones(len(mean), bool)
    for axis, reach in enumerate(reaches(data)):
        half = 0.5 * size[axis] / scale[axis]
        distance = np.abs(mean[:, axis] - np.float32(corner[axis] + half))
        touches &= distance <= reach * np.float32(1.001) + np.float32(half + 1)
    arrays = {name: values[touches] for name, values in data.arrays.items() if name != "background"}
    arrays["background"] = data.arrays["background"]
    x, y = scale
    arrays["mean"] = ((arrays["mean"].astype(np.float64) - corner) * scale).astype(np.float32)
    arrays["factor"] = (arrays["factor"] / np.array([x, y, y])).astype(np.float32)
    return data._replace(arrays=arrays, size=size)


def reaches(data: SetData) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the extent of each Gaussian from its mean along x and along y, in native pixels."""
    a, b, c = data.arrays["factor"].T
    # The covariance (F^T F)^-1 has the entries xx = (1 + (b / c)^2) / a^2 and yy = 1 / c^2.
    across = data.cutoff * np.hypot(np.float32(1), b / c) / a
    return across.astype(np.float32), (data.cutoff / c).astype(np.float32)
