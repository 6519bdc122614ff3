"""Array files, ``.npz`` without pickle; headers are checked before arrays are read."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..backend.messages import printable
from ..backend.types import Arrays, Record, Values
from .atomic import atomic_write
from .memory import check_content, open_regular

MAX_ENTRIES = 1 << 26
"""Largest number of elements of one array; a file that claims more is refused."""


class BadValue(ValueError):
    """A value in a file is invalid; callers put the name of the file before the message."""


class Field(NamedTuple):
    """Properties that an array in a file must have.

    Attributes
    ----------
    kind : str
        NumPy type, such as "f4", "i8" or "U" for text.
    ndim : int
        Number of dimensions.
    max_count : int
        Largest number of elements.
    """

    kind: str
    ndim: int
    max_count: int = MAX_ENTRIES


def check_values(arrays: Arrays, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise `BadValue` unless arrays have these shapes, and all floats are finite."""
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise BadValue(f"{name} has shape {arrays[name].shape}, expected {shape}")
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise BadValue(f"{name} holds values that are not finite")


@contextmanager
def file_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Put the name of a file before error messages, about its values or of the system."""
    try:
        yield
    except BadValue as error:
        raise ValueError(printable(f"{path}: {error}")) from None
    except FileNotFoundError:
        raise FileNotFoundError(f"{printable(str(path))}: no such file; check the path") from None
    except IsADirectoryError:
        raise IsADirectoryError(f"{printable(str(path))}: is a folder; give a file in it") from None


def write(
    path: str | os.PathLike[str],
    name: str,
    version: int,
    arrays: Mapping[str, NDArray[np.generic]],
    compressed: bool = True,
) -> None:
    """Write arrays with the name and the version of their format, in one step.

    Parameters
    ----------
    path : path-like
    name : str
        Format, e.g. ``"eigengs_dr.gaussians"``.
    version : int
    arrays : dict of str to ndarray
    compressed : bool, optional
        Whether to compress. Large single-precision arrays shrink little and take long.

    Raises
    ------
    OSError
        If the file cannot be written; an existing file does not change.
    """
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        members: Record = {"format": np.array(name), "version": np.array(version), **arrays}
        (np.savez_compressed if compressed else np.savez)(file, **members)


def read(path: str | os.PathLike[str], name: str, version: int, layout: dict[str, Field]) -> Arrays:
    """Read the arrays of `layout` from a file that `write` wrote; the file need not be trusted.

    Parameters
    ----------
    path : path-like
    name : str
        Expected format.
    version : int
        Expected version.
    layout : dict of str to Field
        Arrays to read.

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    ValueError
        If the file is not such an archive, is truncated, or has another format or version; if an
        array is missing, has another type or is too large. One line names the file, the key
        and the expected value.
    OSError
        If the file cannot be opened.
    """
    shapes = read_shapes(path, name, version, layout)
    values = sum(np.dtype(layout[key].kind).itemsize * math.prod(s) for key, s in shapes.items())
    check_content(path, COPIES * values)
    with _opened(path, name, version) as archive:
        return {key: _read_array(archive, key, field) for key, field in layout.items()}


def format_of(path: str | os.PathLike[str]) -> str:
    """Return the name of the format of a file that `write` wrote; errors as for `read`."""
    with _opened(path) as archive:
        return str(_read_array(archive, "format", Field("U", 0)))


def read_shapes(
    path: str | os.PathLike[str], name: str, version: int, layout: dict[str, Field]
) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of `layout` from their headers alone.

    For parameters and errors see `read`. Damaged array data goes unnoticed.
    """
    with _opened(path, name, version) as archive:
        return {key: _checked_shape(archive, key, field) for key, field in layout.items()}


def sizes_of(path: str | os.PathLike[str]) -> dict[str, int]:
    """Return the size of each array in a file in bytes, by name; errors as for `read`."""
    with _opened(path) as archive:
        return {e.filename.removesuffix(".npy"): e.compress_size for e in archive.infolist()}


