"""Locks that give a file or a folder one writer; the operating system releases them."""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import stat
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from ..backend.interrupts import undone_at_end

PREFIX = ".eigengs_dr-"
"""Prefix of the names of temporary files and of lock files beside outputs."""

NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)
"""Errors of file systems without locks."""

HOLDER, LENGTH = b"process ", 200
"""Start and number of bytes of what a lock file says of its run, after one byte."""

NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Flags of opening, where there are such: no link is followed, and no pipe waited for."""

WAIT, POLL = 0.3, 0.02
"""Seconds to wait for a lock, because another run may be about to end, and between attempts."""


@contextmanager
def hold(path: Path, output: str | os.PathLike[str], wait: float = WAIT) -> Iterator[bool]:
    """Hold the lock of an output during a block, by a lock file that exists during the block.

    The operating system releases the lock when the process ends, however it ends. Network file
    systems (NFS from version 4 on, Lustre with ``flock``) lock between machines too.

    Parameters
    ----------
    path : Path
        The lock file, in an existing folder.
    output : path-like
        The locked file or folder, for the error message.
    wait : float, optional
        Seconds to wait while another run holds the lock.

    Yields
    ------
    bool
        False on a file system without locks, where the block runs without one.

    Raises
    ------
    OSError
        If another run holds the lock: one line that names the output and the run. If the file
        cannot be created.
    """
    descriptor, locked = _open_locked(path, output, wait)
    with undone_at_end(path.unlink):
        try:
            yield locked
        finally:
            # Before the lock goes: a later run makes a new file.
            with suppress(OSError):
                path.unlink()
            os.close(descriptor)
            if os.name == "nt":  # Windows deletes no file that is open
                with suppress(OSError):
                    path.unlink()


def _open_locked(path: Path, output: str | os.PathLike[str], wait: float) -> tuple[int, bool]:
    """Open and lock a file, and write the holder into it."""
    from filelock import lock_descriptor  # takes 0.1 s, which `--help` does not need

    deadline = time.monotonic() + wait
    while True:
        descriptor, holder = _open(path, output)
        try:
            locked = lock_descriptor(descriptor, blocking=False)
            # The previous run may have deleted the file between the two calls.
            if locked and _is_file(path, descriptor):
                text = HOLDER + f"{os.getpid()} on {platform.node()}".encode()
                os.lseek(descriptor, 0, os.SEEK_SET)
                # Windows locks the first byte against readers. The length is that of what a killed
                # run left, so that nobody reads a part.
                os.write(descriptor, b"\0" + text[:LENGTH].ljust(LENGTH))
                return descriptor, True
        except OSError as error:
            if error.errno in NO_LOCKS:
                return descriptor, False
            os.close(descriptor)
            raise
        os.close(descriptor)
        if not locked:
            if time.monotonic() >= deadline:
                kind = "folder" if os.path.isdir(output) else "file"
                raise OSError(
                    f"{os.fspath(output)}: {holder or 'another process'} writes into this {kind}; "
                    f"wait for its end, or use another {kind}"
                )
            time.sleep(POLL)


def _open(path: Path, output: str | os.PathLike[str]) -> tuple[int, str]:
    """Open a lock file, which need not exist, and return what it says of its run.

    Anything else of this name, such as a link in an archive from elsewhere, is left as it is.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | NO_FOLLOW, 0o666)
    except OSError as error:
        if path.is_symlink() or (path.exists() and not path.is_file()):
            raise _not_a_lock(path, output) from error
        reason = f"cannot create a file in {path.parent} ({error.strerror})"
        raise OSError(f"{os.fspath(output)}: {reason}; choose another path") from error
    status, text = os.fstat(descriptor), b""
    is_plain = stat.S_ISREG(status.st_mode) and status.st_nlink <= 1 and not path.is_symlink()
    if is_plain and status.st_size:
        os.lseek(descriptor, 1, os.SEEK_SET)
        text = os.read(descriptor, LENGTH)
    if not is_plain or (status.st_size and not text.startswith(HOLDER)):
        os.close(descriptor)
        raise _not_a_lock(path, output)
    return descriptor, text.decode(errors="replace").strip()


def _not_a_lock(path: Path, output: str | os.PathLike[str]) -> OSError:
    return OSError(
        f"{os.fspath(output)}: {path} is a link, or not a lock of eigengs-dr; move it away"
    )


def _is_file(path: Path, descriptor: int) -> bool:
    """Return whether a path still names the file that is open."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def lock_output(output: str | os.PathLike[str]) -> AbstractContextManager[bool]:
    """Lock a file or a folder for one run, by a hidden file beside it; see `hold`.

    The output need not exist; links are followed.
    """
    real = Path(os.path.realpath(output))
    name = hashlib.sha256(os.fsencode(real.name)).hexdigest()[:16]
    return hold(real.with_name(f"{PREFIX}{name}.lock"), output)


def lock_folder(folder: Path) -> AbstractContextManager[bool]:
    """Lock an existing folder for one run, by a file in it; see `hold`."""
    return hold(folder / ".lock", folder)
