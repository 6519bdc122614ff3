"""The images of a run, a row for each, and what the files of results say of an earlier run.

Result files are complete or missing, so a run need not fit images again whose file exists. A file
holds a digest of the options of its result, so that a run is only continued with the same options.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from inspect import getclosurevars
from numbers import Real
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..backend.types import Record
from ..fitting.method import Model
from ..fitting.start import set_in
from ..gaussian.file import read_figures, read_head
from ..gaussian.gaussians import Gaussians
from ..image.folder import list_images
from ..image.pixels import URL_NOTE
from ..storage.atomic import is_url


@dataclass(frozen=True)
class ImageRow:
    """An image of a run: the result of one of many, or the state of a large one.

    Attributes
    ----------
    name : str
        Stem of the file, or the index of the array with six digits.
    status : str
        "done", "skipped" because the output exists, or "failed". In the progress of
        `eigengs_dr.fit_large` the stage: "survey", "place", "density", "fit" or "measure".
    input : Path or None
        The image file, if there is one.
    output : Path or None
        The file of the result, if there is one.
    width, height, gaussians : int or None
        Size of the image in pixels, and the number of Gaussians. For a skipped image, the figures
        come from the file of its result.
    psnr_ycbcr, psnr_rgb : float or None
        PSNR in dB, see `eigengs_dr.Fit` and `eigengs_dr.psnr`; None for sets that are encoded
        without the mean image.
    seconds : float or None
        Time of the work on the image, without reading and writing; None if there was none, as for
        a skipped image. The time of a group is divided equally.
    iterations : int or None
        Number of refinement steps; None for encoded images.
    kept : int or None
        How many Gaussians of a start it began with, see `eigengs_dr.Fit`; None without a start,
        and for a skipped image.
    stopped : str
        Why the fit ended, see `eigengs_dr.Fit`; empty for encoded and skipped images.
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
    iterations: int | None = None
    kept: int | None = None
    stopped: str = ""
    error: str = ""
    result: Any = field(default=None, repr=False)


RowProgress = Callable[[int, int | None, ImageRow], None]
"""``progress(done, total, row)`` after every piece; the total is None if it is unknown."""


Images = str | os.PathLike[str] | Iterable[str | os.PathLike[str] | ArrayLike]
"""A folder, a glob, or an iterable of image files and arrays."""


class RunImage(NamedTuple):
    """One image of a run.

    Attributes
    ----------
    place : int
        Index in the run, from 0.
    name : str
        Stem of the file, or the index of the array with six digits.
    image : Path or array_like
        A file, or the pixels.
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
    def path(self) -> Path | None:
        """The file of the image; None for an array."""
        return self.image if isinstance(self.image, Path) else None

    def row(self, status: str, **figures: Any) -> ImageRow:
        """Return a row for the image."""
        return ImageRow(self.name, status, self.path, self.output, **figures)


def list_sources(
    images: Images, recursive: bool = False, folder: str | os.PathLike[str] | None = None
) -> Iterable[RunImage]:
    """Name the images of a run.

    Parameters
    ----------
    images : path-like or iterable
        A folder, a glob such as ``"photos/**/*.jpg"``, or an iterable of files and arrays, see
        `eigengs_dr.image.io.check_image`.
    recursive : bool, optional
        Whether to take images in the subfolders of a folder too.
    folder : path-like, optional
        The folder of the results.

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
        return _name_each(images, folder)
    if len(images) == 0:
        raise ValueError("images: got none; pass at least one image")
    sources = list(_name_each(images, folder))
    for source in sources:
        if source.error:
            raise ValueError(source.error)
    return sources


def _name_each(images: Iterable, folder: str | os.PathLike[str] | None) -> Iterator[RunImage]:
    """Name images one by one; a name that is already used is an error of the image."""
    taken: Record = {}
    for place, image in enumerate(images):
        is_file = isinstance(image, (str, os.PathLike))
        item = Path(image) if is_file else image
        name = item.stem if is_file else f"{place:06d}"
        error = f"{image}: {URL_NOTE}" if is_url(image) else ""
        if name in taken:
            error = f"{item if is_file else name}: {taken[name]} has this name too; rename one"
        taken.setdefault(name, item if is_file else f"image {place}")
        output = None if folder is None else Path(folder) / f"{name}.npz"
        yield RunImage(place, name, item, output, error)