COPIES = 2
"""Number of copies of the content of a file in memory: NumPy's and Dr.Jit's."""


@contextmanager
def _opened(
    path: str | os.PathLike[str], name: str = "eigengs_dr", version: int | None = None
) -> Iterator[zipfile.ZipFile]:
    """Open a file of a format and a version; turn every error in the block into one line."""
    text = printable(os.fspath(path))
    with open_regular(path) as file:
        try:
            with _archive(file) as archive:
                if version is not None:
                    _check_format(archive, name, version)
                yield archive
        except BadValue as error:
            raise ValueError(printable(f"{path}: {error}")) from None
        except MemoryError:
            raise ValueError(
                f"{text}: needs more memory than there is; if it should be small, it is damaged"
            ) from None
        except Exception as error:  # zlib, lzma, zipfile and NumPy raise many types
            raise ValueError(
                f"{text}: not a readable {name} file ({printable(str(error)[:80])}); it may be "
                "damaged or of another kind"
            ) from None


def _archive(file: BinaryIO) -> zipfile.ZipFile:
    """Return the archive in a file; raise `BadValue` if it is none, or only its start."""
    try:
        return zipfile.ZipFile(file)
    except zipfile.BadZipFile:
        file.seek(0)
        if file.read(4) == b"PK\x03\x04":
            raise BadValue("is truncated; copy or save it again") from None
        raise BadValue(
            "not a file of eigengs_dr; give one that it saved ('eigengs-dr fit' makes one of an "
            "image)"
        ) from None


def _check_format(archive: zipfile.ZipFile, name: str, version: int) -> None:
    """Raise `BadValue` for another format or version."""
    stored = str(_read_array(archive, "format", Field("U", 0)))
    if stored != name:
        known = stored.startswith("eigengs_dr.")
        advice = "; eigengs_dr.load reads files of all formats" if known else ""
        raise BadValue(f"format is {stored[:40]!r}, expected {name!r}{advice}")
    number = int(_read_array(archive, "version", Field("i8", 0)))
    if number != version:
        advice = "upgrade eigengs-dr" if number > version else "make the file again"
        raise BadValue(f"version is {number}, but this package reads {version}; {advice}")


def _read_array(archive: zipfile.ZipFile, key: str, field: Field) -> Values:
    """Check the header of one array, then read the array."""
    _checked_shape(archive, key, field)
    with archive.open(f"{key}.npy") as file:
        try:
            return np.asarray(npy.read_array(file, allow_pickle=False))
        except ValueError:
            raise BadValue(f"key '{key}' is truncated") from None


def _checked_shape(archive: zipfile.ZipFile, key: str, field: Field) -> tuple[int, ...]:
    """Return the shape of one array, after checking shape and type in its header."""
    try:
        entry = archive.getinfo(f"{key}.npy")
    except KeyError:
        raise BadValue(f"key '{key}' is missing") from None
    with archive.open(entry) as file:
        if npy.read_magic(file) != (1, 0):  # headers of later versions may claim gigabytes
            raise BadValue(f"key '{key}' is not a readable array")
        shape, _, dtype = npy.read_array_header_1_0(file)
    expected = np.dtype(field.kind)
    fits = dtype.kind == "U" if expected.kind == "U" else dtype == expected
    if not fits or len(shape) != field.ndim:
        kind = "text" if expected.kind == "U" else expected.name
        raise BadValue(
            f"key '{key}' is {len(shape)}-dimensional {dtype}, "
            f"expected {field.ndim}-dimensional {kind}"
        )
    if min(shape, default=0) < 0:
        raise BadValue(f"key '{key}' has the negative shape {shape}")
    if dtype.kind == "U" and dtype.itemsize > 4 * 64:
        raise BadValue(f"key '{key}' is longer than 64 characters")
    count = math.prod(shape)
    if count > field.max_count or count * dtype.itemsize > entry.file_size:
        raise BadValue(f"key '{key}' claims shape {shape}, more than the file holds")
    return shape
