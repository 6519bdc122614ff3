"""The images of a run, a row for each, and the manifest of an output folder with all rows.

Result files are complete or missing, so a run need not fit images again whose file exists. During a
run, ``manifest.jsonl`` grows by one line per image, a JSON object; the last line of an image
counts. At the end of a run there is one line per image, sorted by name. A row holds the options of
its result, so that a run is only continued with the same options.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from inspect import getclosurevars
from numbers import Real
from pathlib import Path
from types import FunctionType
from typing import Any, BinaryIO, NamedTuple
from zipfile import is_zipfile

import numpy as np
from numpy.typing import ArrayLike

from ..backend.plain import parse_json
from ..backend.types import Record
from ..fitting.method import Model
from ..fitting.start import set_in
from ..gaussian.file import read_figures, read_head
from ..gaussian.gaussians import Gaussians
from ..image.folder import list_images
from ..image.pixels import URL_NOTE
from ..storage.atomic import (
    atomic_write,
    is_url,
    lock_folder,
    refuse_link,
    remove_stale,
    require_writable,
)
from ..storage.checkpoint import difference, to_json


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
        come from the manifest.
    psnr_ycbcr, psnr_rgb : float or None
        PSNR in dB, see `eigengs_dr.Fit` and `eigengs_dr.psnr`; None for sets that are encoded
        without the mean image.
    seconds : float or None
        Time of the work on the image, without reading and writing; None if there was none. The
        time of a group is divided equally.
    iterations : int or None
        Number of refinement steps; None for encoded images.
    kept : int or None
        How many Gaussians of a start it began with, see `eigengs_dr.Fit`; None without a start.
    stopped : str
        Why the fit ended, see `eigengs_dr.Fit`; empty for encoded images.
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


NAME = "manifest.jsonl"
"""Name of the file in the output folder."""

STATUSES = ("done", "skipped", "failed")

KEYS = [*(field.name for field in fields(ImageRow) if field.name != "result"), "options"]
"""Keys of a row."""

SKIPPED = (
    "width", "height", "gaussians", "psnr_ycbcr", "psnr_rgb", "seconds", "iterations", "kept"
)  # fmt: skip
"""Figures of a result that a later run takes from its row."""


@contextmanager
def open_manifest(
    folder: Path,
    options: Record | None = None,
    given: Collection[str] = (),
    overwrite: bool = False,
) -> Iterator[Manifest]:
    """Lock an existing folder during a block, and open its manifest.

    Parameters
    ----------
    folder : Path
    options : dict, optional
        Options on which the results of the run depend, with values that JSON can hold.
    given : collection of str, optional
        Names of the options that the caller gave explicitly.
    overwrite : bool, optional
        Process images again whose result exists.

    Raises
    ------
    OSError
        If another run writes into the folder, or the file is a link or cannot be read or written.
    ValueError
        If the file is not a manifest, or results have other values of options that were given.
    """
    path, settings = folder / NAME, to_json(options or {})
    with lock_folder(folder):
        remove_stale(folder)
        refuse_link(path)
        rows, clean = read_manifest(path)
        if not clean:
            write_manifest(path, rows)  # otherwise the next row would extend a truncated line
        conflict = ""
        if not overwrite:
            chosen = {name: value for name, value in settings.items() if name in given}
            if message := _conflict(folder, rows, chosen):
                raise ValueError(message)
            conflict = _conflict(folder, rows, settings)
        require_writable(path)  # root may append to what its owner made read-only
        file = path.open("ab")
        try:
            yield Manifest(path, rows, file, settings, overwrite, conflict)
        finally:
            # If the disk is too full for a second file, the longer file with the same rows stays.
            with suppress(OSError):
                file.close()  # Windows cannot replace an open file
                write_manifest(path, rows)
                remove_stale(folder)


def _conflict(folder: Path, rows: dict[str, Record], options: Record) -> str:
    """Return a message if some options differ from those of results, else "".

    Rows of older versions have no options.
    """
    for row in rows.values():
        stored = row.get("options") if row["status"] == "done" else None
        if isinstance(stored, dict) and (changes := difference(stored, options)):
            return (
                f"{folder}: holds results with {changes}; use their options or another folder, or "
                "fit all images again with --overwrite (overwrite=True)"
            )
    return ""


class Manifest(NamedTuple):
    """The manifest of a folder.

    Attributes
    ----------
    path : Path
    rows : dict of str to dict
        The last row of each image, by name.
    file : file
        File to which new rows are appended.
    options : dict
        The options of new rows.
    overwrite : bool
        Whether images are processed again whose result exists. A file of another kind, such as a
        basis, is never replaced.
    conflict : str
        Message that results have other options. A run without work may end with it.
    """

    path: Path
    rows: dict[str, Record]
    file: BinaryIO
    options: Record
    overwrite: bool
    conflict: str

    def find(self, source: RunImage) -> ImageRow | None:
        """Return the row of an image on which there is no work, otherwise None.

        Raises
        ------
        ValueError
            If there is work, and results have other options.
        """
        row = self._existing(source)
        if row is None and self.conflict:
            raise ValueError(self.conflict)
        return row

    def _existing(self, source: RunImage) -> ImageRow | None:
        output, row = self.path.with_name(f"{source.name}.npz"), self.rows.get(source.name, {})
        if not os.path.lexists(output):  # a link that leads nowhere is not followed
            return None
        # Of 100,000 results, whether each is whole is seen at its end, and all are not read again.
        if row.get("status") == "done" and not self.overwrite and is_zipfile(output):
            return source.row("skipped", **{name: row.get(name) for name in SKIPPED})
        try:
            count, head = read_head(output)
        except (ValueError, OSError):
            reason = "exists and is not a set of Gaussians; move it, or use another folder"
            return source.row("failed", error=f"{output}: {reason}")
        if self.overwrite or row.get("status") == "failed":
            return None
        width, height = head.size
        figures: Record = {"width": width, "height": height, "gaussians": count}
        if fit := read_figures(output):
            figures |= {k: v for k, v in fit._asdict().items() if k != "source"}
        return source.row("skipped", **figures)

    def add(self, row: ImageRow) -> None:
        """Append the row of an image. A skipped image keeps the row of its result.

        If a run was killed after it wrote a result but before its row, the figures are those of
        the file.
        """
        if row.status == "skipped":
            if self.rows.get(row.name, {}).get("status") == "done":
                return
            if row.psnr_rgb is not None:
                row = replace(row, status="done")
        self.rows[row.name] = _to_json(row) | {"options": self.options}
        try:
            self.file.write(json.dumps(self.rows[row.name]).encode() + b"\n")
            self.file.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error


def write_manifest(path: Path, rows: dict[str, Record]) -> None:
    """Write a manifest with one line per image, sorted by name."""
    with atomic_write(path) as temporary:
        lines = (json.dumps(rows[name]) + "\n" for name in sorted(rows))
        temporary.write_text("".join(lines), encoding="utf-8")


def read_manifest(path: Path) -> tuple[dict[str, Record], bool]:
    """Read a manifest, which need not exist.

    Returns
    -------
    rows : dict of str to dict
        The last row of each image, by name.
    clean : bool
        False if the last line is truncated, as after a crash; it is then left out.

    Raises
    ------
    ValueError
        If the file holds anything other than rows.
    OSError
        If the file cannot be read.
    """
    rows: dict[str, Record] = {}
    if not path.exists():
        return rows, True
    *lines, rest = path.read_text(encoding="utf-8", errors="replace").split("\n")
    for number, line in enumerate(lines, 1):
        try:
            row = parse_json(line)
            if row["status"] not in STATUSES or not isinstance(row["name"], str):
                raise ValueError
        except (ValueError, TypeError, KeyError):
            raise ValueError(
                f"{path}: line {number} is not a row of a manifest; move the file, or use another "
                "folder"
            ) from None
        rows[row["name"]] = row
    return rows, not rest


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


def _to_json(row: ImageRow) -> Record:
    """Return a row in JSON types; the output without its folder, which may be moved."""
    plain: Record = {key: getattr(row, key) for key in KEYS if key != "options"}
    plain["input"] = None if row.input is None else str(row.input)
    plain["output"] = None if row.output is None else row.output.name
    infinite = [k for k, v in plain.items() if isinstance(v, float) and not math.isfinite(v)]
    return plain | dict.fromkeys(infinite)
