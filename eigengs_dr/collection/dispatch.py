"""The images of a run on the workers of a cluster, a chunk of images a task.

A worker reads its images, writes their results and returns their rows. What the images are decides
the chunks, never how long they took, so that a run repeats itself.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..backend.executor import Executor, executor_for
from ..backend.feedback import warn
from ..backend.recording import exclusive
from ..fitting.fit import Fit
from ..gaussian.file import SetData
from ..gaussian.gaussians import Gaussians
from .manifest import Finished, Manifest
from .run import Job, row_of, run_job
from .sources import Images, Source, list_sources, make_folder, plan_output

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


class Chunk(NamedTuple):
    """Images for one task.

    Attributes
    ----------
    sources : list of Source
        With absolute paths.
    keep_results : bool
        Whether the results travel back.
    """

    sources: list[Source]
    keep_results: bool


class ChunkResult(NamedTuple):
    """What a worker returns for a chunk: an entry for each image, and its warnings."""

    finished: list[Finished]
    notes: list[str]


def run_chunk(chunk: Chunk, job: Job) -> ChunkResult:
    """Work on the images of a chunk; this function runs on a worker.

    Parameters
    ----------
    chunk : Chunk
    job : Job

    Returns
    -------
    ChunkResult
        Results of Dr.Jit as NumPy arrays, and no pixels.
    """
    finished = list[Finished]()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        for entry in run_job(chunk.sources, job):
            result = _to_arrays(entry.row.result) if chunk.keep_results else None
            finished.append(entry._replace(row=replace(entry.row, result=result), pixels=None))
    notes = [str(note.message) for note in caught if issubclass(note.category, UserWarning)]
    return ChunkResult(finished, notes)


def dispatch(
    sources: Iterable[Source],
    job: Job,
    executor: Executor,
    start: Callable[[list[str]], None],
    total: int | None,
    keep_results: bool,
) -> Generator[Finished, None, None]:
    """Work on images by an executor.

    Parameters
    ----------
    sources, job
        See `eigengs_dr.collection.run.run_job`.
    executor : Executor
    start : callable
        ``start(names)`` before images travel to a worker.
    total : int or None
        Number of images, if it is known.
    keep_results : bool
        Whether `ImageRow.result` holds the result.

    Yields
    ------
    Finished
        One for each image, in any order, without pixels. An image whose failure may pass is
        repeated up to `RETRIES` times. If a chunk ends its worker, its images are repeated one by
        one, so that an image fails for its own fault only.

    Raises
    ------
    ClusterError
        If the cluster is lost.
    """
    chunks = _Chunks(sources, total, executor.workers, start, keep_results, job.steps)
    again = deque[Source]()
    tries = Counter[int]()

    def settle(chunk: Chunk, result: ChunkResult) -> Iterator[Finished]:
        for note in result.notes:
            warn(note)
        for source, entry in zip(chunk.sources, result.finished, strict=True):
            tries[source.place] += 1
            if entry.may_pass and tries[source.place] <= RETRIES:
                again.append(source)
            else:
                yield _received(entry, chunks.named.pop(source.place))

    with closing(executor.map(run_chunk, chunks, job)) as done:
        for index, result, lost in done:
            chunk = chunks.under_way.pop(index)
            if lost and len(chunk.sources) == 1:
                yield _lost(chunks.named.pop(chunk.sources[0].place), lost)
            elif lost:
                again.extend(chunk.sources)
            else:
                yield from settle(chunk, result)
            yield from chunks.without_work()
    yield from chunks.without_work()
    while again:
        singles = [Chunk([source], keep_results) for source in again]
        again.clear()
        with closing(executor.map(run_chunk, singles, job, at_once=1)) as done:
            for index, result, lost in done:
                chunk = singles[index]
                if lost:
                    yield _lost(chunks.named.pop(chunk.sources[0].place), lost)
                else:
                    yield from settle(chunk, result)


@dataclass(eq=False)
class _Chunks:
    """An iterator of chunks, which the executor draws when workers become free."""

    sources: Iterable[Source]
    total: int | None
    workers: int
    start: Callable[[list[str]], None]
    keep_results: bool
    steps: int

    def __post_init__(self) -> None:
        self.under_way: dict[int, Chunk] = {}
        self.named: dict[int, Source] = {}  # the sources as the user named them, by place
        self._passed = deque[Source]()
        self._begun = 0

    def __iter__(self) -> Iterator[Chunk]:
        chunk, held, work, most = list[Source](), 0, 0, self._most(0)
        for drawn, source in enumerate(self.sources, 1):
            if source.status:
                self._passed.append(source)
                continue
            if source.path is None:
                # A copy, as its owner may reuse it; light stays light.
                source = source._replace(image=np.array(source.image, subok=True))
                held += source.image.nbytes
            chunk.append(source)
            work += _size_of(source) * (FIRST_STEPS + self.steps)
            if len(chunk) >= most or work >= MAX_CHUNK_WORK or held >= MAX_CHUNK_BYTES:
                yield self._begin(chunk)
                chunk, held, work, most = [], 0, 0, self._most(drawn)
        if chunk:
            yield self._begin(chunk)

    def without_work(self) -> Iterator[Finished]:
        """Yield the images that were drawn and need no work."""
        while self._passed:
            source = self._passed.popleft()
            yield Finished(row_of(source), place=source.place)

    def _most(self, drawn: int) -> int:
        """Return the most images of a chunk, after some were drawn.

        The last chunks are shorter, so that all workers end at about the same time.
        """
        if self.total is None:
            return MAX_CHUNK
        return min(MAX_CHUNK, max(1, (self.total - drawn) // (2 * self.workers)))

    def _begin(self, sources: list[Source]) -> Chunk:
        self.start([source.name for source in sources])
        self.named.update({source.place: source for source in sources})
        chunk = Chunk([_absolute(source) for source in sources], self.keep_results)
        self.under_way[self._begun] = chunk
        self._begun += 1
        return chunk


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


def _received(entry: Finished, source: Source) -> Finished:
    """Return what a worker sent, with the names that the user gave."""
    result = _from_arrays(entry.row.result)
    row = replace(entry.row, input=source.path, output=source.output, result=result)
    return Finished(row, place=source.place)


def _lost(source: Source, reason: str) -> Finished:
    row = replace(row_of(source), status="failed", error=f"{source.path or source.name}: {reason}")
    return Finished(row, place=source.place)


def _to_arrays(result: Any) -> Any:
    """Replace the sets of a result by NumPy arrays."""
    if isinstance(result, Fit):
        return replace(result, gaussians=_to_arrays(result.gaussians))
    if isinstance(result, Gaussians):
        return result.data()
    return result


@exclusive()
def _from_arrays(result: Any) -> Any:
    """Undo `_to_arrays`."""
    if isinstance(result, Fit):
        return replace(result, gaussians=_from_arrays(result.gaussians))
    if isinstance(result, SetData):
        return Gaussians.from_data(result)
    return result


Loop = Callable[..., Generator[Finished, None, None]]
"""``loop(sources, job, start=start)`` yields an entry for each source."""


def run_images(
    images: Images,
    output: str | os.PathLike[str] | None,
    overwrite: bool,
    job: Job,
    client: Any = None,
) -> tuple[int | None, Generator[Finished, None, None]]:
    """Prepare a run; see `eigengs_dr.fit_many` for arguments and errors.

    Returns
    -------
    total : int or None
        Number of images, if it is known.
    finished : generator of Finished
        One for each image, whose result is written before. In this process they are in order.
    """
    sources = list_sources(images)
    total = len(sources) if isinstance(sources, list) else None
    loop: Loop = run_job
    if client is None:
        _ = job.work  # what is wrong with the options is said before the work
    else:
        loop = partial(
            dispatch, executor=executor_for(client), total=total, keep_results=output is None
        )
    if output is None:
        return total, loop(sources, job, start=lambda names: None)
    return total, _recorded(sources, job, make_folder(output), overwrite, loop)


def _recorded(
    sources: Iterable[Source], job: Job, output: Path, overwrite: bool, loop: Loop
) -> Generator[Finished, None, None]:
    """Leave out what the manifest says is done, and record the rest in it."""
    with Manifest(output) as manifest:
        planned = (plan_output(source, manifest, overwrite) for source in sources)
        with closing(loop(planned, job, start=manifest.start)) as finished:
            for entry in finished:
                manifest.add(entry.row)
                yield entry
