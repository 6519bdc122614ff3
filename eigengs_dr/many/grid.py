"""The blocks of an image, their windows and cores, and the Gaussians of all blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.types import Arrays
from ..gaussian.file import CUTOFF, SetData
from ..image.space import DATA

HALO_SPACINGS = 5.0
"""Width of a halo, in mean distances of the Gaussians. The Gaussians near a border overlap those up
to some mean distances beyond it, and have to move with them; every additional row costs pixels in
all blocks."""

MIN_HALO = 16
"""Smallest width of a halo in pixels."""


class Block(NamedTuple):
    """A part of an image, with its surroundings.

    Attributes
    ----------
    number : int
        Index of the block: row after row, from left to right.
    rows, columns : slice
        The core. The cores of all blocks tile the image.
    window_rows, window_columns : slice
        The core with its halo. All windows of an image have the same size, so that all fits share
        one program; at an edge of the image, the halo on the opposite side is larger.
    """

    number: int
    rows: slice
    columns: slice
    window_rows: slice
    window_columns: slice

    @property
    def core(self) -> tuple[slice, slice]:
        """Rows and columns of the core, relative to the window."""
        top, left = self.window_rows.start, self.window_columns.start
        return (
            slice(self.rows.start - top, self.rows.stop - top),
            slice(self.columns.start - left, self.columns.stop - left),
        )

    @property
    def corner(self) -> NDArray[np.float64]:
        """Left and top of the window, in pixels of the image."""
        return np.array([self.window_columns.start, self.window_rows.start], np.float64)

    @property
    def window_size(self) -> NDArray[np.float64]:
        """Width and height of the window in pixels."""
        rows, columns = self.window_rows, self.window_columns
        return np.array([columns.stop - columns.start, rows.stop - rows.start], np.float64)

    @property
    def pixels(self) -> int:
        """Number of pixels of the core."""
        return (self.rows.stop - self.rows.start) * (self.columns.stop - self.columns.start)


def choose_halo(spacing: float) -> int:
    """Return the width of a halo in pixels, for a mean distance of Gaussians in pixels."""
    return max(MIN_HALO, math.ceil(HALO_SPACINGS * spacing))


def divide(width: int, height: int, side: int, halo: int) -> list[Block]:
    """Divide an image into blocks of nearly equal size.

    Parameters
    ----------
    width, height : int
        Size of the image in pixels.
    side : int
        Largest side of a core.
    halo : int
        Width in pixels of the surroundings of a core that belong to its window.

    Returns
    -------
    list of Block

    Examples
    --------
    >>> [(b.columns, b.window_columns) for b in divide(200, 100, 100, 8)]
    [(slice(0, 100, None), slice(0, 116, None)), (slice(100, 200, None), slice(84, 200, None))]
    """
    rows, columns = _parts(height, side, halo), _parts(width, side, halo)
    blocks = list[Block]()
    for core_rows, window_rows in rows:
        for core_columns, window_columns in columns:
            block = Block(len(blocks), core_rows, core_columns, window_rows, window_columns)
            blocks.append(block)
    return blocks


def _parts(length: int, side: int, halo: int) -> list[tuple[slice, slice]]:
    """Return the cores and the windows along one axis."""
    number = -(-length // side)
    cuts = [k * length // number for k in range(number + 1)]
    cores = [slice(cuts[k], cuts[k + 1]) for k in range(number)]
    window = min(length, -(-length // number) + 2 * halo)
    starts = [min(max(0, core.start - halo), length - window) for core in cores]
    return [(core, slice(start, start + window)) for core, start in zip(cores, starts, strict=True)]


def allocate(mass: NDArray[np.float64], pixels: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Allocate Gaussians to blocks in proportion to their masses.

    Parameters
    ----------
    mass : ndarray, shape (B,)
        Integral of the density of Gaussians over each block, up to a common factor.
    pixels : ndarray of int, shape (B,)
        Number of pixels of each block, which limits its Gaussians.
    count : int
        Number of Gaussians, from B to the sum of the pixels.

    Returns
    -------
    ndarray of int64, shape (B,)
        At least 1 each; the sum is `count`.

    Examples
    --------
    >>> allocate(np.array([1.0, 2.0, 0.0]), np.array([100, 100, 100]), 31)
    array([10, 20,  1])
    """
    quota = np.zeros(len(mass))
    full = np.zeros(len(mass), bool)
    share = np.maximum(mass, 1e-12 * mass.sum()) if mass.sum() > 0 else np.ones(len(mass))
    while True:  # each round fills at least one block, or ends
        remaining = count - pixels[full].sum()
        quota = np.where(full, pixels, share * (remaining / max(share[~full].sum(), 1e-300)))
        over = (quota > pixels) & ~full
        if not over.any():
            break
        full |= over
    counts = np.clip(np.floor(quota).astype(np.int64), 1, pixels)
    # The rest goes to the largest fractions; an excess, because each block gets at least 1, is
    # taken from the smallest.
    order = np.argsort(counts - quota, kind="stable")
    missing = count - int(counts.sum())
    while missing:
        step = 1 if missing > 0 else -1
        if step > 0:
            available = order[(counts < pixels)[order]]
        else:
            available = order[::-1][(counts > 1)[order[::-1]]]
        changed = available[: abs(missing)]
        counts[changed] += step
        missing -= step * len(changed)
    return counts


