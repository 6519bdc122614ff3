"""A run over pieces, and the runs of jobs over many images.

`run_pieces` is the one run: pieces that an earlier call has done are not done again, the others are
worked on, and every piece ends with its result kept. The pieces of `eigengs_dr.fit_many` are
images, whose results are files of a folder; those of `eigengs_dr.fit_large` are blocks, whose
Gaussians a checkpoint keeps.

In this process, a run over images reads ahead and writes results in the background. On a cluster,
each task is such a run over a chunk of images. Chunks depend on the images only, never on timings,
so that runs are reproducible.
"""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..backend.interrupts import Interrupted, defer_interrupts
from ..backend.recording import exclusive
from ..cluster import Executor, executor_for
from ..fitting.fit import Fit
from ..gaussian.file import FitFigures, write_set
from ..gaussian.gaussians import Gaussians
from ..image.folder import read_ahead
from ..image.metrics import psnr
from ..image.notes import NotedImages, kept_warnings, series, tell_all
from ..image.pixels import EncodedImage
from ..raster.render import render
from ..storage.atomic import lock_folder, refuse_url, remove_stale
from .images import ImageRow, Images, RowProgress, RunImage, find_result, list_sources

WRITERS = 2
"""Number of threads that compress and write results: 5,000 Gaussians take 6 ms."""

MAX_WRITING = 8
"""Largest number of results that wait to be written."""

FAILURES = (ValueError, OSError, MemoryError)
"""Errors of one image, which do not end the run."""

FIGURES = ("psnr_ycbcr", "psnr_rgb", "iterations", "kept", "stopped")
"""Figures of a fit in a row."""

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def run_pieces(
    pieces: Iterable[Piece],
    find: Callable[[Piece], Result | None],
    work: Callable[[Iterator[Piece]], Generator[tuple[Piece, Result], None, None]],
    end: Callable[[Piece, Result], None],
) -> None:
    """Run over pieces: find the results of an earlier call, work on the other pieces, end each.

    Parameters
    ----------
    pieces : iterable
        A piece is taken when there is room for its work.
    find : callable
        Returns the result of a piece if an earlier call has done it, otherwise None.
    work : callable
        ``work(pieces)`` yields pieces with their results, in any order. It is closed if `end` or
        `find` raises.
    end : callable
        ``end(piece, result)`` is called for every piece.
    """

    def unfinished() -> Iterator[Piece]:
        for piece in pieces:
            result = find(piece)
            if result is None:
                yield piece
            else:
                end(piece, result)

    with closing(work(unfinished())) as ended:
        for piece, result in ended:
            end(piece, result)


class Job(NamedTuple):
    """The work of a run on its images, which can be sent to the workers of a cluster.

    Attributes
    ----------
    work : callable
        ``work(images)`` returns the results of a group, in order.
    read : callable
        ``read(image, name)`` reads an image, whose warnings name it so if it is no file.
    may_join : callable
        ``may_join(group, image)`` returns whether an image may join a group that is not empty; by
        default none may.
    steps : int
        Number of descent steps per image, as a measure of the work.
    options : str
        Digest of the options on which the results depend.
    measures : bool
        Whether results are sets without figures, whose pictures are compared with the images.
    """

    work: Callable[[list[EncodedImage]], list[Fit] | list[Gaussians]]
    read: Callable[[Any, str], EncodedImage]
    may_join: Callable[[list[EncodedImage], EncodedImage], bool] | None = None
    steps: int = 0
    options: str = ""
    measures: bool = False