def find_result(source: RunImage, options: str, overwrite: bool) -> ImageRow | None:
    """Return the row of an image whose result exists; None if there is work on it.

    A file of another kind, such as a basis, is never replaced.

    Parameters
    ----------
    source : RunImage
    options : str
        The digest of the options of the run. Results of single fits have none.
    overwrite : bool
        Whether images are processed again whose result exists.

    Raises
    ------
    ValueError
        If the result has other options, and is not replaced.
    """
    output = source.output
    if output is None or not os.path.lexists(output):  # a link that leads nowhere is not followed
        return None
    try:
        count, (width, height) = read_head(output)
        figures = read_figures(output)
    except (ValueError, OSError):
        reason = "exists and is not a set of Gaussians; move it, or use another folder"
        return source.row("failed", error=f"{output}: {reason}")
    if overwrite:
        return None
    row = source.row("skipped", width=width, height=height, gaussians=count)
    if figures is None:
        return row
    if figures.options and figures.options != options:
        raise ValueError(
            f"{output}: is a result of other options, or of another version; use those options or "
            "another folder, or fit all images again with --overwrite (overwrite=True)"
        )
    return replace(
        row,
        psnr_ycbcr=figures.psnr_ycbcr,
        psnr_rgb=figures.psnr_rgb,
        iterations=figures.iterations,
    )


def digest(options: Record) -> str:
    """Return a hash of options that is equal in every process; see `described`."""
    text = json.dumps(described(options), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fingerprint(start: Gaussians | Model) -> str:
    """Return a hash that identifies a set or a model among options."""
    arrays = *set_in(start).to_arrays().values(), *getattr(start, "weights", ())
    data = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(data).hexdigest()[:16]


def described(value: Any, holders: tuple[int, ...] = ()) -> Any:
    """Return an option as JSON holds it, by its values: equal ones are equal in every process.

    An object is the full name of its class with its attributes, whatever its repr shows; a function
    its full name with what it encloses; an array its hash.

    Parameters
    ----------
    value : object
    holders : tuple of int, optional
        Identities of the objects around it; one that holds itself ends there.
    """
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, Real):
        return value if math.isfinite(value) else str(value)  # NaN differs from itself
    named = value if isinstance(value, (type, FunctionType)) else type(value)
    name, within = f"{named.__module__}.{named.__qualname__}", (*holders, id(value))
    if isinstance(value, type) or id(value) in holders:
        return name
    if isinstance(value, Mapping):
        return {str(key): described(one, within) for key, one in value.items()}
    if isinstance(value, (tuple, list)):
        return [described(one, within) for one in value]
    if isinstance(value, (set, frozenset)):
        return sorted((described(one, within) for one in value), key=str)
    if hasattr(value, "__array__"):
        array = np.ascontiguousarray(value)
        return f"{name} {array.shape} {hashlib.sha256(array.tobytes()).hexdigest()[:16]}"
    attributes: Any = None
    if isinstance(value, FunctionType):
        attributes = [getclosurevars(value).nonlocals, value.__defaults__]
    elif "__dataclass_fields__" in vars(named):  # a subclass may have attributes of its own
        attributes = {f.name: getattr(value, f.name) for f in fields(value)}
    else:
        with suppress(TypeError):  # of what cannot be copied, such as a lock
            made = value.__reduce_ex__(2)
            attributes = made if isinstance(made, str) else list(made[1:])
            if made[0].__name__ == "__newobj__" and isinstance(made[2], Mapping):
                attributes = made[2]
    if isinstance(attributes, Mapping):
        return {"class": name} | described(attributes, within)
    return {"class": name, "values": described(attributes, within)}
