"""Images at URLs, such as ``s3://bucket/photos/*.jpg``, read with fsspec.

fsspec comes with the extra ``cluster``. It supports ``http``, ``zip``, ``memory`` and others by
itself; stores such as ``s3`` and ``gcs`` need the package that its error message names.
"""

from __future__ import annotations

import asyncio
import glob
import io
import ipaddress
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from ..storage.memory import SETTING, download_limit
from .formats import READ_SUFFIXES
from .pixels import ImageError, reason_of

SILENCE = 20.0
"""Seconds without a byte after which a server of ``http`` is given up."""


def is_url(name: object) -> bool:
    """Return whether a name is a URL, such as ``s3://bucket/a.png`` or ``zip://a.png::all.zip``."""
    return isinstance(name, str) and "://" in name


def stem_of(file: Path | str) -> str:
    """Return the name of a file or of a URL, without folders and suffix."""
    return PurePosixPath(file.partition("::")[0]).stem if isinstance(file, str) else file.stem


def list_urls(url: str, recursive: bool = False) -> list[str]:
    """List the images in a folder or matching a pattern at a URL.

    Parameters
    ----------
    url : str
        A folder, a pattern, or one file, which need not exist.
    recursive : bool, optional
        Whether to list those in the subfolders of a folder too.

    Returns
    -------
    list of str
        URLs of the files, sorted. For a folder, the files with the suffix of an image. The name of
        an image is returned as it is, without a request.

    Raises
    ------
    ImageError
        If the URL cannot be read, or has no such file.
    """
    is_web = url.startswith(WEB)
    try:
        system, path = _system(url)
        if glob.has_magic(path.replace("?", "") if is_web else path):  # "?" begins a query
            names = [name for name in system.glob(path) if not system.isdir(name)]
        elif not _is_image(path) and system.isdir(path):
            listed = system.find(path) if recursive else system.ls(path, detail=False)
            seen = (name for name in listed if "/." not in name.removeprefix(path))
            names = [name for name in seen if _is_image(name)]
        else:
            return [url]
    except ImageError:
        raise
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
    with TemporaryDirectory() as folder:
        file = Path(folder) / "image"
        try:
            with _Copy(file, "wb") as copy:
                _fetch(name, copy)
        except _TooLarge as error:
            raise ImageError(f"{name}: {error}") from None
        except ImageError:
            raise
        except Exception as error:  # each store raises its own types
            raise OSError(f"{name}: cannot be read ({reason_of(error)})") from error
        yield file


def _fetch(name: str, copy: _Copy) -> None:
    """Copy a URL or a pipe; a file of ``http`` by one request."""
    if not is_url(name):
        with Path(name).open("rb") as pipe:
            return shutil.copyfileobj(pipe, copy)
    system, path = _system(name)
    if name.startswith(WEB):
        return system.get_file(path, copy)
    with system.open(path, "rb") as remote:
        shutil.copyfileobj(remote, copy)


class _TooLarge(Exception):
    """There are more bytes than `download_limit`."""


class _Copy(io.FileIO):
    """A file that takes no more bytes than `download_limit`."""

    def write(self, part: Any) -> int:
        limit = download_limit()
        if self.tell() + len(part) > limit:
            raise _TooLarge(
                f"has more than {limit / 1e6:,.0f} MB; if you trust it, set {SETTING} to as many "
                "MB as it has"
            )
        return super().write(part)


WEB = ("http://", "https://")


def _system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it."""
    web = [start.removesuffix("://") for start in WEB if start in url]  # also behind "zip://a::"
    try:
        import fsspec

        options = {kind: _web_options() for kind in web}
    except ImportError as error:
        raise ImageError(
            f"images at URLs need {error.name}; in the checkout, type: pip install -e '.[cluster]'"
        ) from None
    pair: tuple[Any, str] = fsspec.core.url_to_fs(url, **options)
    return pair


@cache  # fsspec keeps one file system for equal options
def _web_options() -> dict[str, Any]:
    """Return the options of ``http``: a limit of silence, and where redirections may lead."""
    import aiohttp

    trace = aiohttp.TraceConfig()
    trace.on_request_redirect.append(_check_redirection)
    timeout = aiohttp.ClientTimeout(total=None, sock_connect=SILENCE, sock_read=SILENCE)
    return {"client_kwargs": {"timeout": timeout, "trace_configs": [trace]}}


async def _check_redirection(session: object, context: object, redirection: Any) -> None:
    """Refuse to go on without encryption, or from a public address to a private one.

    Otherwise a public server could show what only this machine or its network may read.
    """
    from yarl import URL

    here, headers = redirection.url, redirection.response.headers
    there = here.join(URL(headers.get("Location") or headers.get("URI", "")))  # as aiohttp
    if there.scheme not in (here.scheme, "https"):
        raise OSError(f"it leads to {there.scheme}://, which is not followed")
    if await _is_private(there) and not await _is_private(here):
        raise OSError(f"it leads to the private address {there.host}, which is not followed")


async def _is_private(url: Any) -> bool:
    """Return whether a host is this machine, or in a network that is not public."""
    found: list[Any] = []
    with suppress(OSError):  # the request will tell
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(url.host, url.port, type=socket.SOCK_STREAM)
    addresses = [ipaddress.ip_address(entry[4][0].partition("%")[0]) for entry in found]
    return any(not (getattr(ip, "ipv4_mapped", None) or ip).is_global for ip in addresses)


def _is_image(name: str) -> bool:
    path = PurePosixPath(name)
    return path.suffix.lower() in READ_SUFFIXES and not path.name.startswith(".")
