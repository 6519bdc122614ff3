"""Strips of rows of a large image: bounded temporary arrays, and several threads.

The borders of the strips depend only on the size of the image, so a result does not depend on the
number of threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from ..backend.types import Values

STRIP_PIXELS = 1 << 19
"""Number of pixels of a strip. One plane of it takes 2 MB in single precision: larger strips do not
fit into the cache; with smaller ones, threads wait for each other and borders of filters are
computed twice."""

MAX_THREADS = 8
"""Largest number of threads: in Python, only one of them starts an operation at a time."""

Pixels = Values
"""Pixels (H, W, C) of any dtype."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def strips(height: int, width: int) -> list[slice]:
    """Divide an image into strips of about `STRIP_PIXELS` pixels.

    Parameters
    ----------
    height, width : int
        Size of the image in pixels.

    Returns
    -------
    list of slice
        The rows of each strip, from top to bottom.
    """
    rows = max(1, STRIP_PIXELS // max(width, 1))
    return [slice(first, min(first + rows, height)) for first in range(0, height, rows)]


def map_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Call a function for every item on several threads, and return the results in order.

    Parameters
    ----------
    function : callable
        NumPy releases the interpreter lock, so operations on large arrays run in parallel.
    items : iterable
        A single item is processed in the calling thread.

    Returns
    -------
    list
        ``[function(item) for item in items]``; the first error is raised.
    """
    items = list(items)
    threads = min(MAX_THREADS, available_cores(), len(items))
    if threads < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))


def by_strips(
    function: Callable[[Pixels], Pixels],
    image: Pixels,
    dtype: type[np.generic] = np.float32,
    channels: int | None = None,
) -> Pixels:
    """Apply a pixelwise function to an image without large temporary arrays.

    Parameters
    ----------
    function : callable
        ``function(rows)`` returns rows of the result, or one channel that is broadcast.
    image : ndarray, shape (H, W, C)
    dtype : dtype, optional
        Type of the result.
    channels : int, optional
        Number of channels of the result, by default that of the image.

    Returns
    -------
    ndarray of type `dtype`, shape (H, W, channels)
    """
    result = np.empty((*image.shape[:2], channels or image.shape[2]), dtype)

    def fill(rows: slice) -> None:
        result[rows] = function(image[rows])

    map_threads(fill, strips(*image.shape[:2]))
    return result


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