def run_images(
    images: Images,
    output: str | os.PathLike[str] | None,
    overwrite: bool,
    job: Job,
    progress: RowProgress | None = None,
    client: object = None,
    recursive: bool = False,
) -> list[ImageRow]:
    """Run a job; for arguments, rows and errors see `eigengs_dr.fit_many`.

    In this process, images that are processed end in order.
    """
    sources = list_sources(images, recursive, output)
    total = len(sources) if isinstance(sources, list) else None
    executor = None if client is None else executor_for(client)
    rows: dict[int, ImageRow] = {}
    earlier: dict[int, ImageRow | None] = {}

    def find(source: RunImage) -> ImageRow | None:
        if source.place in earlier:
            return earlier[source.place]
        if source.error:
            return source._replace(output=None).row("failed", error=source.error)
        return find_result(source, job.options, overwrite)

    def end(source: RunImage, row: ImageRow) -> None:
        if row.error:
            row = replace(row, result=None)
        rows[source.place] = row if output is None else replace(row, result=None)
        if progress:
            progress(len(rows), total, row)

    def work(unfinished: Iterator[RunImage]) -> Generator[Finished, None, None]:
        if executor is None:
            return run_here(unfinished, job)
        return run_on_workers(unfinished, job, executor, total, keep=output is None)

    with ExitStack() as stack:
        if output is not None:
            folder = make_folder(output)
            stack.enter_context(lock_folder(folder))
            remove_stale(folder)
            if isinstance(sources, list):  # results of other options are refused before any work
                earlier = {source.place: find(source) for source in sources}
        stack.enter_context(series())
        try:
            run_pieces(sources, find, work, end)
        except KeyboardInterrupt:
            done = [rows[place] for place in sorted(rows)]
            message = f"interrupted after {len(done)} images; .result holds their rows"
            raise Interrupted(done, message) from None
    return [rows[place] for place in sorted(rows)]


def make_folder(output: str | os.PathLike[str]) -> Path:
    """Create the folder of the results, and check that files can be written there.

    Raises
    ------
    OSError
        If the folder cannot be created or written, or is a URL.
    """
    refuse_url(output)
    output = Path(output)
    if output.exists() and not output.is_dir():
        raise OSError(f"{output}: is a file; many images need a folder")
    is_new = not output.exists()
    output.mkdir(parents=True, exist_ok=True)
    try:
        with lock_folder(output):
            return output
    except OSError:
        if is_new:
            output.rmdir()
        raise


# ---------------------------------------------------------------------------------------------
#  In this process: groups of images
# ---------------------------------------------------------------------------------------------

Decoded = tuple[RunImage, EncodedImage | Exception]
"""An image that was read, or the error."""

Finished = tuple[RunImage, ImageRow]
"""An image whose result, if there is one, is written, and its row."""


def run_here(sources: Iterable[RunImage], job: Job) -> Generator[Finished, None, None]:
    """Process groups of images, and write each result while the next ones are computed.

    Yields
    ------
    Finished
        One for each image, in order. The row has the result, whether or not there is an output
        folder, or the error.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C or SIGTERM, once all results are written and yielded.
    """
    decoded = read_ahead(sources, partial(_decode, job=job), _is_file, _bytes_of)
    writing: deque[tuple[RunImage, ImageRow, Future[None] | None]] = deque()

    def is_written() -> bool:
        file = writing[0][2]
        return file is None or file.done()

    with (
        closing(decoded),
        ThreadPoolExecutor(WRITERS, thread_name_prefix="write") as pool,
        defer_interrupts() as interrupted,
    ):
        try:
            for group in _groups(decoded, job):
                for source, row, gaussians in _work_on(group, job):
                    file = None
                    if gaussians is not None and row.output:
                        # Only this thread uses Dr.Jit: the writers get NumPy arrays.
                        figures = figures_of(row, job.options)
                        file = pool.submit(write_set, row.output, gaussians.data(), figures)
                    writing.append((source, row, file))
                    while writing and (len(writing) > MAX_WRITING or is_written()):
                        yield _finish(*writing.popleft())
                    if interrupted():
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            yield from (_finish(*entry) for entry in writing)
            raise
        yield from (_finish(*entry) for entry in writing)


