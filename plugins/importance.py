"""A distribution of directions: leaves over the sphere, small where its light needs them.

A survey has the light on a grid over ``(u, v) = (phi / 2 pi, theta / pi)``, times sin(theta). The
grid is cut into blocks of `SIDE` x `SIDE` cells, and each block is divided evenly into leaves: into
1, 4, 16, ..., as few as keep its share of the noise. Blocks that need all of their cells are
evaluated again, on finer ones. The density is constant in a leaf.

The mean square of one sample is ``integral f^2 / p``. It is smallest for the density
``p = sqrt(mean of f^2)`` of each leaf, and then is ``(sum of areas times sqrt(mean of f^2))^2``.
Smaller leaves lower the sum, and take memory: each has to lower it by the share `PRICE` at least.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from eigengs_dr.backend.arrays import upload
from eigengs_dr.backend.types import Float, Mask, UInt

from .emission import DARKEST

LEVELS, DEEPEST = 4, 6
"""Halvings of a block in the survey, and in the blocks that are evaluated again."""

SIDE = 1 << LEVELS
"""Cells of the survey along the sides of a block."""

PRICE = 3e-7
"""Smallest part of the sum that a leaf must save."""

AGAIN = 256
"""Largest number of blocks that are evaluated again: a million points."""

NEVER = 2.0
"""Start of the leaves that pad the array: larger than any sample."""


@dataclass(frozen=True)
class Importance:
    """A density that is constant in leaves of the unit square of uv.

    Numbers are in arrays: the number of leaves changes with the light, and programs stay the same.

    Attributes
    ----------
    starts : Float, shape (2^k,)
        Probability of all leaves before a leaf; after the last leaf 1, then `NEVER`.
    places : UInt32, shape (leaves,)
        Column of the block of a leaf, plus 2^16 times its row.
    blocks : UInt32, shape (rows * columns,)
        8 times the first leaf of a block, whose leaves are stored row by row, plus its halvings.
    columns, rows : Float, shape (1,)
        Numbers of blocks.
    """

    starts: Float
    places: UInt
    blocks: UInt
    columns: Float
    rows: Float

    def sample(self, sample: mi.Point2f, active: Mask) -> tuple[mi.Point2f, Float]:
        """Return positions in the unit square and their densities, for samples of it.

        Cost: one gather for each of the k halvings of the leaves, and four more.
        """
        x, leaf = sample.x, mi.UInt32(0)
        step = dr.width(self.starts) // 2
        while step:  # the last leaf that starts at or before x
            start = dr.gather(mi.Float, self.starts, leaf + step, active)
            leaf = dr.select(start <= x, leaf + step, leaf)
            step //= 2
        start, share = self._share(leaf, active)
        place = dr.gather(mi.UInt32, self.places, leaf, active)
        column, row = mi.Float(place & 0xFFFF), mi.Float(place >> 16)
        first, level = self._block(column, row, active)
        within, across = leaf - first, mi.Float(mi.UInt32(1) << level)
        along = (x - start) / dr.select(share > 0, share, 1)
        u = (
            column
            + (mi.Float(within & ((mi.UInt32(1) << level) - 1)) + dr.clip(along, 0, 1)) / across
        )
        v = row + (mi.Float(within >> level) + sample.y) / across
        return mi.Point2f(u / self.columns, v / self.rows), self._density(share, across)

    def density(self, uv: mi.Point2f, active: Mask) -> Float:
        """Return the density at positions in the unit square."""
        u, v = uv.x * self.columns, uv.y * self.rows
        column = dr.clip(dr.floor(u), 0, self.columns - 1)
        row = dr.clip(dr.floor(v), 0, self.rows - 1)
        first, level = self._block(column, row, active)
        across = mi.Float(mi.UInt32(1) << level)
        i, j = (
            mi.UInt32(dr.clip(dr.floor(k * across), 0, across - 1)) for k in (u - column, v - row)
        )
        _, share = self._share(first + (j << level) + i, active)
        return self._density(share, across)

    def _share(self, leaf: UInt, active: Mask) -> tuple[Float, Float]:
        """Return the probability before a leaf, and that of the leaf."""
        start = dr.gather(mi.Float, self.starts, leaf, active)
        return start, dr.gather(mi.Float, self.starts, leaf + 1, active) - start

    def _block(self, column: Float, row: Float, active: Mask) -> tuple[UInt, UInt]:
        """Return the first leaf of a block, and its halvings."""
        index = mi.UInt32(dr.fma(row, self.columns, column))
        block = dr.gather(mi.UInt32, self.blocks, index, active)
        return block >> 3, block & 7

    def _density(self, share: Float, across: Float) -> Float:
        return share * across * across * self.columns * self.rows


def importance_of(
    light: NDArray[np.floating], light_at: Callable[[NDArray, NDArray], NDArray]
) -> Importance:
    """Return the distribution for light over the sphere.

    Parameters
    ----------
    light : ndarray, shape (rows, columns)
        Brightness at the centres of cells of uv; `SIDE` divides both sides.
    light_at : callable
        ``light_at(u, v)`` returns the brightness at points, arrays of one shape.
    """
    rows, columns = (side // SIDE for side in light.shape)
    theta = (np.arange(len(light)) + 0.5) * (np.pi / len(light))
    light = np.maximum(light, 0) * np.sin(theta)[:, None]
    floor = DARKEST * light.mean(dtype=np.float64) or 1.0
    squares = _spread(np.square(np.maximum(light, floor), dtype=np.float64), "wrap")
    roots = _roots(squares.reshape(rows, SIDE, columns, SIDE).swapaxes(1, 2))
    price = PRICE * roots[-1].mean() * rows * columns
    levels, losses = _levels(roots, price)
    leaves = [roots[k][b] for b, k in enumerate(levels)]

    again = np.flatnonzero(levels == LEVELS)
    again = again[np.argsort(-losses[again], kind="stable")][:AGAIN]
    if len(again):
        inside = (np.arange(1 << DEEPEST) + 0.5) / (1 << DEEPEST)
        v = ((again // columns)[:, None, None] + inside[:, None]) / rows
        u = ((again % columns)[:, None, None] + inside) / columns
        u, v = np.broadcast_arrays(u, v)
        finer = np.maximum(light_at(u, v) * np.sin(np.pi * v), floor)
        squares = np.stack([_spread(block, "edge") for block in np.square(finer, dtype=np.float64)])
        roots = _roots(squares[None])
        levels[again], _ = _levels(roots, price)
        for n, b in enumerate(again):
            leaves[b] = roots[levels[b]][n]
    return _packed(leaves, levels, rows, columns)


def _roots(squares: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return ``sqrt(mean f^2)`` of leaves by level, from one leaf per block; a row per block.

    Parameters
    ----------
    squares : ndarray of float64, shape (rows, columns, side, side)
        In each block.
    """
    squares = squares.reshape(-1, *squares.shape[2:])
    roots = [np.sqrt(squares).reshape(len(squares), -1)]
    while (side := squares.shape[1] // 2) > 0:
        squares = squares.reshape(-1, side, 2, side, 2).mean(axis=(2, 4))
        roots.insert(0, np.sqrt(squares).reshape(len(squares), -1))
    return roots


def _levels(roots: list, price: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the level of each block at a price per leaf, and what one level less would lose."""
    losses = np.stack([r.mean(axis=1) for r in roots])
    losses -= losses[-1]
    prices = price * 4.0 ** np.arange(len(roots))
    return np.argmin(losses + prices[:, None], axis=0), losses[-2]


def _packed(leaves: list, levels: NDArray[np.int64], rows: int, columns: int) -> Importance:
    """Upload the leaves of blocks, each with its density."""
    counts = 4**levels
    first, block = np.cumsum(counts) - counts, np.arange(len(levels))
    share = np.concatenate([leaf / len(leaf) for leaf in leaves])
    starts = np.full(1 << len(share).bit_length(), NEVER)
    starts[: len(share)] = (np.cumsum(share) - share) / share.sum()
    starts[len(share)] = 1
    places = np.repeat(block % columns + ((block // columns) << 16), counts)
    return Importance(
        upload(mi.Float, starts.astype(np.float32)),
        upload(mi.UInt32, places.astype(np.uint32)),
        upload(mi.UInt32, (8 * first + levels).astype(np.uint32)),
        dr.opaque(mi.Float, columns),
        dr.opaque(mi.Float, rows),
    )


def _spread(squares: NDArray[np.float64], sides: Literal["wrap", "edge"]) -> NDArray[np.float64]:
    """Return means with neighbours, 1 : 2 : 1 along both axes: light may lie beside the centre."""
    around = np.pad(squares, ((0, 0), (1, 1)), mode=sides)
    around = np.pad(around, ((1, 1), (0, 0)), mode="edge")
    for _ in range(2):
        around = (0.25 * (around[:-2] + around[2:]) + 0.5 * around[1:-1]).T
    return around
