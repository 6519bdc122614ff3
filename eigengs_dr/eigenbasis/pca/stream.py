"""The components of all images of a source: shards that workers process, merged in order.

A shard is a part of the images, determined only by their number. Its state is computed block by
block, in this process or on a worker. This process then merges the states of the shards in order,
so that the result is bit-identical for any number of workers. Each channel has its own state, and
merged states are stored in files, so that a large family fits into 1 GB of memory.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from contextlib import closing, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from ...backend.executor import completed
from ...backend.messages import warn
from ...backend.types import Values
from ...cluster import executor_for
from ...image.folder import ReadProgress, TrainingImages, list_images, read_blocks
from ...image.pixels import ImageError
from ...image.remote import is_url
from ...storage.checkpoint import read_arrays, write_arrays
from .incremental import EigenState, block_length, empty_state, merge, merge_states

SHARD = 2048
"""Number of images of a shard. Merging two states of 375 rows takes 0.2 of the time of a shard of
images of 256x256."""

BLOCK_DIVISOR = 4
"""With several shards, the number of images of a block from `block_length` is divided by this: 256
of 256x256. A process then needs less than 1 GB."""

Images = Sequence | Values
"""Files or single images, or one array of images."""


class Stream(NamedTuple):
    """The parameters that determine the states of images.

    Attributes
    ----------
    size : (int, int)
    space : {"ycbcr", "rgb"}
    ranks : sequence of 3 ints
        Largest number of rows of the state of each channel.
    length : int
        Number of images of a block.
    progress : callable or None
        Used in this process only.
    """

    size: tuple[int, int]
    space: str
    ranks: Sequence[int]
    length: int
    progress: ReadProgress | None


def find_states(
    source: TrainingImages,
    size: tuple[int, int],
    space: str,
    ranks: Sequence[int],
    progress: ReadProgress | None = None,
    client: object = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> list[EigenState]:
    """Compute the state of each channel for all images of a source.

    Parameters
    ----------
    ranks : sequence of 3 ints
        Largest number of rows of the state of each channel.
    source, size, space, progress, client, checkpoint
        See `eigengs_dr.Eigenbasis.from_images`, also for errors.
    """
    images: Any = list_images(source) if isinstance(source, (str, os.PathLike)) else source
    countable = is_countable(images)
    if client is not None and not countable:
        raise ValueError("the source is not a list of files or images; a cluster needs a list")
    stream = Stream(size, space, ranks, block_length(size), progress)
    if client is None and not (countable and len(images) > SHARD):
        return _find_states_of_part(images, stream)
    with nullcontext(checkpoint) if checkpoint else TemporaryDirectory() as folder:
        return _merge_shards(images, stream, client, Path(folder))


def is_countable(source: object) -> bool:
    """Return whether a source is a sequence of files or single images, which can be sharded."""
    if isinstance(source, np.ndarray):
        return source.ndim == 4 or (source.ndim == 3 and source.shape[2] not in (1, 3))
    return isinstance(source, Sequence) and all(
        isinstance(item, (str, os.PathLike)) or getattr(item, "shape", ())[2:] in ((1,), (3,))
        for item in source
    )


def _merge_shards(images: Images, stream: Stream, client: object, folder: Path) -> list[EigenState]:
    """Merge the states of shards in order.

    In the folder, ``pca-C.npz`` holds the state of channel C after some shards, and their number.
    """
    total, report = len(images), stream.progress or (lambda done, total, row: None)
    files = [folder / f"pca-{c}.npz" for c in range(len(stream.ranks))]
    merged = [int(read_arrays(file)["shards"]) if file.exists() else 0 for file in files]
    begun = shard = min(merged)
    done = min(begun * SHARD, total)

    if total > SHARD:
        stream = stream._replace(length=max(1, stream.length // BLOCK_DIVISOR))
    in_shard = None if client is not None else lambda n, of, row: report(done + n, total, row)
    stream = stream._replace(progress=in_shard)
    tasks = (
        (k, _absolute(images[k * SHARD : (k + 1) * SHARD]))
        for k in range(begun, -(-total // SHARD))
    )
    waiting: dict[int, list[EigenState]] = {}
    with closing(completed(executor_for(client), make_shard, tasks, stream)) as ended:
        for (k, part), (states, notes) in ended:
            for note in notes:
                warn(note)
            waiting[k] = states
            done += len(part)
            if client is not None:
                report(done, total, {})
            while ready := waiting.pop(shard, None):
                for c, file in enumerate(files):
                    state = ready.pop(0)  # frees its memory before the next shard
                    if merged[c] <= shard:
                        if shard:
                            state = merge_states(_read(file), state, stream.ranks[c])
                        write_arrays(file, state.arrays() | {"shards": np.array(shard + 1)})
                    del state
                shard += 1
    result = [_read(file) for file in files]
    if result[0].count == 0:
        raise ImageError(f"none of {total} images can be read; check the files")
    return result


def make_shard(task: tuple[int, Images], stream: Stream) -> tuple[list[EigenState], list[str]]:
    """Compute the states of a shard of images, and return its warnings; this runs on a worker.

    If no file of a shard can be read, its states are empty; an invalid array is an error.
    """
    _, images = task
    notes = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            states = _find_states_of_part(images, stream)
        except ImageError as error:
            if not isinstance(images, Sequence):
                raise
            states = [empty_state(stream.size) for _ in stream.ranks]
            notes.append(str(error))
    return states, notes + [str(note.message) for note in caught]


def _find_states_of_part(images: Images, stream: Stream) -> list[EigenState]:
    """Compute the state of each channel, block by block."""
    size, space, ranks, length, progress = stream
    states = [empty_state(size) for _ in ranks]
    with closing(read_blocks(images, size, space, length, progress)) as blocks:
        for block in blocks:
            for c, rank in enumerate(ranks):
                states[c] = merge(states[c], block[:, c], rank)
            del block  # before the next one is read
    return states


def _absolute(images: Images) -> Images:
    """Make file names absolute, because a worker runs in another folder."""
    if not isinstance(images, Sequence):
        return images
    is_file = (str, os.PathLike)
    return [
        Path(item).absolute() if isinstance(item, is_file) and not is_url(item) else item
        for item in images
    ]


def _read(file: Path) -> EigenState:
    arrays = read_arrays(file)
    del arrays["shards"]
    return EigenState.from_arrays(arrays)
