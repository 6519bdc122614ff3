"""The images of a source into a `PlaneStore`, here or by workers."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ....backend.executor import Executor, completed
from ....backend.feedback import warn
from ....image.folder import ReadProgress, read_blocks
from ....image.io import ImageError
from .parts import Images, absolute, collect_notes, is_countable, readable
from .plane_store import PlaneStore, file_length, has_planes, write_planes

MAX_IMAGES = 1 << 14
"""Most images: their Gram matrix takes 2 GiB."""


@dataclass(frozen=True)
class StoreOptions:
    """What all tasks share.

    Attributes
    ----------
    size, space
        See `eigengs_dr.image.folder.read_blocks`.
    folder : Path
        Folder of the files, which all workers see.
    """

    size: tuple[int, int]
    space: str
    folder: Path


class Batch(NamedTuple):
    """A task: the images of one file."""

    number: int
    source: Images


def store_images(
    source: Any, options: StoreOptions, progress: ReadProgress | None = None
) -> PlaneStore:
    """Write the planes of images to files, one file after the other.

    Parameters
    ----------
    source : Any
        See `eigengs_dr.image.folder.read_blocks`, also for errors; or `LazyImages`.
    options : StoreOptions
    progress : callable, optional
        ``progress(done, total, {})`` after every image.

    Raises
    ------
    ValueError
        If there are more than `MAX_IMAGES` images.
    """
    if is_countable(source):
        check_count(len(source))
    length, files = file_length(options.size), 0
    blocks = read_blocks(readable(source), options.size, options.space, length, progress)
    with closing(blocks):
        for block in blocks:
            check_count(files * length + len(block))
            write_planes(options.folder, files, block)
            files += 1
            del block  # before the next is read
    return PlaneStore.open(options.folder, files)


def store_images_by(
    images: Images,
    options: StoreOptions,
    executor: Executor,
    progress: ReadProgress | None = None,
) -> PlaneStore:
    """Write the planes of images to the same files by an executor.

    Parameters
    ----------
    images : sequence, ndarray or LazyImages
        See `eigengs_dr.eigenbasis.pca.solvers.parts.is_countable`.
    options : StoreOptions
        Files that are there are not written again.
    executor : Executor
    progress : callable, optional
        ``progress(done, total, {})`` after every file.

    Raises
    ------
    ValueError
        If there are more than `MAX_IMAGES` images.
    ImageError
        If no image can be read.
    ClusterError
        If the cluster is lost, or a task ends its worker again and again.
    """
    total, length, done = len(images), file_length(options.size), 0
    check_count(total)
    starts = range(0, total, length)
    tasks = (Batch(k, absolute(images[i : i + length])) for k, i in enumerate(starts))
    with closing(completed(executor, store_batch, tasks, options)) as ended:
        for index, notes in ended:
            for note in notes:
                warn(note)
            done += min(length, total - starts[index])
            if progress:
                progress(done, total, {})
    store = PlaneStore.open(options.folder, len(starts))
    if not any(store.counts):
        raise ImageError(f"none of {total} images can be read; check the files")
    return store


def store_batch(batch: Batch, options: StoreOptions) -> list[str]:
    """Write one file, and return what was said while its images were read; runs on a worker."""
    if has_planes(options.folder, batch.number):
        return []
    source, size = readable(batch.source), options.size
    block = np.empty((0, 3, size[0] * size[1]), np.float32)
    with collect_notes(batch.source) as notes:
        [block] = read_blocks(source, size, options.space, file_length(size))
    write_planes(options.folder, batch.number, block)
    return notes


def check_count(images: int) -> None:
    """Raise ValueError if there are too many images for a Gram matrix."""
    if images > MAX_IMAGES:
        raise ValueError(
            f"solver 'gram' takes up to {MAX_IMAGES} images, whose Gram matrix has "
            f"{8 * MAX_IMAGES**2 >> 30} GiB, but there are more; use solver 'incremental'"
        )
