"""The images of a run: their names, their outputs and their pixels."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import is_zipfile

import numpy as np

from ..backend.types import ArrayLike, Record
from ..gaussian.file import read_figures, read_head
from ..image.folder import list_images
from ..image.remote import is_url, stem_of
from .manifest import ImageRow, Manifest

Images = str | os.PathLike[str] | Iterable[str | os.PathLike[str] | ArrayLike]
"""A folder, a glob, a URL of one of them, or an iterable of image files, URLs and arrays."""


class RunImage(NamedTuple):
    """One image of a run.

    Attributes
    ----------
    place : int
        Index in the run, from 0.
    name : str
        Stem of the file, or the index of the array with six digits.
    image : Path, str or array_like
        A file, a URL, or the pixels.
    output : Path or None
        The file of the result; None keeps the result in memory.
    error : str
        Reason why the image cannot be processed.
    """

    place: int
    name: str
    image: Any
    output: Path | None = None
    error: str = ""

    @property
    def path(self) -> Path | str | None:
        """The file or the URL of the image; None for an array."""
        return self.image if isinstance(self.image, (Path, str)) else None

    def row(self, status: str, **figures: Any) -> ImageRow:
        """Return a row for the image."""
        return ImageRow(self.name, status, self.path, self.output, **figures)


def list_sources(images: Images, recursive: bool = False) -> Iterable[RunImage]:
    """Name the images of a run.

    Parameters
    ----------
    images : path-like or iterable
        A folder, a glob such as ``"photos/**/*.jpg"``, or a URL of a folder, a glob or a file; or
        an iterable of files, URLs and arrays, see `eigengs_dr.image.io.check_image`.
    recursive : bool, optional
        Whether to take images in the subfolders of a folder too.

    Returns
    -------
    iterable of RunImage
        A list if `images` has a length, otherwise a lazy iterator. In an iterator, an image whose
        name is already used has an error.

    Raises
    ------
    ValueError
        If two images have the same name, there is no image, or `images` is the array of one image;
        if they should be recursive and are no folder.
    """
    if isinstance(images, (str, os.PathLike)):
        images = list_images(images, recursive)
    elif recursive:
        raise ValueError("recursive is for a folder; the images are given one by one")
    if isinstance(images, np.ndarray) and (images.ndim < 3 or images.shape[2:] in ((1,), (3,))):
        raise ValueError(f"images: got one array of shape {images.shape}; pass a list of images")
    if not isinstance(images, (Sequence, np.ndarray)):
        return _name_each(images)
    if len(images) == 0:
        raise ValueError("images: got none; pass at least one image")
    sources = list(_name_each(images))
    for source in sources:
        if source.error:
            raise ValueError(source.error)
    return sources


def _name_each(images: Iterable) -> Iterator[RunImage]:
    """Name images one by one; a name that is already used is an error of the image."""
    taken: Record = {}
    for place, image in enumerate(images):
        is_file = isinstance(image, (str, os.PathLike))
        item = Path(image) if is_file and not is_url(image) else image
        name = stem_of(item) if is_file else f"{place:06d}"
        error = ""
        if name in taken:
            error = f"{item if is_file else name}: {taken[name]} has this name too; rename one"
        taken.setdefault(name, item if is_file else f"image {place}")
        yield RunImage(place, name, item, error=error)


def plan_output(source: RunImage, manifest: Manifest, overwrite: bool) -> RunImage | ImageRow:
    """Assign its output file to a source, or return its row if there is no work on it.

    Parameters
    ----------
    source : RunImage
    manifest : Manifest
        The manifest of the output folder.
    overwrite : bool
        Process images again whose result exists. A file of another kind, such as a basis, is never
        replaced.
    """
    output = manifest.path.with_name(f"{source.name}.npz")
    source = source._replace(output=output)
    if not os.path.lexists(output):  # a link that leads nowhere is not followed
        return source
    row = manifest.rows.get(source.name, {})
    # Of 100,000 results, whether each is whole is seen at its end, and all are not read again.
    if row.get("status") == "done" and not overwrite and is_zipfile(output):
        names = ("width", "height", "gaussians", "psnr_ycbcr", "psnr_rgb", "seconds", "iterations")
        return source.row("skipped", **{name: row.get(name) for name in names})
    try:
        head = read_head(output)
    except (ValueError, OSError):
        error = f"{output}: exists and is not a set of Gaussians; move it, or use another folder"
        return source.row("failed", error=error)
    if overwrite or row.get("status") == "failed":
        return source
    width, height = head.size
    figures: Record = {"width": width, "height": height, "gaussians": head.gaussians}
    if fit := read_figures(output):
        figures |= {k: v for k, v in fit._asdict().items() if k != "source"}
    return source.row("skipped", **figures)
