"""Images decoded by threads before they are needed, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..image import io
from .sources import Source

THREADS = 2
"""Threads that decode. A 256x256 JPEG takes 1.2 ms to decode, far less than any fit."""

MAX_WAITING = 512
"""Largest number of images that wait in memory."""

MAX_WAITING_BYTES = 1 << 26
"""Bytes of the images that wait in memory, as far as the largest image until then tells. One image
may wait whatever its size."""


class Decoded(NamedTuple):
    """An image that was read.

    Attributes
    ----------
    source : Source
        With the status "failed" and the error if the image cannot be read.
    pixels : ndarray of float32, shape (H, W, C), or None
        None if the source needs no work.
    may_pass : bool
        Whether the failure may pass: the network did not bring the image.
    """

    source: Source
    pixels: NDArray[np.float32] | None = None
    may_pass: bool = False


def read_ahead(
    sources: Iterable[Source], keep_grey: bool, encoding: str | None = None
) -> Generator[Decoded, None, None]:
    """Decode images in threads while the caller works on earlier ones.

    Parameters
    ----------
    sources : iterable of Source
        Files are read in threads. Arrays are copied at once: their owner may overwrite an array
        when the next one is requested.
    keep_grey : bool
        Whether the images are data, which keep one channel.
    encoding : {"srgb", "linear"}, optional
        What the pixels are, see `eigengs_dr.image.io.load_image`.

    Yields
    ------
    Decoded
        In the order of the sources. At most `MAX_WAITING` images and about `MAX_WAITING_BYTES` are
        read ahead.
    """
    pool = ThreadPoolExecutor(THREADS, thread_name_prefix="decode")
    waiting: deque[Future[Decoded]] = deque()
    largest = 0
    try:
        for source in sources:
            waiting.append(_submit(pool, source, keep_grey, encoding))
            while len(waiting) > _max_waiting(largest):
                decoded = waiting.popleft().result()
                largest = max(largest, 0 if decoded.pixels is None else decoded.pixels.nbytes)
                yield decoded
                del decoded  # frees the image before the next one is awaited
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _max_waiting(largest: int) -> int:
    """Return how many images may wait if each has up to `largest` bytes; 0 means unknown."""
    if not largest:
        return THREADS
    return min(max(1, MAX_WAITING_BYTES // largest), MAX_WAITING)


def _submit(
    pool: ThreadPoolExecutor, source: Source, keep_grey: bool, encoding: str | None
) -> Future[Decoded]:
    """Start to read a file; check an array, or pass a source without work on, at once."""
    if source.path is not None and not source.status:
        return pool.submit(_decode, source, keep_grey, encoding)
    done: Future[Decoded] = Future()
    done.set_result(Decoded(source) if source.status else _decode(source, keep_grey, encoding))
    return done


def _decode(source: Source, keep_grey: bool, encoding: str | None) -> Decoded:
    """Read one image, or note why it cannot be read."""
    try:
        if isinstance(source.image, (Path, str)):
            return Decoded(source, io.load_image(source.image, keep_grey, encoding))
        check = io.check_data if keep_grey else partial(io.mark_image, encoding=encoding)
        return Decoded(source, check(source.image))
    except io.ImageError as error:
        text = str(error) if source.path else f"{source.name}: {str(error).removeprefix('image: ')}"
        return Decoded(source._replace(status="failed", error=text))
    except OSError as error:
        return Decoded(source._replace(status="failed", error=str(error)), may_pass=True)
