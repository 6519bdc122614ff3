"""The runner of many images: groups of images are worked on, and each image has a row of results.

In this process a run reads images ahead and writes results behind the work. On a cluster the same
run does a chunk of images a task. What the images are decides the chunks, never how long they took,
so that a run repeats itself.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..backend.executor import Executor, executor_for
from ..backend.feedback import defer_interrupts, warn
from ..gaussian.file import write
from ..gaussian.gaussians import Gaussians
from ..image.folder import read_ahead
from ..image.pixels import EncodedImage
from .manifest import ImageRow, Manifest, RowProgress, RunInterrupted
from .sources import Decoded, Images, Source, decode, list_sources, make_folder, plan_output

WRITERS = 2
"""Threads that compress and write results: 5,000 Gaussians take 6 ms."""

MAX_WRITING, MAX_WRITING_PIXELS = 32, 1 << 22
"""Largest number of results that wait for their file, and pixels of their images."""

FAILURES = (ValueError, OSError, MemoryError)
"""Errors of one image, which do not end the run."""


class Outcome(NamedTuple):
    """Result of the work on one image.

    Attributes
    ----------
    gaussians : Gaussians or None
        None if the image failed.
    result : Any
        What `ImageRow.result` holds.
    figures : dict
        Other attributes of the `ImageRow`.
    """

    gaussians: Gaussians | None
    result: Any
    figures: dict[str, Any]


Work = Callable[[list[EncodedImage]], Iterator[Outcome]]
"""``work(images)`` yields the outcome of every image of a group, in order."""


@dataclass(frozen=True)
class Job:
    """What a run does with its images. It can travel to the workers of a cluster.

    Attributes
    ----------
    make_work : callable
        Returns the `Work`. It is called once in each process.
    may_join : callable
        ``may_join(group, image)``: whether an image may join a group that is not empty.
    keep_grey, encoding
        See `eigengs_dr.image.io.load_image`.
    steps
        Steps of gradient descent of an image: how much work it is.
    """

    make_work: Callable[[], Work]
    may_join: Callable[[list[EncodedImage], EncodedImage], bool]
    keep_grey: bool = False
    encoding: str | None = None
    steps: int = 0

    @cached_property
    def work(self) -> Work:
        """The work on groups of images, ready."""
        return self.make_work()

    def __getstate__(self) -> dict[str, Any]:
        """Leave the work here: it may hold arrays of Dr.Jit, which do not travel."""
        return {key: value for key, value in self.__dict__.items() if key != "work"}


class Finished(NamedTuple):
    """An image whose result, if any, is written.

    Attributes
    ----------
    place : int
        Place of the image among the images of the run, from 0.
    row : ImageRow
        With the result, whether or not there is an output folder.
    may_pass : bool
        Whether a failure may pass by itself: a full disk, a network.
    """

    place: int
    row: ImageRow
    may_pass: bool = False


def run_images(
    images: Images,
    output: str | os.PathLike[str] | None,
    overwrite: bool,
    job: Job,
    progress: RowProgress | None = None,
    client: Any = None,
) -> list[ImageRow]:
    """Run a job; for arguments, rows and errors see `eigengs_dr.fit_many`.

    In this process the images end in their order.
    """
    sources = list_sources(images)
    total = len(sources) if isinstance(sources, list) else None
    loop: Callable[..., Generator[Finished, None, None]] = run_job
    if client is None:
        _ = job.work  # what is wrong with the options is said before the work
    else:
        loop = partial(
            run_on_workers, executor=executor_for(client), total=total, keep=output is None
        )
    rows: dict[int, ImageRow] = {}
    with ExitStack() as stack:
        manifest = None
        if output is not None:
            manifest = stack.enter_context(Manifest(make_folder(output)))
            sources = (plan_output(source, manifest, overwrite) for source in sources)
        try:
            for place, row, _ in stack.enter_context(closing(loop(sources, job))):
                if manifest:
                    manifest.add(row)
                rows[place] = replace(row, result=None) if manifest else row
                if progress:
                    progress(len(rows), total, row)
        except KeyboardInterrupt:
            raise RunInterrupted([rows[place] for place in sorted(rows)]) from None
    return [rows[place] for place in sorted(rows)]


# ---------------------------------------------------------------------------------------------
#  In this process: groups of images
# ---------------------------------------------------------------------------------------------

Writing = tuple[Finished, Future[None] | None]
"""An image, and its file if that is being written."""


def run_job(sources: Iterable[Source], job: Job) -> Generator[Finished, None, None]:
    """Work on groups of images, and write each result while the next ones are computed.

    Parameters
    ----------
    sources : iterable of Source
        With their output files.
    job : Job

    Yields
    ------
    Finished
        One for each image, in order. Its result is written before.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C or SIGTERM, when all results are written and yielded.
    """
    read = partial(decode, keep_grey=job.keep_grey, encoding=job.encoding)
    decoded = read_ahead(sources, read, _is_file, _bytes_of)
    writing, stopped = deque[Writing](), False
    with (
        closing(decoded),
        ThreadPoolExecutor(WRITERS, thread_name_prefix="write") as pool,
        defer_interrupts() as interrupted,
    ):
        try:
            for group in _group(decoded, job.may_join):
                for finished, gaussians in _work_on(group, job.work):
                    writing.append((finished, _write(pool, finished.row.output, gaussians)))
                    while writing and (_are_many(writing) or _is_written(writing[0])):
                        yield _written(*writing.popleft())
                    if interrupted():
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            stopped = True
        while writing:
            yield _written(*writing.popleft())
        if stopped:
            raise KeyboardInterrupt


def _is_file(source: Source) -> bool:
    return source.path is not None and not source.status


def _bytes_of(decoded: Decoded) -> int:
    return 0 if decoded.image is None else decoded.image.pixels.nbytes


def _group(
    decoded: Iterable[Decoded], may_join: Callable[[list[EncodedImage], EncodedImage], bool]
) -> Iterator[list[Decoded]]:
    """Collect consecutive images that may be worked on together.

    Images without work stay in the group, so that the order of the images is kept.
    """
    group: list[Decoded] = []
    images: list[EncodedImage] = []
    for item in decoded:
        if item.image is not None and images and not may_join(images, item.image):
            yield group
            group, images = [], []
        group.append(item)
        if item.image is not None:
            images.append(item.image)
        elif not images:
            yield group
            group = []
    if group:
        yield group


def _work_on(group: list[Decoded], work: Work) -> Iterator[tuple[Finished, Gaussians | None]]:
    """Yield the rows of a group, with the Gaussians to write."""
    outcomes = work([item.image for item in group if item.image is not None])
    for source, image, may_pass in group:
        if image is None:
            yield Finished(source.place, source.row, may_pass), None
            continue
        gaussians, result, figures = next(outcomes)
        height, width = image.pixels.shape[:2]
        row = replace(source.row, width=width, height=height, result=result, **figures)
        if gaussians is None:
            row = _failed(row, source, row.error)
        else:
            row = replace(row, status="done", gaussians=len(gaussians))
        yield Finished(source.place, row), gaussians


def _failed(row: ImageRow, source: Source, reason: str) -> ImageRow:
    return replace(row, status="failed", error=f"{source.path or source.name}: {reason}")


def _write(
    pool: ThreadPoolExecutor, output: Path | None, gaussians: Gaussians | None
) -> Future[None] | None:
    """Start to write a set; the thread that calls this owns all work of Dr.Jit."""
    if output is None or gaussians is None:
        return None
    return pool.submit(write, output, gaussians.data())


def _are_many(writing: deque[Writing]) -> bool:
    rows = [item.row for item, _ in writing]
    pixels = sum((row.width or 0) * (row.height or 0) for row in rows)
    return len(writing) > MAX_WRITING or pixels > MAX_WRITING_PIXELS


def _is_written(entry: Writing) -> bool:
    return entry[1] is None or entry[1].done()


def _written(finished: Finished, future: Future[None] | None) -> Finished:
    """Wait for the file of a result; a file that cannot be written is an error of the image."""
    try:
        if future:
            future.result()
    except OSError as error:
        named = str(error) if error.filename is None else f"{error.filename}: {error.strerror}"
        row = replace(finished.row, status="failed", error=named)
        return Finished(finished.place, row, may_pass=True)
    return finished


# ---------------------------------------------------------------------------------------------
#  On the workers of a cluster: chunks of images
# ---------------------------------------------------------------------------------------------

MAX_CHUNK_WORK = 1 << 27
"""Pixels times steps of a chunk, for some seconds; the bytes of a file stand for its pixels. A task
costs Dask some milliseconds, and a lost worker loses half a chunk on average."""

MAX_CHUNK = 256
"""Images of the largest chunk."""

FIRST_STEPS = 10
"""Steps of gradient descent that take as long as what comes before the first one."""

URL_SIZE = 1 << 16
"""Pixels that stand for an image behind a URL, which nothing is known of."""

MAX_CHUNK_BYTES = 1 << 24
"""Bytes of the arrays of a chunk: the scheduler keeps a copy until the chunk is done."""

RETRIES = 2
"""Repetitions of an image whose failure may pass: a full disk, a network."""

Chunk = list[Source]
"""Images for one task, with absolute paths."""


def run_on_workers(
    sources: Iterable[Source], job: Job, executor: Executor, total: int | None, keep: bool
) -> Generator[Finished, None, None]:
    """Work on images by an executor.

    Parameters
    ----------
    sources, job
        See `run_job`.
    executor : Executor
    total : int or None
        Number of images, if it is known.
    keep : bool
        Whether results travel back.

    Yields
    ------
    Finished
        One for each image, in any order. An image whose failure may pass is repeated up to
        `RETRIES` times. If a chunk ends its worker, its images are repeated one by one, so that an
        image fails for its own fault only.

    Raises
    ------
    ClusterError
        If the cluster is lost.
    """
    named: dict[int, Source] = {}  # the images as the user named them, by place
    passed, again, tries = deque[Finished](), deque[Source](), Counter[int]()
    under_way: dict[int, Chunk] = {}

    def begin(chunks: Iterable[Chunk]) -> Iterator[Chunk]:
        for index, chunk in enumerate(chunks):
            under_way[index] = chunk
            yield chunk

    tasks: Iterable[Chunk] = _cut(sources, job, _longest(total, executor.workers), named, passed)
    at_once = None
    while True:
        with closing(executor.map(run_chunk, begin(tasks), (job, keep), at_once)) as ended:
            for index, result, lost in ended:
                chunk = under_way.pop(index)
                if lost and len(chunk) > 1:
                    again.extend(chunk)
                elif lost:
                    source = named.pop(chunk[0].place)
                    yield Finished(source.place, _failed(source.row, source, lost))
                else:
                    finished, notes = result
                    for note in notes:
                        warn(note)
                    for source, (place, row, may_pass) in zip(chunk, finished, strict=True):
                        tries[place] += 1
                        if may_pass and tries[place] <= RETRIES:
                            again.append(source)
                            continue
                        own = named.pop(place)
                        yield Finished(place, replace(row, input=own.path, output=own.output))
                while passed:
                    yield passed.popleft()
        yield from passed
        passed.clear()
        if not again:
            return
        tasks, at_once = [[source] for source in again], 1
        again.clear()


def run_chunk(chunk: Chunk, shared: tuple[Job, bool]) -> tuple[list[Finished], list[str]]:
    """Work on the images of a chunk, on a worker; return what became of them, and its warnings."""
    job, keep = shared
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        finished = [
            entry if keep else entry._replace(row=replace(entry.row, result=None))
            for entry in run_job(chunk, job)
        ]
    return finished, [str(n.message) for n in caught if issubclass(n.category, UserWarning)]


def _longest(total: int | None, workers: int) -> Callable[[int], int]:
    """Return the most images of a chunk, after some were drawn.

    The last chunks are shorter, so that all workers end at about the same time.
    """
    if total is None:
        return lambda drawn: MAX_CHUNK
    return lambda drawn: min(MAX_CHUNK, max(1, (total - drawn) // (2 * workers)))


def _cut(
    sources: Iterable[Source],
    job: Job,
    longest: Callable[[int], int],
    named: dict[int, Source],
    passed: deque[Finished],
) -> Iterator[Chunk]:
    """Cut the images into chunks; those without work pass by."""
    chunk, held, work, most = list[Source](), 0, 0, longest(0)
    for drawn, source in enumerate(sources, 1):
        if source.status:
            passed.append(Finished(source.place, source.row))
            continue
        named[source.place] = source
        if source.path is None:
            # A copy, as its owner may reuse it; light stays light.
            source = source._replace(image=np.array(source.image, subok=True))
            held += source.image.nbytes
        chunk.append(_absolute(source))
        work += _size_of(source) * (FIRST_STEPS + job.steps)
        if len(chunk) >= most or work >= MAX_CHUNK_WORK or held >= MAX_CHUNK_BYTES:
            yield chunk
            chunk, held, work, most = [], 0, 0, longest(drawn)
    if chunk:
        yield chunk


def _size_of(source: Source) -> int:
    """Return the pixels of an array, or the bytes of a file."""
    if source.path is None:
        return int(math.prod(np.shape(source.image)[:2]))
    if isinstance(source.path, str):
        return URL_SIZE
    try:
        return source.path.stat().st_size
    except OSError:  # the worker says what is wrong with it
        return 0


def _absolute(source: Source) -> Source:
    """Name files from the root: a worker runs in another folder."""
    image = source.image.absolute() if isinstance(source.image, Path) else source.image
    output = None if source.output is None else Path(os.path.abspath(source.output))
    return source._replace(image=image, output=output)
