"""Exact PCA from the Gram matrix: the inner products of all pairs of images.

The matrix of n images has n^2 numbers, whatever the size of the images, and its eigenvectors are
the weights of the images in the components (Sirovich and Kirby 1987, "Low-dimensional procedure for
the characterization of human faces", JOSA A 4, sec. 2). The images are read once, and kept in
files. A tile of the matrix, a channel's eigenvectors, and a strip of the components are tasks. The
images decide the tasks and the order of each sum, so that the result does not depend on who does
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....backend.executor import Executor, completed
from ....storage.checkpoint import read_arrays, write_arrays
from .eigenpairs import FLOOR, largest_eigenpairs, orthonormalize
from .incremental_pca import EigenState, draw_examples
from .plane_store import PlaneStore, strips

TILE_IMAGES = 1024
"""Most rows of a tile of the Gram matrix."""


class Tile(NamedTuple):
    """A task: the inner products of the images of two ranges of files, of one channel."""

    channel: int
    rows: range
    columns: range

    def path(self, folder: Path) -> Path:
        """Return the file of the tile."""
        return folder / f"gram-{self.channel}-{self.rows.start:05d}-{self.columns.start:05d}.npz"


class Channel(NamedTuple):
    """A task: the eigenvectors of one channel."""

    number: int
    most: int
    tiles: list[Tile]


class Found(NamedTuple):
    """Eigenvalues (k,), weights of the images (k, n), the next eigenvalue, the sum of all."""

    values: NDArray[np.float64]
    weights: NDArray[np.float32]
    dropped: float
    trace: float


class Strip(NamedTuple):
    """A task: some pixels of the components of one channel."""

    channel: int
    columns: slice


def gram_state(
    store: PlaneStore, components: Sequence[int], seed: int, executor: Executor
) -> EigenState:
    """Find the exact principal components of stored images by an executor.

    A task of the Gram matrix holds two strips of `TILE_IMAGES` images, and a tile. The task of the
    eigenvectors holds the matrix, ``8 n^2`` bytes; three times as much if more than a quarter of
    the eigenvectors are asked for.

    Parameters
    ----------
    store : PlaneStore
        The n images; their folder also keeps the tiles, for a call that is repeated.
    components : sequence of 3 ints
        Most components of each channel.
    seed : int
        Seed of the random examples.
    executor : Executor

    Returns
    -------
    EigenState
        Of 3 channels. Its eigenvalues are exact but for rounding; `lost` is the first that was left
        out.

    Raises
    ------
    ClusterError
        If the cluster is lost, or a task ends its worker again and again.
    """
    tiles = _tiles(len(store.counts), max(1, TILE_IMAGES // max(store.counts)))
    for _ in completed(executor, compute_tile, tiles, store):
        pass
    channels = [
        Channel(c, most, [tile for tile in tiles if tile.channel == c])
        for c, most in enumerate(components)
    ]
    ended = dict(completed(executor, find_eigenpairs, channels, store))
    found: list[Found] = [ended[c] for c in range(len(channels))]
    rows = _components(store, found, executor)
    parts = [orthonormalize(r, entry.values) for r, entry in zip(rows, found, strict=True)]
    count = sum(store.counts)
    examples = draw_examples([], range(count), 0, seed)
    return EigenState(
        count=count,
        seed=seed,
        mean=store.mean,
        rows=tuple(part[0] for part in parts),
        scatter=tuple(part[1] for part in parts),
        squares=np.array([entry.trace for entry in found]),
        examples=np.stack([store.image(place) for place in examples]),
        lost=np.array([entry.dropped for entry in found]),
    )


def compute_tile(tile: Tile, store: PlaneStore) -> None:
    """Compute a tile of the Gram matrix, and write its file; this function runs on a worker."""
    if (path := tile.path(store.folder)).exists():
        return
    gram = np.zeros([sum(store.counts[k] for k in files) for files in (tile.rows, tile.columns)])
    for columns in strips(store.mean.shape[1]):
        left = _strip(store, tile.rows, tile.channel, columns)
        same = tile.rows == tile.columns
        right = left if same else _strip(store, tile.columns, tile.channel, columns)
        gram += left @ right.T
    write_arrays(path, {"gram": gram})


def find_eigenpairs(channel: Channel, store: PlaneStore) -> Found:
    """Find the eigenvectors of the Gram matrix of a channel; this function runs on a worker."""
    ends = np.cumsum([0, *store.counts])
    gram = np.zeros((ends[-1], ends[-1]))
    for tile in channel.tiles:
        rows, columns = (slice(ends[f.start], ends[f.stop]) for f in (tile.rows, tile.columns))
        gram[rows, columns] = read_arrays(tile.path(store.folder))["gram"]
    trace = float(np.trace(gram))
    floor = FLOOR * store.mean.shape[1] * len(gram)
    values, weights, dropped = largest_eigenpairs(gram, channel.most, floor)
    return Found(values, weights.T.astype(np.float32), dropped, trace)


def combine_strip(strip: Strip, job: tuple[PlaneStore, list[NDArray[np.float32]]]) -> Any:
    """Return a strip of all components of a channel, float32 (k, w); runs on a worker."""
    store, weights = job
    total = np.zeros((len(weights[strip.channel]), strip.columns.stop - strip.columns.start))
    first = 0
    for number, count in enumerate(store.counts):
        share = weights[strip.channel][:, first : first + count]
        total += share @ store.strip(number, strip.channel, strip.columns)
        first += count
    return total.astype(np.float32)


def _tiles(files: int, together: int) -> list[Tile]:
    """Return the tiles of the lower left of the matrix, of all channels."""
    groups = [range(k, min(k + together, files)) for k in range(0, files, together)]
    return [
        Tile(channel, rows, columns)
        for i, rows in enumerate(groups)
        for columns in groups[: i + 1]
        for channel in range(3)
    ]


def _strip(store: PlaneStore, files: range, channel: int, columns: slice) -> NDArray[np.float32]:
    return np.vstack([store.strip(number, channel, columns) for number in files])


def _components(
    store: PlaneStore, found: list[Found], executor: Executor
) -> list[NDArray[np.float32]]:
    """Combine the images into components, not yet orthonormal to the last digit."""
    pixels = store.mean.shape[1]
    rows = [np.empty((len(entry.values), pixels), np.float32) for entry in found]
    tasks = [Strip(c, columns) for c in range(len(rows)) for columns in strips(pixels)]
    job = (store, [entry.weights for entry in found])
    for index, part in completed(executor, combine_strip, tasks, job):
        rows[tasks[index].channel][:, tasks[index].columns] = part
    return rows
