"""The state of all images of a source: in one stream, or in shards."""

from __future__ import annotations

import os
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ...backend.executor import executor_for
from ...image.folder import ReadProgress, Source, image_files, read_blocks
from .incremental_pca import EigenState, block_length, empty_state, merge
from .lazy_images import LazyImages, is_lazy
from .shards import ShardOptions, is_countable, is_large, shard_block_length, shard_states


def accumulate(
    source: Source,
    size: tuple[int, int],
    color: str,
    ranks: tuple[int, ...],
    seed: int,
    progress: ReadProgress | None = None,
    client: Any = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> EigenState:
    """Merge all images of a source into one state.

    Parameters
    ----------
    ranks : tuple of 3 ints
        Most rows of the state, for each channel.
    source, size, color, seed, progress, client, checkpoint
        See `eigengs_dr.Eigenbasis.from_images`, also for errors.

    Returns
    -------
    EigenState
    """
    images: Any = source
    if isinstance(source, (str, os.PathLike)):
        images = image_files(Path(source))
    elif is_lazy(source):
        images = LazyImages(source, size)
    if is_large(images) or (client is not None and is_countable(images)):
        return _in_shards(images, size, color, ranks, seed, progress, client, checkpoint)
    if client is not None:
        raise ValueError("the source is no list of files or images; a cluster needs a list")
    length, state = block_length(size), empty_state(size, seed)
    if isinstance(images, LazyImages):
        images = images.blocks(length)
    with closing(read_blocks(images, size, color, length, progress)) as blocks:
        for block in blocks:
            state = merge(state, block, ranks)
            del block  # before the next is read
    return state


def _in_shards(
    images: Any,
    size: tuple[int, int],
    color: str,
    ranks: tuple[int, ...],
    seed: int,
    progress: ReadProgress | None,
    client: Any,
    checkpoint: str | os.PathLike[str] | None,
) -> EigenState:
    """Merge images in shards, here or on a cluster."""

    def report(done: int, total: int) -> None:
        if progress:
            progress(done, total, {})

    with ExitStack() as stack:
        if checkpoint is None and client is None:  # the states of all shards would fill the memory
            checkpoint = stack.enter_context(TemporaryDirectory())
        folder = None if checkpoint is None else Path(checkpoint)
        length = shard_block_length(size, len(images))
        options = ShardOptions(size, color, ranks, seed, length, folder)
        return shard_states(images, options, executor_for(client), report)
