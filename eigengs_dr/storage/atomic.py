"""Files and folders that are created or replaced in one step."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from ..backend.interrupts import undone_at_end
from .locks import PREFIX, hold


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
        If the folder is missing or not writable, the target is a folder, a device or a URL, or the
        disk is full. The message names the target.

    Examples
    --------
    >>> with atomic_write("/tmp/note.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    """
    target = _target(path)
    with _names(path), _temporary(target, path) as temporary:
        # tempfile would make a file that only its owner may read.
        mode = target.stat().st_mode & 0o777 if target.exists() else 0o666
        temporary.touch(mode | 0o200, exist_ok=False)
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


def refuse_url(path: str | os.PathLike[str]) -> None:
    """Raise OSError if a file or a folder to write is a URL.

    Object stores can neither rename a file in one step nor lock a folder, so that writes would not
    be atomic.
    """
    if isinstance(path, str) and "://" in path:
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
