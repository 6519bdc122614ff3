"""A lock that one process holds on a folder, so that two runs do not write there at once."""

from __future__ import annotations

import errno
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    file = _locked(path, folder)
    try:
        yield
    finally:
        # The file goes before the lock: a run that opens it later makes a new one.
        path.unlink(missing_ok=True)
        os.close(file)


def _locked(path: Path, folder: Path) -> int:
    """Return the descriptor of the lock file; it holds the lock."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _take(file)
            # The run before may have deleted the file between the two calls.
            if _is_same(path, file):
                os.truncate(file, 0)
                os.write(file, f"process {os.getpid()} on {platform.node()}".encode())
                return file
        except BlockingIOError:
            holder = os.read(file, 200).decode(errors="replace") or "another process"
            os.close(file)
            raise OSError(
                f"{folder}: {holder} writes into this folder; wait for its end, or use another "
                "folder"
            ) from None
        os.close(file)


def _take(file: int) -> None:
    """Lock a file, or raise BlockingIOError."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise


def _is_same(path: Path, file: int) -> bool:
    """Whether a path still names an open file."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(file))
    except FileNotFoundError:
        return False
