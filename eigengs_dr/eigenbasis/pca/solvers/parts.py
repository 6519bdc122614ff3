"""Parts of a source that workers read, and what is said of them."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....image.io import ImageError
from ....image.remote import is_url
from ..lazy_images import LazyImages

Images = Sequence[Any] | NDArray[Any] | LazyImages
"""Files or single images, one array of images, or a lazy one."""


def is_countable(source: Any) -> bool:
    """Whether a source is a sequence of files or of single images, which can be cut in parts."""
    if isinstance(source, np.ndarray):
        return source.ndim == 4 or (source.ndim == 3 and source.shape[2] not in (1, 3))
    if isinstance(source, LazyImages):
        return True
    return isinstance(source, Sequence) and all(
        isinstance(item, (str, os.PathLike)) or getattr(item, "shape", ())[2:] in ((1,), (3,))
        for item in source
    )


def absolute(images: Images) -> Images:
    """Name files from the root: a worker runs in another folder."""
    if not isinstance(images, Sequence):
        return images
    is_file = (str, os.PathLike)
    return [
        Path(item).absolute() if isinstance(item, is_file) and not is_url(item) else item
        for item in images
    ]


def readable(images: Images) -> Any:
    """Return a source for `eigengs_dr.image.folder.read_blocks`."""
    return images.arrays() if isinstance(images, LazyImages) else images


@contextmanager
def collect_notes(source: Any) -> Iterator[list[str]]:
    """Collect the warnings of a block that reads a part of the images.

    Parameters
    ----------
    source : Any
        What is read. Files of which none can be read are a note too; a wrong array is an error.

    Yields
    ------
    list of str
        Filled at the end of the block.

    Raises
    ------
    ImageError
        If the source is an array of something else than images.
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
