"""The components of all images of a source: shards that workers stream, merged one after the other.

A shard is a part of the images, cut by their number alone. Its state is found block by block, in
this process or on a worker. This process then merges the states of shards in their order, so the
result has the same bits for any number of workers. The channels are states of their own: a merge
holds two of them, and a large family fits into 1 GB.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...backend.executor import Executor, LocalExecutor, completed, executor_for
from ...backend.feedback import warn
from ...image.folder import ReadProgress, Source, list_images, read_blocks
from ...image.pixels import ImageError
from ...image.remote import is_url
from ...storage.checkpoint import read_arrays, write_arrays
from .incremental import EigenState, block_length, empty_state, merge, merge_states, rank_for

SHARD = 2048
"""Images of a shard. Merging two states of 375 rows takes 0.2 of the time of a shard of so many
images of 256x256."""

BLOCKS_OF_SHARD = 4
"""If there are several shards, a block has this fraction of the images of `block_length`: 256 of
256x256. A process then needs less than 1 GB."""

Images = Sequence[Any] | NDArray[Any]
"""Files or single images, or one array of images."""

Stored = EigenState | Path
"""A state of one channel, or its file."""


@dataclass(frozen=True)
class PCAOptions:
    """What decides a state, beside the images; see `eigengs_dr.Eigenbasis.from_images`.

    Attributes
    ----------
    size : (int, int)
    space : {"ycbcr", "rgb"}
    components : tuple of 3 ints
        Most components of each channel. A state keeps some more.
    seed : int

    Raises
    ------
    ValueError
        If the seed is negative.
    """

    size: tuple[int, int]
    space: str
    components: tuple[int, ...]
    seed: int

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; expected no negative number")

    @property
    def ranks(self) -> list[int]:
        """Most rows of a state, for each channel."""
        return [rank_for(k) for k in self.components]


def find_state(
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
        Of 3 channels. Its `lost` bounds what blocks and merges have lost.
    """
    images: Any = list_images(source) if isinstance(source, (str, os.PathLike)) else source
    countable = is_countable(images)
    if client is not None and not countable:
        raise ValueError("the source is no list of files or images; a cluster needs a list")
    executor = executor_for(client)
    if client is None and not (countable and len(images) > SHARD):
        return _join(_stream(images, options, block_length(options.size), options.seed, progress))
    with ExitStack() as stack:
        if checkpoint is None and client is None:  # the states of all shards would fill the memory
            checkpoint = stack.enter_context(TemporaryDirectory())
        folder = None if checkpoint is None else Path(checkpoint).absolute()
        return _merge_shards(images, options, executor, folder, progress)


def is_countable(source: Any) -> bool:
    """Whether a source is a sequence of files or of single images, which can be cut in shards."""
    if isinstance(source, np.ndarray):
        return source.ndim == 4 or (source.ndim == 3 and source.shape[2] not in (1, 3))
    return isinstance(source, Sequence) and all(
        isinstance(item, (str, os.PathLike)) or getattr(item, "shape", ())[2:] in ((1,), (3,))
        for item in source
    )


class Shard(NamedTuple):
    """A task: the images of one shard, and the files of its states, or None."""

    number: int
    images: Images
    files: list[Path] | None


class _Shared(NamedTuple):
    """What all tasks share; `progress` is for this process alone."""

    options: PCAOptions
    length: int
    progress: ReadProgress | None


