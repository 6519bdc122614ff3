"""The loop over many images: groups of images are worked on, each image has a row of results."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.interrupt import defer_interrupts
from ..gaussian.file import SetData, write
from ..gaussian.gaussians import Gaussians
from .read_ahead import Decoded, read_ahead
from .sources import Images, list_sources, make_folder, plan_output

WRITERS = 2
"""Threads that compress and write results: 5,000 Gaussians take 6 ms."""

MAX_WRITING, MAX_WRITING_BYTES = 32, 1 << 26
"""Largest number of results that wait for their file, and bytes of their images."""

FAILURES = (ValueError, OSError, MemoryError)
"""Errors of one image, which do not end the run."""

Pixels = NDArray[np.float32]


@dataclass(frozen=True)
class ImageRow:
    """What became of one of many images.

    Attributes
    ----------
    name : str
        Stem of the file, or the number of the array with six digits.
    status : str
        "done", "skipped" because the output exists, or "failed".
    input, output : Path or None
        The image file and the file of the result, if there are such files.
    width, height, gaussians : int or None
        Size of the image in pixels, and the number of Gaussians.
    psnr_ycbcr, psnr_rgb : float or None
        PSNR of the fit in dB, see `eigengs_dr.Fit`; None for encoded images.
    seconds : float or None
        Time of the work on the image, without reading and writing; None if it was not done. Images
        in one group share their time.
    error : str
        One line that names the image and the reason, if the status is "failed".
    result : Fit, Gaussians or None
        The result, if there is no output folder.
    """

    name: str
    status: str
    input: Path | None = None
    output: Path | None = None
    width: int | None = None
    height: int | None = None
    gaussians: int | None = None
    psnr_ycbcr: float | None = None
    psnr_rgb: float | None = None
    seconds: float | None = None
    error: str = ""
    result: Any = field(default=None, repr=False)


RowProgress = Callable[[int, int | None, ImageRow], None]
"""``progress(done, total, row)`` after every image; the total is None if it is unknown."""


class RunInterrupted(KeyboardInterrupt):
    """The error of a run over many images that Ctrl-C or SIGTERM interrupted.

    Attributes
    ----------
    rows : list of ImageRow
        The images until then. The image that was interrupted has no row and no file.
    """

    def __init__(self, rows: list[ImageRow]) -> None:
        super().__init__(f"interrupted after {len(rows)} images; .rows holds their results")
        self.rows = rows


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


class Finished(NamedTuple):
    """An image whose result, if any, is written.

    Attributes
    ----------
    row : ImageRow
        With the result, whether or not there is an output folder.
    pixels : ndarray of float32, shape (H, W, C), or None
    """

    row: ImageRow
    pixels: Pixels | None


Writing = tuple[Finished, Future[None] | None]
"""An image, and its file if that is being written."""

Work = Callable[[list[Pixels]], Iterator[Outcome]]
"""``work(images)`` yields the outcome of every image of a group, in order."""

MayJoin = Callable[[list[Pixels], Pixels], bool]
"""``may_join(group, pixels)``: whether an image may join a group that is not empty."""


def run_images(
    images: Images,
    output: Path | None,
    overwrite: bool,
    keep_grey: bool,
    work: Work,
    may_join: MayJoin,
) -> tuple[int | None, Generator[Finished, None, None]]:
    """Prepare a run; see `eigengs_dr.fit_many` for arguments and errors.

    Returns
    -------
    total : int or None
        Number of images, if it is known.
    finished : generator of Finished
        One for each image, in order. Results are written before they are yielded.
    """
    sources = list_sources(images)
    total = len(sources) if isinstance(sources, list) else None
    if output is not None:
        make_folder(output)
        sources = (plan_output(source, output, overwrite) for source in sources)
    return total, _run(read_ahead(sources, keep_grey), work, may_join)


def collect(
    total: int | None,
    finished: Generator[Finished, None, None],
    keep_results: bool,
    progress: RowProgress | None,
) -> list[ImageRow]:
    """Return the rows of a run.

    Raises
    ------
    RunInterrupted
        If the run, or `progress`, raises `KeyboardInterrupt`.
    """
    rows = list[ImageRow]()
    try:
        with closing(finished):
            for row, _ in finished:
                rows.append(row if keep_results else replace(row, result=None))
                if progress:
                    progress(len(rows), total, rows[-1])
    except KeyboardInterrupt:
        raise RunInterrupted(rows) from None
    return rows


def _run(
    decoded: Generator[Decoded, None, None], work: Work, may_join: MayJoin
) -> Generator[Finished, None, None]:
    """Work on groups of images, and write each result while the next ones are computed."""
    writing: deque[Writing] = deque()
    with (
        closing(decoded),
        ThreadPoolExecutor(WRITERS, thread_name_prefix="write") as pool,
        defer_interrupts() as interrupted,
    ):
        stopped = False
        try:
            for group in _group(decoded, may_join):
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
    for source, pixels in group:
        row = ImageRow(source.name, source.status, source.path, source.output, error=source.error)
        if pixels is None:
            yield Finished(row, None), None
            continue
        gaussians, result, figures = next(outcomes)
        height, width = pixels.shape[:2]
        row = replace(row, width=width, height=height, result=result, **figures)
        if gaussians is None:
            error = f"{source.path or source.name}: {row.error}"
            yield Finished(replace(row, status="failed", error=error), pixels), None
        else:
            done = replace(row, status="done", gaussians=len(gaussians))
            yield Finished(done, pixels), gaussians


def _write(
    pool: ThreadPoolExecutor, output: Path | None, gaussians: Gaussians | None
) -> Future[None] | None:
    """Start to write a set; the thread that calls this owns all work of Dr.Jit."""
    if output is None or gaussians is None:
        return None
    size = (gaussians.width, gaussians.height)
    data = SetData(gaussians.to_arrays(), size, gaussians.space, gaussians.cutoff)
    return pool.submit(write, output, data)


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
        return finished._replace(row=replace(finished.row, status="failed", error=named))
    return finished
