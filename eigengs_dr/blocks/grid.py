"""The blocks of an image, their windows and cores, and the Gaussians of all blocks."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..gaussian.file import CUTOFF, SetData, crop, reaches

HALO_SPACINGS = 5.0
"""Width of a halo, in mean distances of the Gaussians. The Gaussians near a border overlap those of
some mean distances beyond it, and have to move with them; each row more costs pixels in all blocks.
"""

MIN_HALO = 16
"""Least width of a halo in pixels."""


class Block(NamedTuple):
    """A part of an image with its surroundings.

    Attributes
    ----------
    number : int
        Place in the order of the blocks: row after row, from the left to the right.
    rows, columns : slice
        The core. The cores of all blocks tile the image.
    window_rows, window_columns : slice
        The core with its halo. All windows of an image have one size, so that all fits have one
        program; at the edges of the image the halo of the other sides is larger.
    """

    number: int
    rows: slice
    columns: slice
    window_rows: slice
    window_columns: slice

    @property
    def core(self) -> tuple[slice, slice]:
        """Rows and columns of the core, counted from the corner of the window."""
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
        Pixels around a core that belong to its window too, where the image has them.

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


def neighbors(block: Block, blocks: list[Block]) -> list[Block]:
    """Return the blocks whose cores touch the window of a block, with itself, in order."""
    return [
        other
        for other in blocks
        if _overlap(other.rows, block.window_rows) and _overlap(other.columns, block.window_columns)
    ]


def _overlap(a: slice, b: slice) -> bool:
    return bool(a.start < b.stop and b.start < a.stop)


def deal(mass: NDArray[np.float64], pixels: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Deal Gaussians to blocks in proportion to their masses.

    Parameters
    ----------
    mass : ndarray, shape (B,)
        Integral of the density of Gaussians over each block, up to a common factor.
    pixels : ndarray of int, shape (B,)
        Pixels of each block; no block gets more Gaussians.
    count : int
        Number of Gaussians, from B to the sum of the pixels.

    Returns
    -------
    ndarray of int64, shape (B,)
        At least 1 each; the sum is `count`.

    Examples
    --------
    >>> deal(np.array([1.0, 2.0, 0.0]), np.array([100, 100, 100]), 31)
    array([10, 20,  1])
    """
    wanted = np.zeros(len(mass))
    full = np.zeros(len(mass), bool)
    share = np.maximum(mass, 1e-12 * mass.sum()) if mass.sum() > 0 else np.ones(len(mass))
    while True:  # each round fills at least one block, or ends
        left = count - pixels[full].sum()
        wanted = np.where(full, pixels, share * (left / max(share[~full].sum(), 1e-300)))
        over = (wanted > pixels) & ~full
        if not over.any():
            break
        full |= over
    dealt = np.clip(np.floor(wanted).astype(np.int64), 1, pixels)
    # The rest goes to the largest fractions; too much, by the blocks that got 1, is taken back.
    order = np.argsort(dealt - wanted, kind="stable")
    missing = count - int(dealt.sum())
    while missing:
        step = 1 if missing > 0 else -1
        able = order[(dealt < pixels)[order]] if step > 0 else order[::-1][(dealt > 1)[order[::-1]]]
        chosen = able[: abs(missing)]
        dealt[chosen] += step
        missing -= step * len(chosen)
    return dealt


Arrays = dict[str, NDArray[Any]]

COLUMNS = {"mean": 2, "factor": 3, "ratio": 1}
"""Numbers of a Gaussian in the arrays; a colour has as many as the image has channels."""


