"""The images of a run: their names, their outputs and their pixels."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..gaussian.file import read_head
from ..image import io
from ..image.folder import image_files
from ..image.pixels import EncodedImage
from ..image.remote import is_url, list_urls, stem_of
from ..storage.atomic import refuse_url, require_writable
from .manifest import ImageRow, Manifest

Images = str | os.PathLike[str] | Iterable[str | os.PathLike[str] | ArrayLike]
"""A folder, a glob, a URL of one of them, or any iterable of image files, their URLs and arrays."""


class Source(NamedTuple):
    """One image of a run.

    Attributes
    ----------
    name : str
        Stem of the file, or the number of the array with six digits.
    image : Path, str or array_like
        A file, a URL, or the pixels.
    output : Path or None
        The file of the result; None keeps the result in memory.
    status : str
        "skipped" or "failed" if the image needs no work; else empty.
    error : str
        Why the status is "failed".
    place : int
        Place among the images of the run, from 0.
    figures : dict
        Attributes of the `ImageRow` of a skipped image.
    """

    name: str
    image: Any
    output: Path | None = None
    status: str = ""
    error: str = ""
    place: int = 0
    figures: dict[str, Any] = {}  # noqa: RUF012  # never changed

    @property
    def path(self) -> Path | str | None:
        """The file or the URL of the image; None for an array."""
        return self.image if isinstance(self.image, (Path, str)) else None

    @property
    def row(self) -> ImageRow:
        """The row of the image before the work."""
        known = self.name, self.status, self.path, self.output
        return ImageRow(*known, error=self.error, **self.figures)


def list_sources(images: Images) -> Iterable[Source]:
    """Name the images of a run.

    Parameters
    ----------
    images : path-like or iterable
        A folder, a glob such as ``"photos/**/*.jpg"``, or a URL of a folder, a glob or a file; or
        an iterable of files, of URLs and of arrays, see `eigengs_dr.image.io.check_image`.

    Returns
    -------
    iterable of Source
        A list, if `images` has a length; else an iterator that reads `images` when it is read. In
        an iterator, an image whose name is taken has the status "failed".

    Raises
    ------
    ValueError
        If two images have one name, there is no image, or `images` is one array of one image.
    """
    if isinstance(images, (str, os.PathLike)):
        images = list_files(images)
    if isinstance(images, np.ndarray) and (images.ndim < 3 or images.shape[2:] in ((1,), (3,))):
        raise ValueError(f"images: found one array of shape {images.shape}; pass a list of images")
    if not isinstance(images, (Sequence, np.ndarray)):
        return _name_each(images)
    if len(images) == 0:
        raise ValueError("images: found none; pass at least one image")
    sources = list(_name_each(images))
    for source in sources:
        if source.error:
            raise ValueError(source.error)
    return sources


def list_files(images: str | os.PathLike[str]) -> Sequence[str | Path]:
    """List the images of a folder, a glob or a URL.

    Parameters
    ----------
    images : path-like
        See `list_sources`.

    Returns
    -------
    sequence of Path or str
        Files or URLs, sorted by name.

    Raises
    ------
    ValueError
        If there is none.
    """
    if is_url(images):
        return list_urls(str(images))
    if glob.has_magic(os.fspath(images)) and not os.path.exists(images):
        files = sorted(Path(name) for name in glob.glob(os.fspath(images), recursive=True))
        if not files:
            raise ValueError(f"{images}: no file has such a name; check the pattern")
        return files
    return image_files(Path(images))


def _name_each(images: Iterable[Any]) -> Iterator[Source]:
    """Name images one by one; a name that is taken is an error of the image."""
    taken = dict[str, Any]()
    for number, image in enumerate(images):
        is_file = isinstance(image, (str, os.PathLike))
        item = Path(image) if is_file and not is_url(image) else image
        name = stem_of(item) if is_file else f"{number:06d}"
        if name in taken:
            error = f"{item if is_file else name}: {taken[name]} has this name too; rename one"
            yield Source(name, item, status="failed", error=error, place=number)
            continue
        taken[name] = item if is_file else f"image {number}"
        yield Source(name, item, place=number)


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
    output.mkdir(parents=True, exist_ok=True)
    require_writable(output / "probe.npz")
    return output


def plan_output(source: Source, manifest: Manifest, overwrite: bool) -> Source:
    """Give a source its output file, and skip it if the file is its result.

    Parameters
    ----------
    source : Source
    manifest : Manifest
        The manifest of the output folder.
    overwrite : bool
        Do images again whose result exists. A file that holds something else, such as a basis, is
        never replaced.
    """
    if source.status:
        return source
    output = manifest.output(source.name)
    planned = source._replace(output=output)
    if not output.exists():
        return planned
    row = manifest.rows.get(source.name, {})
    if row.get("status") == "done" and not overwrite:
        return planned._replace(status="skipped", figures=_figures(row))
    try:
        head = read_head(output)
    except (ValueError, OSError):
        error = f"{output}: exists and is no set of Gaussians; move it, or use another folder"
        return planned._replace(status="failed", error=error)
    if overwrite or row.get("status") == "failed":
        return planned
    width, height = head.size
    figures = {"width": width, "height": height, "gaussians": head.gaussians}
    return planned._replace(status="skipped", figures=figures)


def _figures(row: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a row of a manifest, which may come from another version."""
    names = ("width", "height", "gaussians", "psnr_ycbcr", "psnr_rgb", "seconds", "iterations")
    return {name: row.get(name) for name in names}


class Decoded(NamedTuple):
    """An image that was read.

    Attributes
    ----------
    source : Source
        With the status "failed" and the error if the image cannot be read.
    image : EncodedImage or None
        Pixels (H, W, C) of float32, and what they are; None if the source needs no work.
    may_pass : bool
        Whether the failure may pass: the network did not bring the image.
    """

    source: Source
    image: EncodedImage | None = None
    may_pass: bool = False


def decode(source: Source, keep_grey: bool, encoding: str | None) -> Decoded:
    """Read one image, or note why it cannot be read.

    Parameters
    ----------
    source : Source
        An array is copied: its owner may overwrite it.
    keep_grey : bool
        Whether the images are data, which keep one channel.
    encoding : {"srgb", "linear"} or None
        What the pixels are, see `eigengs_dr.image.io.check_image`.
    """
    if source.status:
        return Decoded(source)
    try:
        if keep_grey:
            return Decoded(source, EncodedImage(io.check_data(source.image), "srgb"))
        return Decoded(source, io.read_floats(source.image, encoding=encoding))
    except io.ImageError as error:
        text = str(error) if source.path else f"{source.name}: {str(error).removeprefix('image: ')}"
        return Decoded(source._replace(status="failed", error=text))
    except OSError as error:
        return Decoded(source._replace(status="failed", error=str(error)), may_pass=True)