COLUMNS = {"mean": 2, "factor": 3, "ratio": 1}
"""Number of columns of the arrays; that of a colour is the number of channels."""


class BlockSets:
    """Arrays with a row for each Gaussian, in pixels of the image.

    Parameters
    ----------
    blocks : list of Block
    counts : ndarray of int, shape (B,)
        Number of Gaussians of each block.
    names : sequence of str
        Names of the arrays, with "mean".
    channels : int, optional
        Number of channels of a colour.
    cutoff : float, optional
        Standard deviations at which a Gaussian ends.

    Attributes
    ----------
    arrays : dict of str to ndarray of float32, shape (N, columns)
    counts
    """

    def __init__(
        self,
        blocks: list[Block],
        counts: NDArray[np.int64],
        names: tuple[str, ...],
        channels: int = 3,
        cutoff: float = CUTOFF,
    ) -> None:
        self.blocks, self.counts, self.cutoff = blocks, counts, cutoff
        self._ends = np.cumsum(counts)
        self.arrays: Arrays = {
            name: np.empty((self._ends[-1], COLUMNS.get(name, channels)), np.float32)
            for name in names
        }
        # Bounding box of the Gaussians of each block: left, top, right, bottom.
        self._boxes = np.empty((len(blocks), 4))

    def put(self, block: Block, arrays: Arrays) -> None:
        """Set the rows of a block, from arrays with means in pixels of its window."""
        part = self._part(block)
        for name, rows in self.arrays.items():
            rows[part] = arrays[name] + block.corner if name == "mean" else arrays[name]
        mean, reach = self.arrays["mean"][part], np.zeros(1)
        if "factor" in self.arrays:
            reach = np.stack(self._data(part).reaches(), axis=1)
        box = (mean - reach).min(axis=0), (mean + reach).max(axis=0)
        self._boxes[block.number] = np.concatenate(box)

    def in_window(self, block: Block) -> tuple[Arrays, slice]:
        """Return the Gaussians whose means lie in the window of a block, in pixels of the window.

        Returns
        -------
        arrays : dict of str to ndarray
        members : slice
            All Gaussians of the block itself, wherever they lie.
        """
        numbers = np.concatenate([inside for inside, _ in self._near(block)])
        first = int(np.searchsorted(numbers, self._part(block).start))
        arrays = {name: rows[numbers] for name, rows in self.arrays.items()}
        arrays["mean"] = (arrays["mean"] - block.corner).astype(np.float32)
        return arrays, slice(first, first + int(self.counts[block.number]))

    def around(self, block: Block) -> Arrays:
        """Return the other Gaussians that touch the window of a block, in pixels of the window.

        Returns
        -------
        dict of str to ndarray
            Mean, factor and color of Gaussians that are not in the result of `in_window`.
        """
        numbers = np.concatenate([outside for _, outside in self._near(block)])
        (left, top), (width, height) = block.corner.tolist(), block.window_size.tolist()
        arrays = self._data(numbers).crop((left, top), (int(width), int(height))).arrays
        return {name: arrays[name] for name in self.arrays}

    def _near(self, block: Block) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Yield for each block near a window its Gaussians inside and outside of the window."""
        low, high = block.corner, block.corner + block.window_size
        apart = (self._boxes[:, :2] > high) | (self._boxes[:, 2:] < low)
        is_same = np.arange(len(apart)) == block.number
        for number in np.flatnonzero(~apart.any(axis=1) | is_same):
            part = self._part(self.blocks[number])
            x, y = self.arrays["mean"][part].T  # NumPy reduces rows of two slowly
            inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
            inside |= is_same[number]  # rounding may move a Gaussian of the block across the edge
            yield part.start + np.flatnonzero(inside), part.start + np.flatnonzero(~inside)

    def _part(self, block: Block) -> slice:
        """Return the rows of a block."""
        end = int(self._ends[block.number])
        return slice(end - int(self.counts[block.number]), end)

    def _data(self, rows: slice | NDArray[np.int64]) -> SetData:
        """Return some Gaussians as a set."""
        arrays = {name: values[rows] for name, values in self.arrays.items()}
        arrays["background"] = np.zeros(1, np.float32)
        return SetData(arrays, (1, 1), DATA, self.cutoff)
