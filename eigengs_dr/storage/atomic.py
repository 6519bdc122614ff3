"""Files and folders that are created or replaced in one step, and that have one writer at a time.

The operating system releases a lock when its process ends.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
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
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Replace a file in one step: write a temporary file, then rename it to the target.

    Readers see the old file or the new file, never a part of it, even after a crash. The new file
    has the permissions of the old one.

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
        If the folder is missing or not writable, the target is a folder, a device, a URL or a
        read-only file, or the disk is full. The message names the target.

    Examples
    --------
    >>> with atomic_write("/tmp/note.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    """
    target = _target(path)
    with _names(path), _temporary(target, path) as temporary:
        # tempfile would make a file that only its owner may read.
        mode = target.stat().st_mode & 0o777 if target.exists() else 0o666
        temporary.touch(mode, exist_ok=False)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Create a folder in one step, as `atomic_write` replaces a file.

    Parameters
    ----------
    path : str or os.PathLike
        The target, which does not exist or is an empty folder. A symbolic link is followed.

    Yields
    ------
    Path
        An empty folder beside the target, with a hidden name.

    Raises
    ------
    OSError
        If the folder cannot be created. The message names the target.
    """
    target = Path(os.path.realpath(path))
    with _names(path), _temporary(target, path) as temporary:
        temporary.mkdir()
        yield temporary
        if target.exists():  # Windows replaces no folder
            target.rmdir()
        os.replace(temporary, target)


def remove_folder(path: Path) -> None:
    """Delete a folder and its contents in one step."""
    with _temporary(path, path) as temporary:
        os.replace(path, temporary)


def remove_stale(folder: Path) -> None:
    """Delete the temporary files, temporary folders and locks that killed processes left behind.

    Files that a process still works on are locked, and stay; so do files that cannot be deleted.
    """
    for path in folder.glob(f"{PREFIX}*"):
        name = path.name.removesuffix(".lock")
        with suppress(OSError), hold(folder / f"{name}.lock", path, 0) as locked:
            if locked:
                _delete(folder / name)


def require_writable(path: str | os.PathLike[str]) -> None:
    """Check that `atomic_write` can write a file, before a long computation.

    Parameters
    ----------
    path : str or os.PathLike
        The target.

    Raises
    ------
    OSError
        If the file cannot be written: one line that names the file and the reason.
    """
    # Mode bits do not show read-only disks, quotas and access lists.
    with _temporary(_target(path), path):
        pass


def is_url(name: object) -> bool:
    """Return whether a name is a URL, such as ``s3://bucket/a.png``."""
    return isinstance(name, str) and "://" in name


def refuse_url(path: str | os.PathLike[str]) -> None:
    """Raise OSError if a file or a folder to write is a URL.

    Object stores can neither rename a file in one step nor lock a folder, so that writes would not
    be atomic.
    """
    if is_url(path):
        raise OSError(f"{path}: results cannot be written to URLs; write to a folder and copy it")


def refuse_link(path: Path) -> None:
    """Raise OSError if a path that no user names is there, and neither a plain file nor a folder.

    A folder from elsewhere may hold a link of the name of a file that a run writes.
    """
    if os.path.lexists(path) and (path.is_symlink() or not (path.is_file() or path.is_dir())):
        raise OSError(f"{path}: is a link or a device, which is not followed; move it away")


def _target(path: str | os.PathLike[str]) -> Path:
    """Follow links to a target; reject one that must not be replaced, such as /dev/null."""
    refuse_url(path)
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        kind = "a folder" if target.is_dir() else "a device"
        raise OSError(f"{path}: is {kind}; choose another path")
    # A rename would replace it, and root may write anything: its owner's mode decides.
    if target.exists() and not target.stat().st_mode & stat.S_IWUSR:
        raise OSError(f"{path}: is read-only; allow writing (chmod u+w) or choose another path")
    return target


@contextmanager
def _temporary(target: Path, output: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield an unused path beside a target, and delete this path after the block.

    The name is locked during the block, so that `remove_stale` skips it.
    """
    path = target.with_name(f"{PREFIX}{secrets.token_hex(8)}{target.suffix}")
    with hold(path.with_name(f"{path.name}.lock"), output), undone_at_end(partial(_delete, path)):
        try:
            yield path
        finally:
            _delete(path)


def _delete(path: Path) -> None:
    """Delete a file, a link or a folder, if it exists and can be deleted."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


@contextmanager
def _names(path: str | os.PathLike[str]) -> Iterator[None]:
    """Put the name of a target into errors without a name or with that of a temporary file."""
    try:
        yield
    except OSError as error:
        # The error of a full disk has no file name.
        name = os.path.basename(str(error.filename or ""))
        if error.errno is None or (name and not name.startswith(PREFIX)):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


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
    deadline = time.monotonic() + wait
    while True:
        descriptor, holder = _open(path, output)
        try:
            locked = _lock(descriptor)
            # The previous run may have deleted the file between the two calls.
            if locked and _is_file(path, descriptor):
                text = HOLDER + f"{os.getpid()} on {platform.node()}".encode()
                os.lseek(descriptor, 0, os.SEEK_SET)
                # Windows locks the first byte against readers. The length is that of what a killed
                # run left, so that nobody reads a part.
                if os.write(descriptor, b"\0" + text[:LENGTH].ljust(LENGTH)) <= LENGTH:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return descriptor, True
        except OSError as error:
            if error.errno in NO_LOCKS:
                return descriptor, False
            with suppress(OSError):  # an empty lock of a full disk
                path.unlink()
            os.close(descriptor)
            raise OSError(error.errno, error.strerror, os.fspath(output)) from error
        os.close(descriptor)
        if not locked:
            if time.monotonic() >= deadline:
                kind = "folder" if os.path.isdir(output) else "file"
                raise OSError(
                    f"{os.fspath(output)}: {holder or 'another process'} writes into this {kind}; "
                    f"wait for its end, or use another {kind}"
                )
            time.sleep(POLL)


def _lock(descriptor: int) -> bool:
    """Lock an open file; return False if another process holds it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(descriptor, 0, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):  # of Unix, and of Windows
        return False
    return True


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
