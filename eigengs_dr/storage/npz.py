"""Files of arrays: ``.npz`` without pickle, checked before an array is read."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from .atomic import atomic_write

MAX_ENTRIES = 1 << 26
"""Largest number of elements read for one array: what a file claims is not believed beyond."""


class BadValue(ValueError):
    """Something in a file that does not fit; callers put the name of the file before it."""


class Field(NamedTuple):
    """What an array in a file must be: NumPy kind ("f4", "i8", "U"), dimensions, most elements."""

    kind: str
    ndim: int
    most: int = MAX_ENTRIES


def write(
    path: str | os.PathLike[str],
    name: str,
    version: int,
    arrays: dict[str, NDArray[Any]],
    compressed: bool = True,
) -> None:
    """Write arrays with the name and version of their format, all or nothing.

    Parameters
    ----------
    path : path-like
    name : str
        Format, e.g. ``"eigengs_dr.gaussians"``.
    version : int
    arrays : dict of str to ndarray
    compressed : bool, optional
        Not worth its time for many single-precision numbers.

    Raises
    ------
    OSError
        If the file cannot be written; an existing one is then as before.
    """
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        members: dict[str, Any] = {"format": np.array(name), "version": np.array(version), **arrays}
        (np.savez_compressed if compressed else np.savez)(file, **members)


def read(
    path: str | os.PathLike[str], name: str, version: int, layout: dict[str, Field]
) -> dict[str, NDArray[Any]]:
    """Read the arrays of `layout` from a file that `write` wrote; the file may be hostile.

    Parameters
    ----------
    path : path-like
    name : str
        Format expected.
    version : int
        Newest version understood.
    layout : dict of str to Field

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    ValueError
        If the file is no such archive, truncated, of another format or newer, or an array is
        missing, of another type or larger than it may be. One line: file, key, what was expected.
    OSError
        If it cannot be opened.
    """
    with _opened(Path(path), name) as archive:
        found = str(_member(archive, "format", Field("U", 0)))
        if found != name:
            raise BadValue(f"format is {found[:40]!r}, expected {name!r}")
        newest = int(_member(archive, "version", Field("i8", 0)))
        if not 1 <= newest <= version:
            raise BadValue(
                f"version is {newest}, this package reads up to {version}; upgrade eigengs-dr"
            )
        return {key: _member(archive, key, field) for key, field in layout.items()}


def read_version(path: str | os.PathLike[str], name: str, version: int) -> int:
    """Return the version of a file that `write` wrote; parameters and errors as for `read`."""
    return int(read(path, name, version, {"version": Field("i8", 0)})["version"])


def format_of(path: str | os.PathLike[str]) -> str:
    """Return the name of the format of a file that `write` wrote; raises what `read` does."""
    with _opened(Path(path), "eigengs_dr") as archive:
        return str(_member(archive, "format", Field("U", 0)))


@contextmanager
def _opened(path: Path, name: str) -> Iterator[zipfile.ZipFile]:
    """Open a file; whatever goes wrong while it is read becomes one line."""
    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                yield archive
        except BadValue as error:
            raise ValueError(f"{path}: {error}") from None
        except Exception as error:  # zlib, lzma, zipfile and NumPy each raise what they like
            raise ValueError(
                f"{path}: not a readable {name} file ({' '.join(str(error).split())[:80]}); "
                "it may be damaged or something else"
            ) from None


def _member(archive: zipfile.ZipFile, key: str, field: Field) -> NDArray[Any]:
    """Read one array after its header was checked."""
    try:
        entry = archive.getinfo(f"{key}.npy")
    except KeyError:
        raise BadValue(f"key '{key}' is missing") from None
    with archive.open(entry) as file:
        major = npy.read_magic(file)
        read_header = npy.read_array_header_1_0 if major == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read_header(file)
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
        count = math.prod(shape)
        if dtype.kind == "U" and dtype.itemsize > 4 * 64:
            raise BadValue(f"key '{key}' is a text of over 64 characters")
        if count > field.most or count * dtype.itemsize > entry.file_size:
            raise BadValue(f"key '{key}' claims shape {shape}, more than the file holds")
        data = file.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise BadValue(f"key '{key}' is cut off")
    order = "F" if fortran else "C"
    return np.frombuffer(data, dtype).reshape(shape, order=order)  # type: ignore[call-overload]