def _merge_shards(
    images: Images,
    options: PCAOptions,
    executor: Executor,
    folder: Path | None,
    progress: ReadProgress | None,
) -> EigenState:
    """Merge the states of shards in their order, as they end; files in the folder are not remade.

    In the folder ``pca-K-C.npz`` is channel C of shard K, and ``pca-sum-C.npz`` the sum of the
    first shards, with their number.
    """
    channels, total = range(len(options.ranks)), len(images)
    count = -(-total // SHARD)
    sums = [_read_sum(folder, c) for c in channels]
    first = min(merged for merged, _ in sums)
    ready: dict[int, list[Stored]] = {}
    wanted: list[Shard] = []
    for k in range(first, count):
        files = [folder / f"pca-{k:05d}-{c}.npz" for c in channels] if folder else None
        if files and all(f.exists() or sums[c][0] > k for c, f in enumerate(files)):
            ready[k] = list(files)
        else:
            wanted.append(Shard(k, _absolute(images[k * SHARD : (k + 1) * SHARD]), files))
    done = min(first * SHARD, total) + sum(_size(k, total) for k in ready)
    local = isinstance(executor, LocalExecutor)

    def advance(within: int, of: int | None, row: dict[str, Any]) -> None:
        if progress:
            progress(done + within, total, row)

    length = max(1, block_length(options.size) // (BLOCKS_OF_SHARD if count > 1 else 1))
    shared = _Shared(options, length, advance if local else None)
    with closing(completed(executor, make_shard, wanted, shared)) as ended:
        for shard, (states, notes) in ended:
            for note in notes:
                warn(note)
            ready[shard.number] = states
            done += _size(shard.number, total)
            if progress and not local:
                progress(done, total, {})
            first = _add_ready(sums, ready, first, options, folder)
    _add_ready(sums, ready, first, options, folder)
    state = _join([_load(stored) for _, stored in sums if stored is not None])
    if state.count == 0:
        raise ImageError(f"none of {total} images can be read; check the files")
    return state


def make_shard(shard: Shard, shared: _Shared) -> tuple[list[Stored], list[str]]:
    """Find the states of the channels of a shard, and what was said; this runs on a worker."""
    options, length, progress = shared
    seed = options.seed + shard.number
    states = [empty_state(options.size, seed, channels=1) for _ in options.ranks]
    with _collect_notes(shard.images) as notes:
        states = _stream(shard.images, options, length, seed, progress)
    if shard.files is None:
        return list(states), notes
    for state, file in zip(states, shard.files, strict=True):
        write_arrays(file, state.arrays())
    return list(shard.files), notes


def _stream(
    images: Any, options: PCAOptions, length: int, seed: int, progress: ReadProgress | None
) -> list[EigenState]:
    """Return the state of each channel, block by block."""
    states = [empty_state(options.size, seed, channels=1) for _ in options.ranks]
    blocks = read_blocks(images, options.size, options.space, length, progress)
    with closing(blocks):
        for block in blocks:
            for c, rank in enumerate(options.ranks):
                states[c] = merge(states[c], block[:, c : c + 1], [rank])
            del block  # before the next is read
    return states


@contextmanager
def _collect_notes(source: Any) -> Iterator[list[str]]:
    """Collect the warnings of a block that reads images; that none can be read is a note too.

    A wrong array is an error.
    """
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            yield notes
        except ImageError as error:
            if not isinstance(source, Sequence):
                raise
            notes.append(str(error))
    notes += [str(note.message) for note in caught]


def _absolute(images: Images) -> Images:
    """Name files from the root: a worker runs in another folder."""
    if not isinstance(images, Sequence):
        return images
    is_file = (str, os.PathLike)
    return [
        Path(item).absolute() if isinstance(item, is_file) and not is_url(item) else item
        for item in images
    ]


# ---------------------------------------------------------------------------------------------
#  The sum of the first shards, channel by channel
# ---------------------------------------------------------------------------------------------

Sum = tuple[int, Stored | None]
"""How many shards are merged, and their state."""


def _add_ready(
    sums: list[Sum],
    ready: dict[int, list[Stored]],
    first: int,
    options: PCAOptions,
    folder: Path | None,
) -> int:
    """Merge the shards that are ready, from `first` on; return the next shard that is needed."""
    while first in ready:
        for c, part in enumerate(ready.pop(first)):
            merged, total = sums[c]
            if merged == first:
                state = _load(part)
                if total is not None:
                    state = merge_states(_load(total), state, [options.ranks[c]])
                sums[c] = first + 1, _write_sum(state, first + 1, folder, c)
            if isinstance(part, Path):
                part.unlink(missing_ok=True)
        first += 1
    return first


def _read_sum(folder: Path | None, channel: int) -> Sum:
    if folder is None or not (file := folder / f"pca-sum-{channel}.npz").exists():
        return 0, None
    return int(read_arrays(file)["shards"]), file


def _write_sum(state: EigenState, shards: int, folder: Path | None, channel: int) -> Stored:
    if folder is None:
        return state
    file = folder / f"pca-sum-{channel}.npz"
    write_arrays(file, state.arrays() | {"shards": np.array(shards)})
    return file


def _load(stored: Stored) -> EigenState:
    return EigenState.from_arrays(read_arrays(stored)) if isinstance(stored, Path) else stored


def _size(shard: int, images: int) -> int:
    return min((shard + 1) * SHARD, images) - shard * SHARD


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