def _decode(source: RunImage, job: Job) -> Decoded:
    """Read one image. An array is copied, because its owner may overwrite it."""
    try:
        image = job.read(source.image, source.name)
        if source.path is None:
            image = image._replace(pixels=np.array(image.pixels))
        return source, image
    except FAILURES as error:
        return source, error


def _is_file(source: RunImage) -> bool:
    return source.path is not None


def _bytes_of(decoded: Decoded) -> int:
    image = decoded[1]
    return 0 if isinstance(image, Exception) else image.pixels.nbytes


def _groups(decoded: Iterable[Decoded], job: Job) -> Iterator[list[Decoded]]:
    """Collect consecutive images that may be processed together."""
    group: list[Decoded] = []
    for source, image in decoded:
        images = [member for _, member in group if isinstance(member, EncodedImage)]
        joins = (
            images
            and isinstance(image, EncodedImage)
            and job.may_join is not None
            and job.may_join(images, image)
        )
        if group and not joins:
            yield group
            group = []
        group.append((source, image))
    if group:
        yield group


def _work_on(
    group: list[Decoded], job: Job
) -> Iterator[tuple[RunImage, ImageRow, Gaussians | None]]:
    """Yield the rows of a group, with the Gaussians to write."""
    started = time.perf_counter()
    results = _results([image for _, image in group], job)
    seconds = (time.perf_counter() - started) / len(group)
    for (source, image), result in zip(group, results, strict=True):
        if isinstance(result, Exception) or isinstance(image, Exception):
            yield source, _failed(source, result), None
            continue
        gaussians = result if isinstance(result, Gaussians) else result.gaussians
        height, width = image.pixels.shape[:2]
        figures = {name: getattr(result, name) for name in FIGURES if hasattr(result, name)}
        figures |= {"width": width, "height": height, "gaussians": len(gaussians)}
        if job.measures:
            picture = render(gaussians).numpy()
            figures |= {f"psnr_{s}": psnr(picture, image.pixels, s) for s in ("ycbcr", "rgb")}
        yield source, source.row("done", seconds=seconds, result=result, **figures), gaussians


def figures_of(row: ImageRow, options: str = "") -> FitFigures:
    """Return the figures that are stored in the file of a result."""
    name = "" if row.input is None else Path(row.input).name
    return FitFigures(row.psnr_ycbcr, row.psnr_rgb, row.iterations, name, options)


def _results(images: list, job: Job) -> list:
    """Return the results of a group; if it fails, process its images one by one."""
    if isinstance(images[0], Exception):
        return images
    try:
        with exclusive():  # per group, so that other threads need not wait for the run
            return list(job.work(images))
    except FAILURES as error:
        return [error] if len(images) == 1 else [_results([image], job)[0] for image in images]


def _failed(source: RunImage, error: Exception) -> ImageRow:
    """Return the row of an image that failed; the error is stored as its result."""
    name, text = str(source.path or source.name), str(error) or type(error).__name__
    if isinstance(error, OSError) and error.filename is not None:
        text = f"{error.filename}: {error.strerror}"
    elif not text.startswith(name):
        text = f"{name}: {text.removeprefix('image: ')}"
    return source.row("failed", error=text, result=error)


def _finish(source: RunImage, row: ImageRow, file: Future[None] | None) -> Finished:
    """Wait until a result is written; a file that cannot be written is an error of the image."""
    try:
        if file:
            file.result()
    except OSError as error:
        row = _failed(source, error)
    return source, row


# ---------------------------------------------------------------------------------------------
#  On the workers of a cluster: chunks of images
# ---------------------------------------------------------------------------------------------

MAX_CHUNK_WORK = 1 << 27
"""Largest work of a chunk, in pixels times steps, for a few seconds; the size of a file in bytes
stands for its pixels. A task costs Dask some milliseconds, and a lost worker loses half a chunk on
average."""

MAX_CHUNK_IMAGES = 256
"""Largest number of images of a chunk."""

SETUP_STEPS = 10
"""Number of descent steps that take as long as the work before the first step."""

