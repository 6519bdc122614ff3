"""Files that are replaced in one step, a folder for one process, and who reads which file."""

from __future__ import annotations

import errno
import os
import platform
import re
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TextIO

TEMPORARY = re.compile(r"\.[0-9a-f]{16}")
"""Names of temporary files, without their suffix."""

STALE_SECONDS = 60.0
"""Age from which on a temporary file is what a killed process left; a write takes milliseconds, and
its file is young until the end."""


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Replace a file in one step: write a temporary file, then rename it to the target.

    Readers see the old file or the new file, never a part of it, even after a crash.

    Parameters
    ----------
    path : str or os.PathLike
        The target. It may exist, and its folder must exist. A symbolic link is followed.

    Yields
    ------
    Path
        An empty temporary file with the target's suffix, in the target's folder. At the end of the
        block it is flushed to disk and renamed. If the block raises, the temporary file is deleted
        and the target does not change.

    Raises
    ------
    OSError
        If the folder is missing or not writable, the target is a folder, a device or a URL, or the
        disk is full. The message names the target.

    Examples
    --------
    >>> with atomic_write("/tmp/note.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    """
    target, temporary = _target(path)
    try:
        # tempfile would make a file that only its owner may read.
        temporary.touch(exist_ok=False)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):
            # The error has no name, as that of a full disk, or the name of the temporary file.
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def remove_stale(folder: Path) -> None:
    """Delete the temporary files of processes that were killed while they wrote.

    Parameters
    ----------
    folder : Path
        A folder of results. Files younger than `STALE_SECONDS` stay: they may be written now. So do
        folders, in which work may go on for long, and what cannot be deleted.
    """
    now = time.time()
    for path in folder.glob(".*"):
        if TEMPORARY.fullmatch(path.stem) and path.is_file():
            with suppress(OSError):
                if now - path.stat().st_mtime > STALE_SECONDS:
                    path.unlink()


def require_writable(path: str | os.PathLike[str]) -> None:
    """Check that `atomic_write` can write a file, before long work depends on it.

    Parameters
    ----------
    path : str or os.PathLike
        The target.

    Raises
    ------
    OSError
        If the file cannot be written: one line that names the file and the reason.
    """
    target, probe = _target(path)
    try:
        # Mode bits do not show read-only disks, quotas and access lists.
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        reason = f"cannot create a file in {target.parent} ({error.strerror})"
        raise OSError(f"{path}: {reason}; choose another path") from error


def refuse_url(path: str | os.PathLike[str]) -> None:
    """Raise OSError if a file or a folder to write is a URL.

    Stores of objects rename no file in one step, and lock no folder; a result would not be written
    whole or not at all.
    """
    if isinstance(path, str) and "://" in path:
        raise OSError(f"{path}: results cannot be written to URLs; write to a folder, and copy it")


def _target(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Follow links to a target, and name a temporary file beside it.

    A target that must not be replaced, such as /dev/null, is refused.
    """
    refuse_url(path)
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        kind = "a folder" if target.is_dir() else "a device"
        raise OSError(f"{path}: is {kind}; choose another path")
    return target, target.with_name(f".{secrets.token_hex(8)}{target.suffix}")


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)
"""Errors of file systems without locks."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold the file ``.lock`` of a folder during a block.

    The operating system frees the lock when the process ends, however it ends. Network file systems
    (NFS from version 4 on, Lustre with ``flock``) lock between machines too. On a file system
    without locks the block runs without a lock. So it does on Windows, without the file too: it
    could not be deleted while it is open.

    Parameters
    ----------
    folder : Path
        An existing folder.

    Raises
    ------
    OSError
        If another run holds the lock: one line that names the folder and the run. If the file
        cannot be created.
    """
    if fcntl is None:
        yield
        return
    path = folder / ".lock"
    with _locked(path) as file:
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}")
        file.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)  # before the lock goes: a later run makes a new file


def _locked(path: Path) -> TextIO:
    """Open the lock file and lock it."""
    file = path.open("a+", errors="replace")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        with file:
            file.seek(0)
            holder = file.read(200) or "another process"
        raise OSError(
            f"{path.parent}: {holder} writes into this folder; wait for its end, or use another "
            "folder"
        ) from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            file.close()
            raise
    # The run before may have deleted the file between the two calls.
    with suppress(FileNotFoundError):
        if os.path.samestat(path.stat(), os.fstat(file.fileno())):
            return file
    file.close()
    return _locked(path)


class Reader(NamedTuple):
    """The reader of one format.

    Attributes
    ----------
    read_set : callable
        ``read_set(path, sections)`` returns the set as `Gaussians.load` takes it; `sections` is a
        number, or None for all.
    read_maps : callable
        ``read_maps(path)`` returns the maps of the set, without its Gaussians.
    """

    read_set: Callable[..., Any]
    read_maps: Callable[..., Any]


READERS: dict[bytes, Reader] = {}
"""Readers by the first bytes of a file. `eigengs_dr` registers that of packed sets."""


def reader_of(path: str | os.PathLike[str]) -> Reader | None:
    """Return the reader of a file, None for ``.npz``; `OSError` if it cannot be opened."""
    with open(path, "rb") as file:
        start = file.read(max(map(len, READERS), default=0))
    return next((reader for magic, reader in READERS.items() if start.startswith(magic)), None)
