"""Images as planes of single precision in files, of which a part is read at a time.

A file holds some hundred images. It lists channel by channel and, within a channel, strip by strip
of `COLUMNS` pixels, so that a strip of all its images is one run of bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....storage.atomic import atomic_write
from ....storage.checkpoint import read_arrays, write_arrays
from .eigenpairs import COLUMNS

FILE_IMAGES, FILE_BYTES = 256, 192 << 20
"""Most images of a file, and most bytes."""


@dataclass(frozen=True, eq=False)
class PlaneStore:
    """The images of a folder of files that `write_planes` wrote.

    Attributes
    ----------
    folder : Path
    counts : tuple of int
        Images of each file.
    mean : ndarray of float64, shape (C, d)
        Mean of all images; d is the number of pixels.
    """

    folder: Path
    counts: tuple[int, ...]
    mean: NDArray[np.float64]

    @classmethod
    def open(cls, folder: Path, files: int) -> PlaneStore:
        """Open the files 0, 1, ... of a folder."""
        heads = [read_arrays(_head(folder, number)) for number in range(files)]
        counts = tuple(int(head["count"]) for head in heads)
        total = np.sum([head["total"] for head in heads], axis=0)
        return cls(folder, counts, total / max(1, sum(counts)))

    def strip(self, number: int, channel: int, columns: slice) -> NDArray[np.float32]:
        """Read some pixels of all images of a file.

        Parameters
        ----------
        number : int
            The file.
        channel : int
        columns : slice
            One of `strips`.

        Returns
        -------
        ndarray of float32, shape (n, columns)
            The difference to the mean.
        """
        count, pixels = self.counts[number], self.mean.shape[1]
        width = columns.stop - columns.start
        first = count * (channel * pixels + columns.start)
        path = _planes(self.folder, number)
        rows = np.fromfile(path, np.float32, count * width, offset=4 * first)
        rows = rows.reshape(count, width)
        rows -= self.mean[channel, columns].astype(np.float32)
        return rows

    def image(self, place: int) -> NDArray[np.float32]:
        """Read one image, by its place among all, with the mean; shape (C, d)."""
        number = 0
        while place >= self.counts[number]:
            place -= self.counts[number]
            number += 1
        planes = np.empty(self.mean.shape, np.float32)
        count, (channels, pixels) = self.counts[number], self.mean.shape
        for c in range(channels):
            for columns in strips(pixels):
                width = columns.stop - columns.start
                first = count * (c * pixels + columns.start) + place * width
                path = _planes(self.folder, number)
                planes[c, columns] = np.fromfile(path, np.float32, width, offset=4 * first)
        return planes


def file_length(size: tuple[int, int]) -> int:
    """Return the number of images of a size (width, height) in a file."""
    return max(1, min(FILE_IMAGES, FILE_BYTES // (12 * size[0] * size[1])))


def strips(pixels: int) -> Iterator[slice]:
    """Yield ranges of `COLUMNS` pixels; the last may be shorter."""
    for first in range(0, pixels, COLUMNS):
        yield slice(first, min(first + COLUMNS, pixels))


def has_planes(folder: Path, number: int) -> bool:
    """Whether a file is written, whole."""
    return _head(folder, number).exists()


def write_planes(folder: Path, number: int, block: NDArray[np.float32]) -> None:
    """Write a block of images, whole or not at all.

    Parameters
    ----------
    folder : Path
    number : int
        The file.
    block : ndarray of float32, shape (n, C, d)
        May be empty.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with atomic_write(_planes(folder, number)) as temporary, temporary.open("wb") as file:
        for channel in range(block.shape[1]):
            for columns in strips(block.shape[2]):
                file.write(np.ascontiguousarray(block[:, channel, columns]).data)
    head = {"count": np.array(len(block)), "total": block.sum(axis=0, dtype=np.float64)}
    write_arrays(_head(folder, number), head)  # last: it says that the file is whole


def _planes(folder: Path, number: int) -> Path:
    return folder / f"planes-{number:05d}.f32"


def _head(folder: Path, number: int) -> Path:
    return folder / f"planes-{number:05d}.npz"
