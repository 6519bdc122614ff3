"""Images of an array that is computed part by part, such as a dask.array."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray


class LazyImages:
    """The images of a lazy array, of which a part is in memory at a time.

    Parameters
    ----------
    array : dask.array, shape (n, H, W, 3), (n, H, W) or (n, 3 H W)
        Anything with ``shape``, ``chunks``, slices of rows, and ``compute``. Rows of numbers are
        images of RGB, pixel by pixel. The process that needs images computes them, chunk by chunk,
        so the array should be made of readers (``from_zarr``, ``from_delayed``) and be chunked by
        rows, with some hundred images in a chunk.
    size : (int, int)
        Width and height of images that come as rows of numbers.

    Raises
    ------
    ValueError
        If rows of numbers have another length.
    """

    def __init__(self, array: Any, size: tuple[int, int]) -> None:
        if len(array.shape) == 2 and array.shape[1] != 3 * size[0] * size[1]:
            raise ValueError(
                f"images: rows have {array.shape[1]} numbers; RGB of {size[0]}x{size[1]} has "
                f"{3 * size[0] * size[1]}"
            )
        self.array, self.size = array, size

    def __len__(self) -> int:
        return int(self.array.shape[0])

    def __getitem__(self, rows: slice) -> LazyImages:
        """Return the images of some rows, still lazy."""
        return LazyImages(self.array[rows], self.size)

    def arrays(self) -> Iterator[NDArray[Any]]:
        """Compute and yield one part of the array after the other, each once."""
        ends = np.cumsum([0, *self.array.chunks[0]]).tolist()
        for first, last in pairwise(ends):
            if first == last:
                continue
            rows = self.array[first:last].compute(scheduler="synchronous")
            width, height = self.size
            yield np.asarray(rows).reshape(-1, height, width, 3) if rows.ndim == 2 else rows


def is_lazy(source: Any) -> bool:
    """Whether a source is an array that is computed part by part."""
    return hasattr(source, "compute") and hasattr(source, "chunks")
