"""The state of all images of a source: in one stream, in shards, or from their Gram matrix."""

from __future__ import annotations

import os
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ...backend.executor import executor_for
from ...image.folder import ReadProgress, Source, list_images, read_blocks
from .lazy_images import LazyImages, is_lazy
from .solvers.gram import gram_state
from .solvers.incremental_pca import EigenState, block_length, empty_state, merge, rank_for
from .solvers.parts import is_countable, readable
from .solvers.shards import ShardOptions, is_large, shard_block_length, shard_states
from .solvers.store_images import StoreOptions, store_images, store_images_by

SOLVERS = ("incremental", "gram")
"""Ways to the components; see `eigengs_dr.Eigenbasis.from_images`."""


@dataclass(frozen=True)
class PCAOptions:
    """What decides a state, beside the images; see `eigengs_dr.Eigenbasis.from_images`.

    Attributes
    ----------
    size : (int, int)
    space : {"ycbcr", "rgb"}
    components : tuple of 3 ints
        Most components of each channel. The incremental solver keeps some more in the state.
    seed : int
    solver : {"incremental", "gram"}

    Raises
    ------
    ValueError
        If the solver is unknown, or the seed is negative.
    """

    size: tuple[int, int]
    space: str
    components: tuple[int, ...]
    seed: int
    solver: str = "incremental"

    def __post_init__(self) -> None:
        if self.solver not in SOLVERS:
            raise ValueError(f"solver {self.solver!r} is unknown; use one of {', '.join(SOLVERS)}")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; expected no negative number")


def accumulate(
    source: Source,
    options: PCAOptions,
    progress: ReadProgress | None = None,
    client: Any = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> EigenState:
    """Find the state of all images of a source.

    Parameters
    ----------
    options : PCAOptions
    source, progress, client, checkpoint
        See `eigengs_dr.Eigenbasis.from_images`, also for errors.

    Returns
    -------
    EigenState
    """
    images: Any = source
    if isinstance(source, (str, os.PathLike)):
        images = list_images(source)
    elif is_lazy(source):
        images = LazyImages(source, options.size)
    if client is not None and not is_countable(images):
        raise ValueError("the source is no list of files or images; a cluster needs a list")
    if options.solver == "gram":
        return _by_gram(images, options, progress, client, checkpoint)
    if client is not None or is_large(images):
        return _in_shards(images, options, progress, client, checkpoint)
    ranks = [rank_for(k) for k in options.components]
    length, state = block_length(options.size), empty_state(options.size, options.seed)
    blocks = read_blocks(readable(images), options.size, options.space, length, progress)
    with closing(blocks):
        for block in blocks:
            state = merge(state, block, ranks)
            del block  # before the next is read
    return state


def _in_shards(
    images: Any,
    options: PCAOptions,
    progress: ReadProgress | None,
    client: Any,
    checkpoint: str | os.PathLike[str] | None,
) -> EigenState:
    """Merge images in shards, here or on a cluster."""

    def report(done: int, total: int) -> None:
        if progress:
            progress(done, total, {})

    size, space, seed = options.size, options.space, options.seed
    ranks = tuple(rank_for(k) for k in options.components)
    with ExitStack() as stack:
        if checkpoint is None and client is None:  # the states of all shards would fill the memory
            checkpoint = stack.enter_context(TemporaryDirectory())
        folder = None if checkpoint is None else Path(checkpoint)
        length = shard_block_length(size, len(images))
        shared = ShardOptions(size, space, ranks, seed, length, folder)
        return shard_states(images, shared, executor_for(client), report)


def _by_gram(
    images: Any,
    options: PCAOptions,
    progress: ReadProgress | None,
    client: Any,
    checkpoint: str | os.PathLike[str] | None,
) -> EigenState:
    """Find the exact components, here or on a cluster."""
    if client is not None and checkpoint is None:
        raise ValueError(
            "solver 'gram' keeps images in files; on a cluster, pass as checkpoint a folder that "
            "all workers see"
        )
    with ExitStack() as stack:
        folder = Path(checkpoint or stack.enter_context(TemporaryDirectory())).absolute()
        shared = StoreOptions(options.size, options.space, folder)
        executor = executor_for(client)
        if client is None:
            store = store_images(images, shared, progress)
        else:
            store = store_images_by(images, shared, executor, progress)
        return gram_state(store, options.components, options.seed, executor)
