"""The loop over many images: groups of images are worked on, each image has a row of results."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ..backend.feedback import defer_interrupts
from ..gaussian.file import write
from ..gaussian.gaussians import Gaussians
from .manifest import Finished, ImageRow, Outcome, Pixels
from .sources import Decoded, Source, read_ahead

WRITERS = 2
"""Threads that compress and write results: 5,000 Gaussians take 6 ms."""

MAX_WRITING, MAX_WRITING_BYTES = 32, 1 << 26
"""Largest number of results that wait for their file, and bytes of their images."""

FAILURES = (ValueError, OSError, MemoryError)
"""Errors of one image, which do not end the run."""

Writing = tuple[Finished, Future[None] | None]
"""An image, and its file if that is being written."""

Work = Callable[[list[Pixels]], Iterator[Outcome]]
"""``work(images)`` yields the outcome of every image of a group, in order."""

MayJoin = Callable[[list[Pixels], Pixels], bool]
"""``may_join(group, pixels)``: whether an image may join a group that is not empty."""


@dataclass(frozen=True)
class Job:
    """What a run does with its images. It can travel to the workers of a cluster.

    Attributes
    ----------
    make_work : callable
        Returns the `Work`. It is called once in each process.
    may_join : callable
        See `MayJoin`.
    keep_grey, encoding
        See `eigengs_dr.image.io.load_image`.
    steps
        Steps of gradient descent of an image: how much work it is.
    """

    make_work: Callable[[], Work]
    may_join: MayJoin
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


def run_job(
    sources: Iterable[Source], job: Job, start: Callable[[list[str]], None] = lambda names: None
) -> Generator[Finished, None, None]:
    """Work on groups of images, and write each result while the next ones are computed.

    Parameters
    ----------
    sources : iterable of Source
        With their output files.
    job : Job
    start : callable, optional
        ``start(names)`` before the work on the images of a group.

    Yields
    ------
    Finished
        One for each image, in order. Its result is written before.

    Raises
    ------
    KeyboardInterrupt
        After Ctrl-C or SIGTERM, when all results are written and yielded.
    """
    work, writing = job.work, deque[Writing]()
    with (
        closing(read_ahead(sources, job.keep_grey, job.encoding)) as decoded,
        ThreadPoolExecutor(WRITERS, thread_name_prefix="write") as pool,
        defer_interrupts() as interrupted,
    ):
        stopped = False
        try:
            for group in _group(decoded, job.may_join):
                start([item.source.name for item in group if item.pixels is not None])
                for finished, gaussians in _work_on(group, work):
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


def _group(decoded: Iterable[Decoded], may_join: MayJoin) -> Iterator[list[Decoded]]:
    """Collect consecutive images that may be worked on together.

    Images without work stay in the group, so that the order of the images is kept.
    """
    group, images = list[Decoded](), list[Pixels]()
    for item in decoded:
        if item.pixels is not None and images and not may_join(images, item.pixels):
            yield group
            group, images = [], []
        group.append(item)
        if item.pixels is not None:
            images.append(item.pixels)
        elif not images:
            yield group
            group = []
    if group:
        yield group


def _work_on(group: list[Decoded], work: Work) -> Iterator[tuple[Finished, Gaussians | None]]:
    """Yield the rows of a group, with the Gaussians to write."""
    outcomes = work([item.pixels for item in group if item.pixels is not None])
    for source, pixels, may_pass in group:
        row = row_of(source)
        if pixels is None:
            yield Finished(row, None, source.place, may_pass), None
            continue
        gaussians, result, figures = next(outcomes)
        height, width = pixels.shape[:2]
        row = replace(row, width=width, height=height, result=result, **figures)
        if gaussians is None:
            error = f"{source.path or source.name}: {row.error}"
            yield Finished(replace(row, status="failed", error=error), pixels, source.place), None
        else:
            done = replace(row, status="done", gaussians=len(gaussians))
            yield Finished(done, pixels, source.place), gaussians


def row_of(source: Source) -> ImageRow:
    """Return the row of an image before the work."""
    return ImageRow(
        source.name,
        source.status,
        source.path,
        source.output,
        error=source.error,
        **source.figures,
    )


def _write(
    pool: ThreadPoolExecutor, output: Path | None, gaussians: Gaussians | None
) -> Future[None] | None:
    """Start to write a set; the thread that calls this owns all work of Dr.Jit."""
    if output is None or gaussians is None:
        return None
    return pool.submit(write, output, gaussians.data())


def _are_many(writing: deque[Writing]) -> bool:
    held = sum(0 if item.pixels is None else item.pixels.nbytes for item, _ in writing)
    return len(writing) > MAX_WRITING or held > MAX_WRITING_BYTES


def _is_written(entry: Writing) -> bool:
    return entry[1] is None or entry[1].done()


def _written(finished: Finished, future: Future[None] | None) -> Finished:
    """Wait for the file of a result; a file that cannot be written is an error of the image."""
    try:
        if future:
            future.result()
    except OSError as error:
        named = str(error) if error.filename is None else f"{error.filename}: {error.strerror}"
        failed = replace(finished.row, status="failed", error=named)
        return finished._replace(row=failed, may_pass=True)
    return finished