class BlockSets:
    """Arrays with a row for each Gaussian, in pixels of the image.

    Parameters
    ----------
    blocks : list of Block
    counts : ndarray of int, shape (B,)
        Number of Gaussians of each block.
    names : sequence of str
        The arrays: mean and others.
    channels : int, optional
        Channels of a colour.
    cutoff : float, optional
        Standard deviations at which a Gaussian ends.

    Attributes
    ----------
    arrays : dict of str to ndarray of float32, shape (N, columns)
    parts : list of slice
        The rows of each block.
    """

    def __init__(
        self,
        blocks: list[Block],
        counts: NDArray[Any],
        names: tuple[str, ...],
        channels: int = 3,
        cutoff: float = CUTOFF,
    ) -> None:
        ends = np.cumsum(counts).tolist()
        self.blocks, self.cutoff = blocks, cutoff
        self.size = np.array([blocks[-1].columns.stop, blocks[-1].rows.stop])
        self.parts = [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        self.arrays: Arrays = {
            name: np.empty((ends[-1], COLUMNS.get(name, channels)), np.float32) for name in names
        }
        self._boxes = np.empty((len(blocks), 4))

    def counts(self) -> NDArray[np.int64]:
        """Return the number of Gaussians of each block."""
        return np.array([part.stop - part.start for part in self.parts])

    def put(self, block: Block, found: Arrays) -> None:
        """Set the rows of a block; its means are in pixels of its window."""
        part = self.parts[block.number]
        for name, rows in self.arrays.items():
            rows[part] = found[name] + block.corner if name == "mean" else found[name]
        if "factor" in self.arrays:
            self._measure(block)

    def in_window(self, block: Block) -> tuple[Arrays, slice]:
        """Return the Gaussians whose means lie in the window of a block, in the window's pixels.

        Returns
        -------
        arrays : dict of str to ndarray
        own : slice
            Those of the block itself: all of them, wherever they lie.
        """
        found: dict[str, list[NDArray[Any]]] = {name: [] for name in self.arrays}
        before, own = 0, slice(0, 0)
        for other in neighbors(block, self.blocks):
            part = self.parts[other.number]
            inside = _in_window(self.arrays["mean"][part], block)
            if other.number == block.number:
                inside[:] = True  # rounding may move one across the edge
                own = slice(before, before + len(inside))
            before += int(inside.sum())
            for name, rows in found.items():
                rows.append(self.arrays[name][part][inside])
        arrays = {name: np.concatenate(rows) for name, rows in found.items()}
        arrays["mean"] = (arrays["mean"] - block.corner).astype(np.float32)
        return arrays, own

    def around(self, block: Block) -> Arrays:
        """Return the other Gaussians that touch the window of a block, in the window's pixels.

        Returns
        -------
        dict of str to ndarray
            Mean, factor and color of those that `in_window` leaves out.
        """
        near = {other.number for other in neighbors(block, self.blocks)}
        found = [{name: rows[:0] for name, rows in self.arrays.items()}]
        for other in self.blocks:
            if other.number == block.number or not self._reaches(other, block):
                continue
            data = self._data(other)
            if other.number in near:
                outside = ~_in_window(data.arrays["mean"], block)
                rows = {name: data.arrays[name][outside] for name in self.arrays}
                data = data._replace(arrays=data.arrays | rows)
            found.append(crop(data, *_window(block)).arrays)
        return {name: np.concatenate([part[name] for part in found]) for name in self.arrays}

    def _measure(self, block: Block) -> None:
        """Note the box that the Gaussians of a block touch: left, top, right, bottom."""
        mean = self.arrays["mean"][self.parts[block.number]]
        reach = np.stack(reaches(self._data(block)), axis=1)
        box = (mean - reach).min(axis=0), (mean + reach).max(axis=0)
        self._boxes[block.number] = np.concatenate(box)

    def _reaches(self, block: Block, part: Block) -> bool:
        """Whether some Gaussians of a block may touch the window of a part."""
        (left, top), (width, height) = _window(part)
        box = self._boxes[block.number]
        return bool(
            (box[:2] <= (left + width, top + height)).all() and (box[2:] >= (left, top)).all()
        )

    def _data(self, block: Block) -> SetData:
        """Return the Gaussians of a block as a set."""
        part = self.parts[block.number]
        arrays = {name: rows[part] for name, rows in self.arrays.items()}
        arrays["background"] = np.zeros(1, np.float32)
        return SetData(arrays, (1, 1), "data", self.cutoff)


def _in_window(mean: NDArray[Any], block: Block) -> NDArray[np.bool_]:
    """Return which of some means (n, 2), in pixels of the image, lie in the window of a block."""
    low, high = block.corner, block.corner + block.window_size
    inside: NDArray[np.bool_] = np.all((mean >= low) & (mean <= high), axis=1)
    return inside


def _window(part: Block) -> tuple[tuple[float, float], tuple[int, int]]:
    """Return the corner and the size of the window of a part."""
    (left, top), (width, height) = part.corner.tolist(), part.window_size.astype(int).tolist()
    return (left, top), (width, height)
