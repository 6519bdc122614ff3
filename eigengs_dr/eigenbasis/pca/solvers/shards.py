"""PCA of large families in shards: each worker the PCA of its shard, merged in a fixed tree.

The images decide the shards and the tree, not the workers, so that the result has the same bits for
any number of workers. The channels of a shard are states of their own: a merge holds two of them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....backend.executor import Executor, completed
from ....backend.feedback import warn
from ....image.folder import ReadProgress, read_blocks
from ....image.io import ImageError
from ....storage.checkpoint import read_arrays, write_arrays
from .incremental_pca import EigenState, block_length, empty_state, merge, merge_states
from .parts import Images, absolute, collect_notes, is_countable, readable
from .shard_tree import Node, holds, tree_levels

SHARD = 2048
"""Images of a shard. Merging two states of 375 rows takes 0.2 of the time of a shard of so many
images of 256x256."""

BLOCKS_OF_SHARD = 4
"""If there are several shards, a block has this fraction of the images of `block_length`: 256 of
256x256. A worker then needs less than 1 GB."""

Stored = EigenState | Path
"""A state of one channel, or its file."""

Progress = Callable[[int, int], None]
"""``progress(done, total)``, in images."""


@dataclass(frozen=True)
class ShardOptions:
    """What all tasks of a PCA in shards share.

    Attributes
    ----------
    size, space
        See `eigengs_dr.image.folder.read_blocks`.
    ranks : tuple of 3 ints
        Most rows of a state, for each channel.
    seed : int
        Seed of the random examples.
    length : int
        Images of a block.
    folder : Path or None
        Folder of the states, which all workers see; None lets the states travel.
    advance : callable or None
        ``advance(done, total, {})`` after each image of a shard; for this process alone.
    """

    size: tuple[int, int]
    space: str
    ranks: tuple[int, ...]
    seed: int
    length: int
    folder: Path | None = None
    advance: ReadProgress | None = None

    def path(self, node: Node, channel: int) -> Path | None:
        """Return the file of a state."""
        name = f"pca-{node[0]:05d}-{node[1]:05d}-{channel}.npz"
        return None if self.folder is None else self.folder.absolute() / name


class Shard(NamedTuple):
    """A task: the images of one shard."""

    node: Node
    source: Images


class Merge(NamedTuple):
    """A task: two states of one channel."""

    node: Node
    channel: int
    first: Stored
    second: Stored


class Made(NamedTuple):
    """The states of the channels of a shard, and what was said while it was read."""

    states: list[Stored]
    notes: list[str]


def is_large(source: Any) -> bool:
    """Whether a source has so many images that their PCA is always done in shards."""
    return is_countable(source) and len(source) > SHARD


def shard_block_length(size: tuple[int, int], images: int) -> int:
    """Return the number of images of a block: of one shard, or of several."""
    return max(1, block_length(size) // (BLOCKS_OF_SHARD if images > SHARD else 1))


def shard_states(
    source: Images,
    options: ShardOptions,
    executor: Executor,
    progress: Progress = lambda done, total: None,
) -> EigenState:
    """Find the state of many images by an executor.

    Parameters
    ----------
    source : sequence, ndarray or LazyImages
        See `is_countable`.
    options : ShardOptions
        With a folder, states that are there are not computed again: a run that stopped continues.
    executor : Executor
    progress : callable, optional
        Called after each shard.

    Returns
    -------
    EigenState
        Of 3 channels. Its `lost` bounds what the shards and the merges have lost.

    Raises
    ------
    ImageError
        If no image can be read.
    ClusterError
        If the cluster is lost, or a task ends its worker again and again.
    """
    count = -(-len(source) // SHARD)
    levels = tree_levels(count)
    channels = range(len(options.ranks))
    states: dict[tuple[Node, int], Stored] = {}
    for node in (node for level in levels for node in level):
        for channel in channels:
            if (path := options.path(node, channel)) and path.exists():
                states[node, channel] = path

    def known(node: Node) -> bool:
        return all((node, channel) in states for channel in channels)

    def needed(node: Node) -> bool:
        """Whether a node has to be computed: neither it nor what it became is known."""
        return not any(known(other) for level in levels for other in level if holds(other, node))

    wanted = [node for node in levels[0] if needed(node)]
    done = len(source) - sum(_size(node, len(source)) for node in wanted)
    tasks = (Shard(node, absolute(source[node[0] * SHARD : node[1] * SHARD])) for node in wanted)
    with closing(completed(executor, make_shard, tasks, options)) as ended:
        for index, made in ended:
            for note in made.notes:
                warn(note)
            states |= {(wanted[index], c): state for c, state in enumerate(made.states)}
            progress(done := done + _size(wanted[index], len(source)), len(source))
    for below, level in pairwise(levels):
        _merge_level(below, level, states, needed, options, executor)
    parts = [_load(states[levels[-1][0], channel]) for channel in channels]
    if parts[0].count == 0:
        raise ImageError(f"none of {len(source)} images can be read; check the files")
    return _join(parts)


def make_shard(shard: Shard, options: ShardOptions) -> Made:
    """Find the state of each channel of a shard; this function runs on a worker."""
    seed = options.seed + shard.node[0]
    states = [empty_state(options.size, seed, channels=1) for _ in options.ranks]
    source = readable(shard.source)
    with collect_notes(source) as notes:
        blocks = read_blocks(source, options.size, options.space, options.length, options.advance)
        with closing(blocks):
            for block in blocks:
                for c, rank in enumerate(options.ranks):
                    states[c] = merge(states[c], block[:, c : c + 1], [rank])
                del block  # before the next is read
    stored = [_store(state, options.path(shard.node, c)) for c, state in enumerate(states)]
    return Made(stored, notes)


def merge_pair(pair: Merge, options: ShardOptions) -> Stored:
    """Merge two states of one channel; this function runs on a worker."""
    state = merge_states(_load(pair.first), _load(pair.second), [options.ranks[pair.channel]])
    return _store(state, options.path(pair.node, pair.channel))


def _merge_level(
    below: list[Node],
    level: list[Node],
    states: dict[tuple[Node, int], Stored],
    needed: Callable[[Node], bool],
    options: ShardOptions,
    executor: Executor,
) -> None:
    """Compute the nodes of a level that are not known, and forget those below."""
    pairs = [[child for child in below if holds(node, child)] for node in level]
    channels = range(len(options.ranks))
    wanted = [
        (node, channel, children)
        for node, children in zip(level, pairs, strict=True)
        if len(children) == 2 and needed(node)
        for channel in channels
        if (node, channel) not in states
    ]
    tasks = (
        Merge(node, channel, states[children[0], channel], states[children[1], channel])
        for node, channel, children in wanted
    )
    with closing(completed(executor, merge_pair, tasks, options)) as ended:
        for index, state in ended:
            node, channel, children = wanted[index]
            states[node, channel] = state
            if needed(node):  # its other channels may need them, if this run stops here
                continue
            for old in [states.pop((child, c)) for child in children for c in channels]:
                if isinstance(old, Path):
                    old.unlink(missing_ok=True)


def _size(node: Node, images: int) -> int:
    return min(node[1] * SHARD, images) - node[0] * SHARD


def _store(state: EigenState, path: Path | None) -> Stored:
    if path is None:
        return state
    write_arrays(path, state.arrays())
    return path


def _load(stored: Stored) -> EigenState:
    return EigenState.from_arrays(read_arrays(stored)) if isinstance(stored, Path) else stored


def _join(parts: list[EigenState]) -> EigenState:
    """Return one state of the states of all channels."""

    def stack(name: str, axis: int = 0) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts], axis=axis)

    return replace(
        parts[0],
        mean=stack("mean"),
        rows=tuple(part.rows[0] for part in parts),
        scatter=tuple(part.scatter[0] for part in parts),
        squares=stack("squares"),
        examples=stack("examples", 1),
        lost=stack("lost"),
    )
