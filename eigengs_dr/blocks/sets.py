"""The Gaussians of all blocks in common arrays, block after block."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..gaussian.file import CUTOFF, SetData, crop, reaches
from .grid import Block, neighbors

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
