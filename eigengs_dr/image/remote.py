"""Images at URLs, such as ``s3://bucket/photos/*.jpg``, read with fsspec.

fsspec comes with the extra ``cluster``. It supports ``http``, ``zip``, ``memory`` and others by
itself; stores such as ``s3`` and ``gcs`` need the package that its error message names.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from types import ModuleType

from ..storage.memory import SETTING, download_limit
from .formats import READ_SUFFIXES
from .pixels import ImageError, reason_of


def is_url(name: object) -> bool:
    """Return whether a name is a URL, such as ``s3://bucket/a.png`` or ``zip://a.png::all.zip``."""
    return isinstance(name, str) and "://" in name


def stem_of(file: Path | str) -> str:
    """Return the name of a file or of a URL, without folders and suffix."""
    return PurePosixPath(file.partition("::")[0]).stem if isinstance(file, str) else file.stem


def list_urls(url: str) -> list[str]:
    """List the images in a folder or matching a pattern at a URL.

    Parameters
    ----------
    url : str
        A folder, a pattern, or one file, which need not exist.

    Returns
    -------
    list of str
        URLs of the files, sorted. For a folder, the files with the suffix of an image.

    Raises
    ------
    ImageError
        If the URL cannot be read, or has no such file.
    """
    fsspec = _fsspec()
    try:
        system, path = fsspec.core.url_to_fs(url)
        if glob.has_magic(path):
            names = [name for name in system.glob(path) if not system.isdir(name)]
        elif system.isdir(path):
            names = [name for name in system.ls(path, detail=False) if _is_image(name)]
        else:
            return [url]
    except Exception as error:  # each store raises its own types
        raise ImageError(f"{url}: cannot be listed ({reason_of(error)}); check the URL") from error
    if not names:
        raise ImageError(f"{url}: holds no images; check the URL")
    outer = url.partition("::")[2]
    tail = f"::{outer}" if outer else ""
    return sorted(system.unstrip_protocol(name) + tail for name in names)


def is_copied(name: object) -> bool:
    """Return whether a source can be read only once: a URL, a pipe or a socket."""
    if is_url(name):
        return True
    path = Path(str(name))
    return path.is_fifo() or path.is_socket()


@contextmanager
def local_copy(name: str) -> Iterator[Path]:
    """Copy a URL or a pipe to a temporary file, which exists during the block.

    Parameters
    ----------
    name : str

    Yields
    ------
    Path

    Raises
    ------
    ImageError
        If fsspec is missing, or there are more bytes than `download_limit`.
    OSError
        If it cannot be read, perhaps temporarily; the message has the name.
    """
    limit = download_limit()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "image"
        try:
            source = partial(_fsspec().open, name) if is_url(name) else Path(name).open
            with source("rb") as remote, file.open("wb") as copy:
                while part := remote.read(min(CHUNK_BYTES, limit + 1 - copy.tell())):
                    copy.write(part)
                size = copy.tell()
        except ImageError:
            raise
        except Exception as error:  # each store raises its own types
            raise OSError(f"{name}: cannot be read ({reason_of(error)})") from error
        if size > limit:
            raise ImageError(
                f"{name}: has more than {limit / 1e6:,.0f} MB; if you trust it, set "
                f"{SETTING} to as many MB as it has"
            )
        yield file


CHUNK_BYTES = 1 << 20
"""Number of bytes that are copied at once."""


def _fsspec() -> ModuleType:
    try:
        import fsspec
    except ImportError:
        raise ImageError(
            "images at URLs need fsspec; type: pip install 'eigengs-dr[cluster]'"
        ) from None
    return fsspec


def _is_image(name: str) -> bool:
    path = PurePosixPath(name)
    return path.suffix.lower() in READ_SUFFIXES and not path.name.startswith(".")