WORK_PER_BYTE = 8
"""Minimum work per byte of an array: the scheduler keeps a copy of at most 16 MB until the chunk is
done."""


def run_on_workers(
    sources: Iterable[RunImage], job: Job, executor: Executor, total: int | None, keep: bool
) -> Generator[Finished, None, None]:
    """Process images with an executor.

    Parameters
    ----------
    sources, job
        See `run_here`.
    executor : Executor
    total : int or None
        Number of images, if it is known.
    keep : bool
        Whether results are sent back.

    Yields
    ------
    Finished
        One for each image, in any order. An image whose failure may be temporary is tried once
        more. So are the images of a chunk that crashed its worker, one by one, so that no image
        fails because of another.

    Raises
    ------
    ClusterError
        If the cluster is lost.
    """
    retries: list[RunImage] = []
    chunks = _cut(sources, job, total, executor.workers), ([source] for source in retries)
    for last, tasks in enumerate(chunks):
        with closing(executor.map(run_chunk, tasks, (job, keep, Path.cwd()))) as ended:
            for chunk, result, lost in ended:
                rows, noted = result or ([_lost(s, lost) for s in chunk], {})
                tell_all(noted)
                for source, (row, is_transient) in zip(chunk, rows, strict=True):
                    if is_transient and not last:
                        retries.append(source)
                    else:
                        yield source, row


ChunkRow = tuple[ImageRow, bool]
"""The row of an image of a chunk; whether a failure may be temporary, as on a full disk."""


def _lost(source: RunImage, lost: str) -> ChunkRow:
    """Return the failure of an image whose chunk crashed its worker."""
    return source.row("failed", error=f"{source.path or source.name}: {lost}"), True


def run_chunk(
    chunk: list[RunImage], shared: tuple[Job, bool, Path]
) -> tuple[list[ChunkRow], NotedImages]:
    """Process the images of a chunk on a worker; return their rows, and the warnings.

    Names in the rows are as the user gave them, relative to the folder of the client.
    """
    job, keep, folder = shared
    with kept_warnings() as noted:
        ended = list(run_here((_absolute(source, folder) for source in chunk), job))
    rows = []
    for source, (_, row) in zip(chunk, ended, strict=True):
        is_transient = isinstance(row.result, OSError)
        result = row.result if keep and not row.error else None
        row = replace(row, input=source.path, output=source.output, result=result)
        rows.append((row, is_transient))
    return rows, noted


def _absolute(source: RunImage, folder: Path) -> RunImage:
    """Make file names absolute, because a worker runs in another folder."""
    image = folder / source.image if isinstance(source.image, Path) else source.image
    return source._replace(image=image, output=source.output and folder / source.output)


def _cut(
    sources: Iterable[RunImage], job: Job, total: int | None, workers: int
) -> Iterator[list[RunImage]]:
    """Divide the images into chunks.

    The last chunks are shorter, so that all workers end at about the same time.
    """
    chunk: list[RunImage] = []
    work = 0
    for source in sources:
        if source.path is None:  # a copy, because the owner may overwrite the array
            source = source._replace(image=np.array(source.image))
        chunk.append(source)
        work += _work_of(source, job.steps)
        limit = MAX_CHUNK_IMAGES
        if total is not None:  # this counts images that are skipped too
            limit = min(MAX_CHUNK_IMAGES, (total - 1 - source.place) // (2 * workers))
        if len(chunk) >= limit or work >= MAX_CHUNK_WORK:
            yield chunk
            chunk, work = [], 0
    if chunk:
        yield chunk


def _work_of(source: RunImage, steps: int) -> int:
    """Estimate the work on an image, in pixels times steps."""
    steps += SETUP_STEPS
    if source.path is None:
        pixels = math.prod(source.image.shape[:2])
        return max(pixels * steps, WORK_PER_BYTE * source.image.nbytes)
    # Errors of a file are left to the worker.
    return source.path.stat().st_size * steps if source.path.is_file() else 0
